"""Memory of batches: written once, not copied, and used again only when nobody holds any of it."""

import pytest
import torch
from torch.utils.data import DataLoader, default_collate

from stereogenbench_data import PAIR_FIELDS, StateError, StereoPairs, collate
from tests.datasets.conftest import same

FIELDS = ("left", "disparity", "valid", "baseline_m", "frame_index", "__key__")

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


@pytest.fixture
def pairs(small_index):
    return StereoPairs(small_index, fields=FIELDS, pairs="adjacent", frames="all")


@pytest.mark.parametrize("fields", [tuple(PAIR_FIELDS), ("right", "visible")], ids=len)
def test_every_field_of_a_batch_is_that_of_single_samples(small_index, fields):
    for selection in ({"pairs": "adjacent"}, {"pairs": "sweep"}, {"frames": ("clips", 3)}):
        pairs = StereoPairs(small_index, fields=fields, **selection)
        batch = collate(pairs.__getitems__([3, 0, 2]))

        assert same(batch, default_collate([pairs[3], pairs[0], pairs[2]]))
        pairs.close()


@pytest.mark.parametrize("workers", [0, 1])
def test_a_part_of_a_batch_keeps_all_of_it(pairs, workers):
    """A slice, a numpy view and a flattened view hold the memory as the batch itself does."""
    expected = {sample["__key__"]: sample["left"] for sample in pairs}
    kept = []
    for batch in pairs.loader(9, num_workers=workers):
        take = [lambda left: left[3], lambda left: left.numpy()[3], lambda left: left[3].flatten()]
        kept.append((batch["__key__"][3], take[len(kept) % 3](batch["left"])))

    for key, part in kept:
        assert torch.equal(torch.as_tensor(part).reshape(3, 64, 64), expected[key])


def places(loader):
    """Return where in memory the batches of a loop that lets them go come to lie."""
    found = []
    for batch in loader:
        found.append(batch["left"].data_ptr())
        del batch
    return found


# With workers two batches a worker are on their way. The loop holds one while another is made, and
# the first comes before it is known where fields lie.
@pytest.mark.parametrize(("workers", "most"), [(0, 1 + 2), (1, 2 + 2), (2, 4 + 2)])
def test_a_loop_that_lets_its_batches_go_uses_the_same_memory_again(pairs, workers, most):
    found = places(pairs.loader(9, num_workers=workers))

    assert len(found) == 15
    assert len(set(found)) <= most


def test_passes_broken_off_cost_workers_that_persist_no_memory(pairs):
    loader = pairs.loader(9, num_workers=2, persistent_workers=True)
    for _ in range(6):
        for _, batch in zip(range(3), loader, strict=False):
            del batch

    assert len(places(loader)) == 15
    assert len(set(places(loader))) <= 4 + 1


def test_fresh_buffers_give_each_batch_memory_of_its_own(pairs, small_index):
    """While a batch is held its memory is not another's; so hold one and look at the others."""
    fresh = StereoPairs(small_index, fields=FIELDS, pairs="adjacent", frames="all", buffers="fresh")
    held = list(fresh.loader(9, num_workers=1, drop_last=False))
    starts = [batch["left"].untyped_storage().data_ptr() for batch in held]

    assert len(set(starts)) == len(held) == 16
    expected = pairs.loader(9, drop_last=False)
    assert all(same(one, other) for one, other in zip(held, expected, strict=True))


def test_a_position_is_not_guessed_where_another_loader_reads_the_batches(pairs):
    loader = pairs.loader(9)
    other = iter(
        DataLoader(loader.dataset, batch_sampler=loader.batch_sampler, collate_fn=loader.collate_fn)
    )
    next(other)
    with pytest.raises(StateError, match=r"read by another DataLoader .* skip_first_batches"):
        loader.state_dict()
    assert len(list(other)) == 14

    resumed = pairs.loader(9)
    resumed.load_state_dict(loader.state_dict())
    assert resumed.epoch == 1
    next(iter(loader))
    assert loader.epoch == 1
    assert loader.state_dict()["batches_consumed"] == 1
