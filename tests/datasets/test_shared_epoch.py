"""What worker processes share with the process that starts them."""

import copy
import pickle
import warnings
from functools import partial
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from stereogenbench_data import (
    Compose,
    Crop,
    EpochBatches,
    RandomCrop,
    RepeatedEpochWarning,
    Resize,
    StereoPairs,
    StereoPairStream,
    collate,
)
from tests.datasets.conftest import flat, fork_and, keys_of

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")
COPIES = {
    "deep": copy.deepcopy,
    "pickled": lambda each: pickle.loads(pickle.dumps(each)),
    "shallow": copy.copy,
}


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


@pytest.mark.parametrize(
    ("how", "method"), [("deep", "fork"), ("pickled", "spawn"), ("shallow", "fork")]
)
def test_running_workers_of_a_copied_dataset_follow_its_epoch(small_index, how, method):
    """Hydra, Ray, joblib and trainers copy what they are given."""
    pairs = StereoPairs(small_index, fields=("__key__",), frames=("random", 2))
    expected = [
        pairs.set_epoch(epoch) or [pairs[n]["__key__"] for n in range(8)] for epoch in (0, 1, 2)
    ]
    copied = COPIES[how](pairs)
    assert copied.epoch == 2
    loader = DataLoader(
        copied, batch_size=2, num_workers=2, persistent_workers=True, multiprocessing_context=method
    )

    assert [copied.set_epoch(epoch) or flat(keys_of(loader)) for epoch in (0, 1, 2)] == expected
    copied.set_epoch(5)
    assert pairs.epoch == (5 if how == "shallow" else 2)


@pytest.mark.filterwarnings("ignore::stereogenbench_data.RepeatedEpochWarning")
@pytest.mark.parametrize(
    ("how", "persistent"), [("deep", False), ("pickled", True), ("shallow", True)]
)
def test_a_copied_stream_goes_on_at_a_loaded_position_once(small_index, how, persistent):
    options = {"fields": ("__key__",), "pairs": "adjacent", "frames": "all", "drop_last": False}
    stream = StereoPairStream(small_index, 2, **options)
    stream.load_state_dict(stream.batches.state_at(0, 10))
    loader = DataLoader(
        COPIES[how](stream),
        batch_size=2,
        num_workers=2,
        multiprocessing_context="fork",
        persistent_workers=persistent,
    )

    assert [len(list(loader)) for _ in range(3)] == [60, 70, 70]


@pytest.mark.parametrize("kind", ["map-style", "stream", "stream of fixed frames"])
@pytest.mark.parametrize(
    ("workers", "persistent", "sets_epochs"),
    [(0, False, False), (2, False, False), (2, True, False), (0, False, True), (2, True, True)],
)
def test_passes_that_repeat_an_epoch_are_warned_of_once(
    small_index, tmp_path, monkeypatch, kind, workers, persistent, sets_epochs
):
    told = tmp_path / "warnings of all processes"
    told.touch()

    def note(message, category, *_):
        with told.open("a") as file:
            file.write(f"{category.__name__}\n")

    monkeypatch.setattr(warnings, "showwarning", note)
    warnings.simplefilter("always")
    options = {"fields": ("__key__",), "frames": "first" if "fixed" in kind else ("random", 2)}
    if kind == "map-style":
        data, how = StereoPairs(small_index, **options), {"shuffle": True, "collate_fn": collate}
    else:
        data, how = StereoPairStream(small_index, 2, **options), {}
    loader = DataLoader(data, 2, num_workers=workers, persistent_workers=persistent, **how)
    for epoch in range(3):
        if sets_epochs:
            data.set_epoch(epoch)
        list(loader)

    assert told.read_text().count("RepeatedEpochWarning") == (0 if sets_epochs else 1)


