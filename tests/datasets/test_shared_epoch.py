"""What worker processes share with the process that starts them."""

import pickle
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pytest


def lies_in_shared_memory(index):
    """Return whether an index's numbers are in memory that other processes map too, by Linux."""
    address = index.parted()[0].column("rig_residual_px").chunk(0).buffers()[1].address
    for line in Path("/proc/self/maps").read_text().splitlines():
        place, rights = line.split()[:2]
        first, last = (int(end, 16) for end in place.split("-"))
        if first <= address < last:
            return rights.endswith("s")
    return False


@pytest.mark.parametrize("pickler", [pickle, ForkingPickler], ids=["to a file", "to a process"])
def test_an_index_that_travels_is_the_same(small_index, pickler):
    other = pickle.loads(pickler.dumps(small_index))

    assert other.digest == small_index.digest
    assert other.scene(3) == small_index.scene(3)
    assert other.root == small_index.root
    np.testing.assert_array_equal(other.column("key"), small_index.column("key"))
    assert lies_in_shared_memory(other) == (pickler is ForkingPickler)


def test_a_plain_pickle_of_an_index_holds_its_rows(small_index):
    assert len(pickle.dumps(small_index)) > 0.9 * small_index.parted()[0].nbytes
