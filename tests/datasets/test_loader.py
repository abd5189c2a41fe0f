"""The loader: the same order whatever ranks and workers, saved and loaded at any batch."""

import itertools
import json
import time
from collections import Counter, defaultdict
from dataclasses import replace

import pytest
import torch

from stereogenbench_data import (
    ColorJitter,
    Compose,
    HorizontalFlip,
    RandomCrop,
    SceneIndex,
    StereoPairs,
)
from stereogenbench_data.datasets.division import (
    IdleWorkersWarning,
    OpenVideosWarning,
    RepeatedDecodingWarning,
)
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.selection.order import OrderRule
from tests.datasets.conftest import flat, in_turn, keys_of, same

# More workers than this machine has cores are no matter here.
pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


def test_epochs_and_seeds_differ_and_repeat(keyed):
    def epoch(number, **options):
        loader = keyed.loader(9, drop_last=False, **options)
        loader.set_epoch(number)
        return flat(keys_of(loader))

    orders = [epoch(0), epoch(1), epoch(2), epoch(0, seed=1), epoch(1, seed=1)]

    assert len(set(map(tuple, orders))) == 5
    assert len({tuple(sorted(order)) for order in orders}) == 1
    assert epoch(1) == orders[1]


@pytest.mark.parametrize("workers", [0, 1])
def test_loaders_of_one_dataset_leave_each_other_alone(keyed, workers):
    options = {"num_workers": workers, "persistent_workers": workers > 0, "drop_last": False}
    training, validating = keyed.loader(9, **options), keyed.loader(9, **options)
    first = keys_of(validating)
    validating.set_epoch(0)
    training.set_epoch(3)
    begun = iter(training)
    taken = [next(begun)["__key__"]]
    assert keys_of(validating) == first
    validating.load_state_dict(validating.state_dict() | {"epoch": 1, "batches_consumed": 2})
    taken += keys_of(begun)

    assert [training.epoch, validating.epoch, keyed.epoch] == [3, 1, 0]
    keyed.set_epoch(3)
    assert taken == keys_of(keyed.loader(9, drop_last=False))
    keyed.set_epoch(1)
    assert keys_of(validating) == keys_of(keyed.loader(9, drop_last=False))[2:]


def test_a_loader_without_an_epoch_of_its_own_follows_its_dataset(keyed):
    follows, told = keyed.loader(9), keyed.loader(9)
    told.set_epoch(0)
    keyed.set_epoch(2)

    assert [follows.epoch, told.epoch] == [2, 0]
    assert keys_of(follows) == keys_of(keyed.loader(9)) != keys_of(told)


def test_loaders_of_one_dataset_have_their_own_videos(small_index):
    pairs = StereoPairs(small_index, frames="all")
    one, other = pairs.loader(4), pairs.loader(4)
    samples = iter(one)
    next(samples)
    for _ in other:
        pass
    opened = one.stats().videos_open
    other.close()

    assert opened == one.stats().videos_open > 0
    assert pairs.stats().videos_open == 0
    one.close()
    assert one.stats().videos_open == 0
    assert len(list(samples)) == 6


@pytest.mark.parametrize(
    ("before", "after"), [((2, 2), (4, 1)), ((3, 0), (2, 0)), ((1, 3), (3, 2))], ids=str
)
@pytest.mark.parametrize("steps", [0, 3])
def test_a_run_goes_on_under_other_ranks_and_workers(keyed, before, after, steps):
    def loaders(ranks, workers):
        options = {"num_workers": workers, "world_size": ranks, "drop_last": False}
        return [keyed.loader(9, rank=rank, **options) for rank in range(ranks)]

    keyed.set_epoch(4)
    unbroken = keys_of(keyed.loader(9, drop_last=False))
    assert len(set(flat(unbroken))) == 140
    first = loaders(*before)
    taken = [keys_of(itertools.islice(loader, steps)) for loader in first]
    (text,) = {json.dumps(loader.state_dict()) for loader in first}

    left = loaders(*after)
    for loader in left:
        loader.load_state_dict(json.loads(text))
        assert loader.epoch == 4
    start = steps * before[0]
    turned = [left[(start + step) % after[0]] for step in range(after[0])]

    assert in_turn(taken) + in_turn([keys_of(loader) for loader in turned]) == unbroken


