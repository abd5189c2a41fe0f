"""`EpochBatches`, and positions saved and loaded."""

import itertools
import json

import numpy as np
import pytest
import torch
from torchdata.stateful_dataloader import StatefulDataLoader

from stereogenbench_data import (
    EpochBatches,
    SelectionError,
    StateError,
    StereoPairs,
    UnsharedRanksWarning,
)
from tests.datasets.conftest import flat, in_turn, keys_of


def test_the_batches_of_all_ranks_are_the_epoch_exactly_once(keyed):
    for world in range(1, 6):
        shares = [
            list(EpochBatches(keyed, 9, rank=rank, world_size=world, drop_last=False))
            for rank in range(world)
        ]

        assert sorted(flat(in_turn(shares))) == list(range(140))
        assert in_turn(shares) == list(EpochBatches(keyed, 9, drop_last=False))


def test_drop_says_how_much_it_leaves_out(keyed):
    shares = [EpochBatches(keyed, 9, rank=rank, world_size=4) for rank in range(4)]

    assert [len(share) for share in shares] == [3, 3, 3, 3]
    assert [share.left_out for share in shares] == [140 - 12 * 9] * 4
    assert EpochBatches(keyed, 9, drop_last="pad").left_out == 0
    assert EpochBatches(keyed, 9, drop_last=False).left_out == 0


def test_the_seed_is_the_datasets_unless_another_is_given(small_index):
    pairs = StereoPairs(small_index, fields=("__key__",), frames="all", seed=5)
    others = StereoPairs(small_index, fields=("__key__",), frames="all")

    assert list(EpochBatches(pairs, 4)) == list(EpochBatches(others, 4, seed=5))
    assert list(EpochBatches(pairs, 4)) != list(EpochBatches(others, 4))


def test_a_position_is_flat_json_and_says_what_it_belongs_to(keyed):
    batches = EpochBatches(keyed, 4, rank=1, world_size=2, seed=3)
    given = iter(batches)
    next(given)
    next(given)
    state = batches.state_dict()

    assert json.loads(json.dumps(state)) == state
    assert state == {
        "version": 5,
        "epoch": 0,
        "batches_consumed": 4,
        "seed": 3,
        "batch_size": 4,
        "shuffle_groups": 1,
        "open_scenes": 4,
        "open_frames": 1,
        "shuffle": True,
        "drop_last": True,
        "scenes": 4,
        "samples": 140,
        "selection": keyed.plan.digest,
        "index": keyed.index.digest,
    }


def test_what_is_loaded_goes_on_once_and_then_epochs_are_whole(keyed):
    batches = EpochBatches(keyed, 4)
    whole = list(batches)
    batches.load_state_dict(batches.state_at(0, 30))

    assert list(batches) == whole[30:]
    assert list(batches) == whole


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 5}, "batch_size is 5 here and 4 there"),
        ({"shuffle_groups": 2}, "shuffle_groups is 2 here and 1 there"),
        ({"shuffle": False}, "shuffle is False here and True there"),
        ({"drop_last": "pad", "seed": 2}, "seed is 2 here.*; drop_last is 'pad' here"),
    ],
    ids=str,
)
def test_a_position_in_another_order_is_refused_by_name(keyed, options, message):
    state = EpochBatches(keyed, 4).state_dict()

    with pytest.raises(StateError, match=message):
        EpochBatches(keyed, **({"batch_size": 4} | options)).load_state_dict(state)


@pytest.mark.parametrize(
    "options",
    [{"shuffle_groups": 1, "open_scenes": 40}, {"open_scenes": 4}],
    ids=str,
)
def test_options_that_few_scenes_leave_without_effect_are_the_same_order(keyed, options):
    asked, plain = EpochBatches(keyed, 4, **options), EpochBatches(keyed, 4)
    asked.load_state_dict(plain.state_at(0, 5))

    assert list(asked) == list(plain)[5:]


def test_a_sequential_position_goes_with_any_seed(keyed):
    batches = EpochBatches(keyed, 4, shuffle=False, seed=3, shuffle_groups=2)
    batches.load_state_dict(EpochBatches(keyed, 4, shuffle=False).state_at(0, 34))

    assert list(batches) == [[136, 137, 138, 139]]


def test_a_position_in_another_selection_is_refused_by_name(keyed, small_index):
    state = EpochBatches(keyed, 4).state_dict()
    options = {"fields": ("__key__",), "pairs": "adjacent", "frames": "all"}
    of_others = "as many samples of as many scenes are selected, and other scenes, pairs, frames"
    for change, said in (
        ({"pairs": "all"}, "samples is 420 here and 140 there"),
        ({"direction": "right_to_left"}, of_others),
        ({"frames": list(range(1, 7))}, "samples is 120 here and 140"),
        ({"split": "train"}, "scenes is 3 here and 4 there; samples is 105 here and 140 there"),
    ):
        other = StereoPairs(small_index, **(options | change))
        with pytest.raises(StateError, match=said):
            EpochBatches(other, 4, seed=0, shuffle_groups=1, open_scenes=4).load_state_dict(state)
    with pytest.raises(StateError, match="the index is another one: its files were changed, or"):
        EpochBatches(keyed, 4).load_state_dict(state | {"index": "0" * 64})


