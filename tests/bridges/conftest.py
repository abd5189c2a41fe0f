"""Shards as other libraries are given them."""

import numpy as np
import pytest

from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings
from tests.servers.tools import require_module


@pytest.fixture(scope="session")
def urls(small_shards):
    return sorted(str(path) for path in small_shards.glob("*.tar"))


@pytest.fixture(scope="session")
def derived_shards(small_release, once):
    """Two cameras of the scenes of `small_release` in training shards."""
    require_module("blosc2")
    settings = TrainingSettings((32, 48), "small", (0, 3))
    return once(
        "derived_shards", lambda out: pack(small_release, out, training=settings, workers=1)
    )


def require_frames_of_epochs(samples, decoder):
    """Require that samples are of the frames of the epoch that is set, also when set again."""

    def drawn(epoch):
        decoder.set_epoch(epoch)
        return [int(sample["frame_index"]) for sample in samples]

    first, second, again = drawn(0), drawn(1), drawn(0)
    assert first == again != second


def require_equal(one, other):
    """Require the same fields, dtypes and values of two samples, of arrays or of tensors."""
    assert one.keys() == other.keys()
    for name in one:
        a, b = np.asarray(one[name]), np.asarray(other[name])
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)