def test_every_batch_is_a_place_to_stop(keyed):
    unbroken = keys_of(keyed.loader(9, drop_last=False))
    loader = keyed.loader(9, drop_last=False)
    states = [loader.state_dict(), *(loader.state_dict() for _ in loader)]

    assert [state["batches_consumed"] for state in states] == list(range(17))
    for taken, state in enumerate(states[:-1]):
        resumed = keyed.loader(9, drop_last=False)
        resumed.load_state_dict(state)
        assert resumed.state_dict() == state
        assert keys_of(resumed) == unbroken[taken:]
        assert resumed.state_dict()["batches_consumed"] == 16


@pytest.mark.parametrize("options", [{}, {"num_workers": 2, "persistent_workers": True}], ids=str)
@pytest.mark.parametrize("steps", [3, 15, 16], ids=["left", "stopped at the length", "whole"])
def test_each_pass_is_followed_by_the_next_epoch(keyed, options, steps):
    """A fixed number of steps an epoch sees other samples in each."""
    loader = keyed.loader(9, **options)
    expected = [keyed.set_epoch(epoch) or keys_of(keyed.loader(9)) for epoch in range(4)]
    keyed.set_epoch(0)
    for epoch in range(3):
        assert keys_of(itertools.islice(loader, steps)) == expected[epoch][:steps]
        assert loader.epoch == epoch

    assert keys_of(loader) == expected[3]
    assert [loader.set_epoch(1) or keys_of(loader) for _ in range(2)] == [expected[1]] * 2
    assert keys_of(loader) == expected[2]


def test_in_order_no_sample_is_left_out(keyed):
    loader = keyed.loader(9, num_workers=2, shuffle=False)
    assert len(loader) == 16

    assert flat(keys_of(loader)) == [sample["__key__"] for sample in keyed]
    assert len(keyed.loader(9)) == 15
    assert len(keyed.loader(9, shuffle=False, drop_last=True)) == 15


@pytest.mark.parametrize(
    ("drop_last", "steps", "epoch", "left"),
    [
        (False, 9, 1, [6, 5, 5]),
        ("pad", 9, 1, [6, 6, 6]),
        (True, 9, 1, [5, 5, 5]),
        (False, 5, 0, [1, 0, 0]),
    ],
)
def test_ranks_that_save_are_in_one_epoch_though_one_has_no_more(
    keyed, drop_last, steps, epoch, left
):
    resumed = []
    for rank in range(3):
        options = {"rank": rank, "world_size": 3, "drop_last": drop_last}
        loader = keyed.loader(9, **options)
        for _ in itertools.islice(loader, steps):
            pass
        resumed.append(keyed.loader(9, **options))
        resumed[-1].load_state_dict(loader.state_dict())

    assert [loader.epoch for loader in resumed] == [epoch] * 3
    assert [len(list(loader)) for loader in resumed] == left


@pytest.mark.parametrize("options", [{}, {"num_workers": 2, "persistent_workers": True}], ids=str)
def test_the_epochs_after_a_resumed_one_are_whole(keyed, options):
    first, second = (keyed.set_epoch(epoch) or keys_of(keyed.loader(9)) for epoch in (0, 1))
    loader = keyed.loader(9, **options)
    loader.set_epoch(0)
    next(iter(loader))
    loader.load_state_dict(loader.state_dict() | {"batches_consumed": 6})
    loader.set_epoch(loader.epoch)

    assert keys_of(loader) == first[6:]
    assert keys_of(loader) == second
    loader.set_epoch(0)
    assert keys_of(loader) == first


