"""Batches that workers make in parts: whose error comes, what does not fit, what is pinned."""

import gc
import itertools

import pytest
import torch
from torch.utils.data import DataLoader, default_collate

from stereogenbench_data import MediaError, StereoPairs
from stereogenbench_data.datasets import batch_parts
from tests.datasets.conftest import TRUE_FIELDS, is_true, keys_of, same

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


@pytest.fixture
def pairs(small_index):
    return StereoPairs(small_index, fields=TRUE_FIELDS, pairs="adjacent", frames="all")


@pytest.mark.parametrize("workers", [1, 3, 4])
def test_batches_of_parts_are_those_of_one_process(pairs, truth, workers):
    expected = list(pairs.loader(9, drop_last=False, seed=1))
    found = list(pairs.loader(9, num_workers=workers, drop_last=False, seed=1))

    assert [len(batch["left"]) for batch in found] == [9] * 15 + [5]
    assert all(same(one, other) for one, other in zip(found, expected, strict=True))
    assert all(is_true(batch, truth) for batch in found)


def test_a_collate_function_is_given_whole_batches_in_the_process_that_trains(pairs, truth):
    given = []

    def collate_fn(samples):
        given.append([sample["__key__"] for sample in samples])
        return default_collate(samples)

    found = list(pairs.loader(9, num_workers=3, collate_fn=collate_fn))

    assert given == keys_of(found) == keys_of(pairs.loader(9))
    assert all(is_true(batch, truth) for batch in found)


class ShrinkLate:
    """A transform that leaves later frames half their size, so that samples have two shapes."""

    swaps_views = False

    def __call__(self, views, generator):
        from stereogenbench_data import Crop

        return Crop(0, 0, 32, 32)(views, generator) if views.frames[0] >= 4 else views


@pytest.mark.parametrize("workers", [0, 2])
def test_samples_of_several_shapes_come_as_they_are_to_a_collate_function(small_index, workers):
    """Also those that share a batch, and so a slot, with samples of the usual shape."""
    fields = {"fields": TRUE_FIELDS, "pairs": "adjacent", "frames": "all"}
    pairs = StereoPairs(small_index, transform=ShrinkLate(), **fields)
    expected = {sample["__key__"]: sample for sample in pairs}
    loader = pairs.loader(4, num_workers=workers, shuffle=False, collate_fn=list)
    held = [sample for batch in loader for sample in batch]

    assert len(held) == len(expected)
    assert all(same(sample, expected[sample["__key__"]]) for sample in held)
    assert {sample["left"].shape[-1] for sample in held} == {32, 64}


class Fail:
    """A transform that fails at some frames of all scenes, in whichever worker."""

    swaps_views = False

    def __call__(self, views, generator):
        if views.frames[0] >= 4:
            raise MediaError(f"camera {views.source}, frame {views.frames[0]}: is damaged")
        return views


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_of_several_damaged_files_the_first_samples_error_comes(small_index, keyed, workers):
    options = {"fields": TRUE_FIELDS, "pairs": "adjacent", "frames": "all"}
    late = [
        [key for key in keys if int(key.rpartition("/")[2]) >= 4]
        for keys in keys_of(keyed.loader(9))
    ]
    taken = next(number for number, keys in enumerate(late) if keys)
    wanted = late[taken][0]
    pairs = StereoPairs(small_index, transform=Fail(), **options)
    batches = iter(pairs.loader(9, num_workers=workers))
    for _ in range(taken):
        next(batches)

    with pytest.raises(MediaError, match=wanted.rpartition("/")[0].rpartition("/")[0]) as raised:
        next(batches)
    assert f"frame {int(wanted.rpartition('/')[2])}" in str(raised.value)


@pytest.fixture
def pinning(monkeypatch):
    """Pin what comes from workers as torch's thread does, where there is no accelerator."""
    monkeypatch.setattr(batch_parts, "pin_memory", lambda batch: {
        name: value.clone() if isinstance(value, torch.Tensor) else value
        for name, value in batch.items()
    })  # fmt: skip
    take = batch_parts.PartedBatches.next
    monkeypatch.setattr(
        batch_parts.PartedBatches,
        "next",
        lambda self, results: take(self, (made.pin_memory() for made in results)),
    )


@pytest.mark.parametrize("collate_fn", [None, default_collate], ids=["ours", "torch's"])
def test_pinned_batches_of_passes_that_are_broken_off_are_whole(pairs, truth, pinning, collate_fn):
    """A slot that is freed twice would exchange pixels under right keys."""
    loader = pairs.loader(9, num_workers=2, persistent_workers=True, collate_fn=collate_fn)
    held = []
    for steps in (1, 3, 15, 2, 15):
        for batch in itertools.islice(loader, steps):
            held.append(batch)
            assert is_true(batch, truth)

    assert all(is_true(batch, truth) for batch in held)
    gc.collect()


def test_a_field_that_is_saved_takes_no_other_along(pairs, tmp_path):
    loader = pairs.loader(9, num_workers=1)
    batches = iter(loader)
    next(batches)
    batch = next(batches)
    torch.save(batch["frame_index"], tmp_path / "saved.pt")

    assert batch["frame_index"].untyped_storage().nbytes() == 9 * 8
    assert (tmp_path / "saved.pt").stat().st_size < 4_000


def test_a_loader_made_of_a_loaders_parts_gives_whole_batches(pairs, truth):
    """As frameworks do that rebuild loaders."""
    loader = pairs.loader(9, num_workers=2)
    rebuilt = DataLoader(
        loader.dataset,
        batch_sampler=loader.batch_sampler,
        num_workers=2,
        collate_fn=loader.collate_fn,
    )
    found = list(rebuilt)

    assert keys_of(found) == keys_of(pairs.loader(9))
    assert all(is_true(batch, truth) for batch in found)


def test_what_is_on_its_way_is_bounded_by_the_batches_ahead(pairs):
    loader = pairs.loader(9, num_workers=2, prefetch_factor=1)
    batches = iter(loader)
    next(batches)
    next(batches)
    parted = batches._workers.parted

    assert 0 < len(parted._coming) <= 2 * 1 + 1
    assert isinstance(parted, batch_parts.PartedBatches)