def test_other_ranks_go_on_with_the_groups_of_a_state(keyed):
    """The order follows the number of ranks at the first start alone."""
    first = EpochBatches(keyed, 1, rank=1, world_size=3)
    state = json.loads(json.dumps(first.state_at(2, 9)))
    left = []
    for rank in (0, 1):
        batches = EpochBatches(keyed, 1, rank=rank, world_size=2)
        assert batches.rule.shuffle_groups == 4
        batches.load_state_dict(state)
        assert batches.rule == first.rule
        left.insert(0, list(batches))  # batch 9 is rank 1's

    keyed.set_epoch(2)
    whole = [list(EpochBatches(keyed, 1, rank=rank, world_size=3)) for rank in range(3)]
    assert first.rule.shuffle_groups == 3
    assert in_turn(left)[:-1] == in_turn(whole)[9:]
    asked = EpochBatches(keyed, 1, shuffle_groups=4)
    with pytest.raises(StateError, match="shuffle_groups is 4 here and 3 there"):
        asked.load_state_dict(state)


@pytest.mark.parametrize("then", [1, 3])
def test_after_an_epochs_last_batch_other_ranks_begin_the_next_one(keyed, then):
    """Three ranks drop what fills no batch of each of them: that is not left for fewer."""
    before = [EpochBatches(keyed, 9, rank=rank, world_size=4) for rank in range(4)]
    states = [list(batches) and batches.state_dict() for batches in before]
    assert states == [states[0]] * 4

    loader = keyed.loader(9, rank=0, world_size=then)
    loader.load_state_dict(states[0])
    assert loader.epoch == 1
    assert loader.state_dict()["batches_consumed"] == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batches_consumed": -1}, "batches_consumed is -1, no whole number"),
        ({"epoch": "2"}, "epoch is '2', no whole number"),
        ({"version": True}, "of version True of the order, and this release has version 5"),
        ({"version": 4, "order": "shuffled"}, "of version 4 of .* Begin its epoch anew, set_epoch"),
        ({"batches_consumed": 36}, "batches_consumed is 36, and there are 35"),
        ({"shuffle": ..., "drop_last": ...}, "has no drop_last, shuffle"),
    ],
)
def test_a_damaged_position_is_refused(keyed, change, message):
    batches = EpochBatches(keyed, 4)
    changed = batches.state_dict() | change

    with pytest.raises(StateError, match=message):
        batches.load_state_dict({key: each for key, each in changed.items() if each is not ...})


@pytest.mark.parametrize("state", [None, "state"], ids=repr)
def test_what_is_no_dict_is_refused(keyed, state):
    for target in (EpochBatches(keyed, 4), keyed.loader(4)):
        with pytest.raises(StateError, match=r"a state is a dict as .* returns it, got"):
            target.load_state_dict(state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rank": 2, "world_size": 2}, "got rank=2, world_size=2"),
        ({"rank": 1}, "got rank=1, world_size=None"),
        ({"rank": 0.0, "world_size": 2}, "got rank=0.0, world_size=2"),
        ({"rank": False, "world_size": 2}, "got rank=False, world_size=2"),
        ({"drop_last": 1}, "drop_last must be True, False or 'pad', got 1"),
        (
            {"batch_size": 64, "rank": 0, "world_size": 3},
            r"drops all of 140 samples.* 64 for each of 3 ranks",
        ),
    ],
    ids=str,
)
def test_options_that_no_epoch_has_are_refused(keyed, options, message):
    with pytest.raises(SelectionError, match=message):
        EpochBatches(keyed, **({"batch_size": 4} | options))


@pytest.mark.parametrize("kind", [np.int32, torch.tensor])
def test_ranks_may_be_numbers_of_numpy_and_torch(keyed, kind):
    batches = EpochBatches(keyed, 4, rank=kind(1), world_size=kind(2))

    assert [*batches] == [*EpochBatches(keyed, 4, rank=1, world_size=2)]


def test_ranks_without_a_process_group_are_told_that_they_read_the_same(keyed, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")

    with pytest.warns(UnsharedRanksWarning, match="2 ranks .* no process group.*init_proc") as told:
        loader = keyed.loader(4)
    assert told[0].filename == __file__
    assert len(loader) == 35
    keyed.loader(4, rank=0, world_size=1)  # without a word
    monkeypatch.setenv("WORLD_SIZE", "1")
    keyed.loader(4)


def test_batches_made_before_the_process_group_are_refused_in_it(keyed, tmp_path):
    early, told = EpochBatches(keyed, 4), EpochBatches(keyed, 4, rank=1, world_size=2)
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{tmp_path}/group", rank=0, world_size=1
    )
    try:
        assert len(early) == 35
        early.rank, early.world_size = 1, 2
        with pytest.raises(SelectionError, match=r"made for rank 1 of 2, .* after init_process_gr"):
            iter(early)
        assert len(told) == 17
    finally:
        torch.distributed.destroy_process_group()


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")
@pytest.mark.parametrize(("workers", "stop"), [(0, 4), (2, 9)])
def test_torchdatas_loader_saves_and_loads_its_position(keyed, workers, stop):
    keyed.set_epoch(2)

    def loader():
        batches = EpochBatches(keyed, 16, drop_last=False)
        return StatefulDataLoader(keyed, batch_sampler=batches, num_workers=workers)

    unbroken = keys_of(loader())
    broken = loader()
    before = keys_of(itertools.islice(broken, stop))
    state = broken.state_dict()
    keyed.set_epoch(0)
    resumed = loader()
    resumed.load_state_dict(state)
    after = keys_of(resumed)

    assert keyed.epoch == 2
    assert before + after == unbroken
    assert keys_of(resumed) == unbroken
    resumed.batch_sampler.set_epoch(3)
    assert sorted(flat(keys_of(resumed))) == sorted(flat(unbroken))


def test_a_pass_knows_its_length_also_of_the_rest_of_an_epoch(keyed):
    loader = keyed.loader(4)
    state = [loader.state_dict() for _, _ in zip(loader, range(5), strict=False)][-1]
    resumed = keyed.loader(4)
    resumed.load_state_dict(state)

    assert len(iter(resumed)) == len(list(resumed)) == 30
    assert len(iter(resumed)) == len(resumed) == 35