@pytest.mark.filterwarnings("error:a new loader repeats epoch")
def test_equal_passes_are_no_matter_where_nothing_is_random(small_index):
    crop = Crop(0, 0, 32, 32)
    for transform in (None, crop, Compose([crop, Compose([Resize(16, 16)])])):
        pairs = StereoPairs(small_index, fields=("__key__",), transform=transform)
        loader = DataLoader(pairs, batch_size=2)
        assert keys_of(loader) == keys_of(loader)


@pytest.mark.parametrize("ordered_by", ["torch", "EpochBatches"])
def test_an_epoch_that_was_set_again_may_be_repeated(small_index, ordered_by):
    pairs = StereoPairs(small_index, fields=("__key__",), transform=RandomCrop(32, 32))
    options = {"batch_size": 2}
    if ordered_by == "EpochBatches":
        options = {"batch_sampler": EpochBatches(pairs, 3, drop_last="pad")}
    loader = DataLoader(pairs, **options)
    for _ in range(2):
        pairs.set_epoch(0)
        list(loader)

    match = "4 of .* samples .*of 4 scenes.* epoch 0 come a second"
    with pytest.warns(RepeatedEpochWarning, match=match) as told:
        list(loader)
    assert told[0].filename == __file__
    assert keys_of(loader) == keys_of(loader)


def test_a_loader_made_in_each_epoch_is_warned_of_once_where_it_would_repeat(small_index):
    pairs = StereoPairs(small_index, frames="all", fields=("__key__",))
    in_order = pairs.loader(2, shuffle=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RepeatedEpochWarning)
        both = pairs.loader(2), pairs.loader(2)  # side by side
        assert all(keys_of([a]) == keys_of([b]) for a, b in zip(*both, strict=True))
        assert keys_of(in_order) == keys_of(pairs.loader(2, shuffle=False))
        for epoch in range(3):
            pairs.set_epoch(epoch)
            list(pairs.loader(2))
    with pytest.warns(RepeatedEpochWarning, match="repeats epoch 2 .* before the loop") as told:
        orders = [keys_of(pairs.loader(2)) for _ in range(3)]
    assert orders[0] == orders[1] == orders[2]
    assert len(told) == 1


def test_a_forked_rank_has_an_epoch_of_its_own_which_its_workers_share(small_index):
    """Else a slow rank would draw for the epoch that a fast one has gone on to."""
    pairs = StereoPairs(small_index, fields=("__key__",), frames=("random", 3))
    first, fourth = (pairs.set_epoch(epoch) or sorted(keys_of(pairs)) for epoch in (1, 4))
    pairs.set_epoch(1)

    def rank():
        assert pairs.epoch == 1
        pairs.set_epoch(4)
        loader = DataLoader(pairs, batch_size=4, num_workers=1, collate_fn=collate)
        assert sorted(flat(keys_of(loader))) == fourth != first

    assert fork_and(rank) == 0
    assert pairs.epoch == 1


@pytest.mark.parametrize(
    "mode",
    [torch.inference_mode, partial(torch.device, "meta")],
    ids=["inference", "default device"],
)
def test_a_dataset_is_made_in_any_mode_of_torch(small_index, mode):
    with mode():
        pairs = StereoPairs(small_index, fields=("__key__",))
    pairs.set_epoch(2)

    assert pairs.epoch == 2
    assert len(list(pairs.loader(2, num_workers=1))) == 2


def test_a_warning_of_a_repeated_epoch_points_at_the_users_line(small_index):
    fields = ("__key__",)
    loader = DataLoader(StereoPairStream(small_index, 2, fields=fields), batch_size=None)
    pairs = StereoPairs(small_index, frames=("random", 2), fields=fields)
    made_anew = StereoPairs(small_index, fields=fields)
    passes = {
        "a stream": lambda: list(loader),
        "torch's loader": lambda: [*DataLoader(pairs, 2, collate_fn=collate)],
        "a loop over a loader": lambda: [batch for batch in made_anew.loader(2)],  # noqa: C416
    }
    for name, one_pass in passes.items():
        one_pass()
        with pytest.warns(RepeatedEpochWarning) as told:
            one_pass()

        assert told[0].filename == __file__, name