def test_samples_of_a_resumed_run_are_the_same_to_the_bit(small_index):
    pairs = StereoPairs(
        small_index,
        fields=("left", "disparity", "__key__"),
        frames=("random", 3),
        transform=Compose([HorizontalFlip(), RandomCrop(32, 32), ColorJitter()]),
    )
    pairs.set_epoch(2)
    unbroken = list(pairs.loader(4))
    loader = pairs.loader(4, num_workers=1)
    loader.load_state_dict(pairs.loader(4).state_dict() | {"batches_consumed": 1})

    assert all(same(one, other) for one, other in zip(unbroken[1:], loader, strict=True))


def test_padding_is_flagged_and_ranks_are_even(keyed):
    shares = [
        list(keyed.loader(9, rank=rank, world_size=3, drop_last="pad", num_workers=rank))
        for rank in range(3)
    ]
    batches = in_turn(shares)
    paddings = flat(batch["is_padding"].tolist() for batch in batches)
    keys = zip(flat(keys_of(batches)), paddings, strict=True)
    own = [key for key, is_padding in keys if not is_padding]

    assert [len(share) for share in shares] == [6, 6, 6]
    assert batches[0]["is_padding"].dtype == torch.bool
    assert {tuple(batch["is_padding"].shape) for batch in batches} == {(9,)}
    assert len(own) == len(set(own)) == 140
    assert "is_padding" not in next(iter(keyed.loader(9)))


def test_a_loader_says_what_it_holds(small_index):
    pairs = StereoPairs(small_index, fields=("left",), frames="all")
    loader = pairs.loader(2, num_workers=2, persistent_workers=True)
    before = loader.stats()
    list(itertools.islice(loader, 4))
    after = loader.stats()
    loader.close()

    assert (before.epoch, before.batches_taken, before.workers) == (0, 0, 0)
    assert (after.batches_taken, after.workers, after.videos_open) == (4, 2, 0)
    assert loader.stats().workers == 0


def test_a_loader_says_which_share_of_the_time_the_loop_waited(keyed):
    loader = keyed.loader(9)
    before = loader.stats().waiting
    for _ in loader:
        time.sleep(0.05)
    slow_loop = loader.stats().waiting
    for _ in loader:
        pass
    idle_loop = loader.stats().waiting

    assert 0 == before < slow_loop < idle_loop <= 1


@pytest.mark.parametrize("world", [1, 2])
def test_each_frame_is_decoded_once_and_scenes_are_opened_again_for_their_beginning_alone(
    small_index, read, world
):
    """A scene that is started inside is decoded to its end and then its beginning."""
    for rank in range(world):
        pairs = StereoPairs(small_index, pairs="all", frames="all")
        loader = pairs.loader(2, shuffle_groups=world, rank=rank, world_size=world, drop_last=False)
        for _ in loader:
            pass
    frames = defaultdict(list)
    for name, found in read:
        frames[name] += found

    assert len(frames) == 4 * 11
    assert max(Counter(name for name, _ in read).values()) <= 2
    turns = [[*range(start, 7), *range(start)] for start in range(7)]
    assert all(found in turns for found in frames.values() if world == 1)
    assert {tuple(sorted(found)) for found in frames.values()} == {tuple(range(7))}


def test_a_scene_that_is_parted_between_groups_is_read_forwards_in_each(small_index, read):
    """One process reads both groups; one decoder for them would go to and fro."""
    pairs = StereoPairs(small_index, frames="all", fields=("left",))
    loader = pairs.loader(6, drop_last=False, shuffle_groups=2)
    order = loader.batches.of_all_ranks.order(0)
    assert order.groups == 2
    groups = [
        {n // 7 for number in range(group, order.batches, 2) for n in order.batch(number).tolist()}
        for group in (0, 1)
    ]
    assert len(groups[0] & groups[1]) == 1
    for _ in loader:
        pass

    assert all(found == sorted(found) for _, found in read)
    assert sum(len(found) for _, found in read) == 4 * 7


def test_videos_are_closed_after_their_scenes_last_sample(small_index):
    pairs = StereoPairs(small_index, pairs="all", frames="all")
    loader = pairs.loader(2, shuffle_groups=1, open_scenes=1, drop_last=False)
    most = 0
    for _ in loader:
        most = max(most, loader.stats().videos_open)

    assert most == 11
    assert loader.stats().videos_open == 0


def test_too_many_open_videos_are_warned_of(small_index, monkeypatch):
    monkeypatch.setattr("resource.getrlimit", lambda which: (160, 160))
    pairs = StereoPairs(small_index, pairs="all", frames="all")

    with pytest.warns(OpenVideosWarning, match=r"up to 44 videos .* may open 32.*ulimit -n 172"):
        loader = pairs.loader(4)
    for _ in itertools.islice(loader, 21):
        assert loader.stats().videos_open <= loader.stats().videos_limit == 32
    assert pairs.loader(4, num_workers=2).num_workers == 2  # of half as many videos each


def test_ranks_that_decode_the_same_videos_are_warned_of(small_index):
    pairs = StereoPairs(small_index, frames=range(2), fields=("left",))
    said = r"decoded 2 times, as 2 processes read 1 .* of 4 runs .* Use fewer ranks or a smaller"
    with pytest.warns(RepeatedDecodingWarning, match=said):
        pairs.loader(4, rank=1, world_size=2)

    assert pairs.loader(2, rank=1, world_size=2).batches.rule.shuffle_groups == 2
    assert pairs.loader(4, rank=1, world_size=2, shuffle_groups=2).batches.world_size == 2


def test_workers_who_have_nothing_to_do_are_warned_of(small_index):
    pairs = StereoPairs(small_index, frames="all", fields=("left", "__key__"))
    said = "3 of 7 workers have nothing to do: a rank has 4 scenes open.* Use num_workers=4, or"
    with pytest.warns(IdleWorkersWarning, match=said):
        loader = pairs.loader(4, num_workers=7)
    assert keys_of(loader) == keys_of(pairs.loader(4, num_workers=4))


@pytest.mark.parametrize(
    ("side_px", "selection", "expected", "shuffle_groups", "frames_of_32"),
    [
        (1280, {}, 8, 8, 1),
        (1280, {"pairs": "all"}, 4, 4, 2),
        (480, {"pairs": "all"}, 13, 8, 1),
        (8192, {"pairs": "all"}, 2, 1, 1),
    ],
    ids=str,
)
def test_scenes_of_large_pictures_are_interleaved_in_smaller_numbers(
    small_index, side_px, selection, expected, shuffle_groups, frames_of_32
):
    scenes = []
    for number in range(100):
        scene = small_index.scene(number % 4)
        rig = replace(scene.rig, image_width_px=side_px, image_height_px=side_px)
        scenes.append(replace(scene, id=parse_scene_key(f"{scene.id.key}{number}"), rig=rig))
    index = SceneIndex.from_scenes(scenes, small_index.root)
    options = {"frames": "all", "fields": ("__key__",), **selection}
    pairs = StereoPairs(index, **options)

    assert pairs.loader(4).batches.rule.open_scenes == expected
    assert pairs.loader(4).batches.rule.open_frames == 1
    assert pairs.loader(32).batches.rule.open_frames == frames_of_32
    assert pairs.loader(4).batches.rule.shuffle_groups == shuffle_groups
    assert pairs.loader(4, num_workers=3).batches.rule == pairs.loader(4).batches.rule
    others = StereoPairs(index, **(options | {"fields": ("depth",)}))
    assert others.loader(4).batches.rule == pairs.loader(4).batches.rule
    given = pairs.loader(4, open_scenes=7, shuffle_groups=6, open_frames=2).batches.rule
    assert given == OrderRule(4, shuffle_groups=6, open_scenes=7, open_frames=2)
