"""The order of an epoch, as arithmetic: no data, no torch."""

import hashlib
import itertools
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.selection.order import (
    EpochOrder,
    OrderRule,
    last_batch,
    order_quality,
    rank_share,
)

WORLDS, WORKERS = range(1, 6), range(5)
KINDS = ("shuffled", "sequential")


def order_of(lengths, *, epoch=0, **rule):
    """Return the order of scenes with so many samples each."""
    first_sample = np.concatenate([[0], np.cumsum(lengths)])
    return EpochOrder(first_sample, OrderRule(**({"batch_size": 16} | rule)), epoch=epoch)


def all_batches(order):
    return [order.batch(number).tolist() for number in range(order.batches)]


def flat(batches):
    return list(itertools.chain.from_iterable(batches))


def by_worker(numbers, *, workers):
    """Deal a rank's batches as torch's DataLoader does: each worker's list of them."""
    return [numbers[worker :: max(1, workers)] for worker in range(max(1, workers))]


def rows_of(shares):
    """Return what the ranks get step by step."""
    return [
        [number for number in row if number is not None] for row in itertools.zip_longest(*shares)
    ]


lengths_of_scenes = st.lists(st.integers(1, 30), min_size=1, max_size=40)
rules = st.fixed_dictionaries(
    {
        "batch_size": st.integers(1, 20),
        "shuffle_groups": st.integers(1, 6),
        "open_scenes": st.integers(1, 20),
        "seed": st.integers(0, 2**70),
        "epoch": st.integers(0, 9),
        "kind": st.sampled_from(KINDS),
    }
)


@given(lengths=lengths_of_scenes, rule=rules)
@settings(deadline=None, max_examples=150)
def test_every_sample_is_in_one_batch_and_only_the_last_batch_is_short(lengths, rule):
    order = order_of(lengths, **rule)
    batches = all_batches(order)

    assert sorted(flat(batches)) == list(range(sum(lengths)))
    assert all(len(batch) == rule["batch_size"] for batch in batches[:-1])
    assert 0 < len(batches[-1]) <= rule["batch_size"]


@given(lengths=lengths_of_scenes, rule=rules)
@settings(deadline=None, max_examples=100)
def test_a_group_reads_each_of_its_scenes_forwards_and_few_are_in_two_groups(lengths, rule):
    order = order_of(lengths, **(rule | {"kind": "shuffled"}))
    groups_of_scene = {}
    for group in range(order.groups):
        numbers = order.group(group)
        scenes = order.scenes_of(numbers)
        for scene in set(scenes.tolist()):
            own = numbers[scenes == scene]
            assert (np.diff(own) == 1).all()
            groups_of_scene.setdefault(scene, []).append(group)

    parts = sum(map(len, groups_of_scene.values()))
    assert len(groups_of_scene) == len(lengths)
    assert parts - len(lengths) <= order.groups - 1


@given(lengths=lengths_of_scenes, rule=rules)
@settings(deadline=None, max_examples=100)
def test_no_more_scenes_are_open_in_a_group_than_announced(lengths, rule):
    order = order_of([7] * len(lengths), **(rule | {"kind": "shuffled"}))
    most = order.rule.most_open(np.full(len(lengths), 7))
    for group in range(order.groups):
        scenes = order.scenes_of(order.group(group)).tolist()
        first = {scene: scenes.index(scene) for scene in set(scenes)}
        last = {scene: len(scenes) - scenes[::-1].index(scene) for scene in first}
        for place in range(len(scenes)):
            assert sum(first[scene] <= place < last[scene] for scene in first) <= most


@pytest.mark.parametrize("scenes", [3, 10, 13, 64, 2123])
@pytest.mark.parametrize("open_scenes", [1, 2, 4, 5, 15])
def test_a_small_number_of_open_scenes_is_reached_and_never_exceeded(scenes, open_scenes):
    order = order_of([7] * scenes, batch_size=1, shuffle_groups=1, open_scenes=open_scenes)
    found = order.scenes_of(order.group(0))
    first = np.array([np.flatnonzero(found == scene)[0] for scene in range(scenes)])
    last = np.array([np.flatnonzero(found == scene)[-1] for scene in range(scenes)])
    opened = np.searchsorted(np.sort(first), np.arange(len(found)), side="right")
    closed = np.searchsorted(np.sort(last), np.arange(len(found)))

    assert (opened - closed).max() == min(scenes, open_scenes)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("batch_size", [1, 3, 8])
@pytest.mark.parametrize("epoch", [0, 1, 5])
def test_ranks_and_workers_share_the_same_global_batches_out(kind, batch_size, epoch):
    order = order_of([5, 9, 2, 7, 7, 1, 12], batch_size=batch_size, epoch=epoch, kind=kind)
    expected = all_batches(order)
    for world, workers in itertools.product(WORLDS, WORKERS):
        end = last_batch(43, batch_size=batch_size, tail="uneven", world_size=world)
        seen = {}
        for rank in range(world):
            share = rank_share(0, end, rank=rank, world_size=world)
            for numbers in by_worker(share, workers=workers):
                for number in numbers:
                    assert number not in seen
                    seen[number] = order.batch(number).tolist()

        assert [seen[number] for number in sorted(seen)] == expected
        assert sorted(flat(expected)) == list(range(43))


def test_a_run_stopped_at_any_batch_goes_on_under_any_other_world():
    order = order_of([5, 9, 2, 7, 7, 1, 12], batch_size=3)
    unbroken = all_batches(order)
    for before, after in itertools.product(WORLDS, WORLDS):
        for steps in range(order.batches // before + 1):
            start = steps * before
            end = last_batch(43, batch_size=3, tail="uneven", world_size=after, start=start)
            shares = [rank_share(start, end, rank=rank, world_size=after) for rank in range(after)]
            steps_after = [sorted(row) for row in rows_of(shares)]

            assert [order.batch(n).tolist() for n in flat(steps_after)] == unbroken[start:]


@pytest.mark.parametrize("start", [0, 1, 4, 7, 13, 14, 15])
@pytest.mark.parametrize("world", WORLDS)
def test_each_step_takes_the_next_batches_in_turn(world, start):
    end = last_batch(43, batch_size=3, tail="uneven", world_size=world, start=start)
    shares = [rank_share(start, end, rank=rank, world_size=world) for rank in range(world)]
    rows = rows_of(shares)

    assert all(number % world == rank for rank in range(world) for number in shares[rank])
    assert [sorted(row) for row in rows] == [
        list(range(first, min(first + world, end))) for first in range(start, end, world)
    ]


@pytest.mark.parametrize("start", [0, 1, 4, 13, 14, 15])
@pytest.mark.parametrize("world", WORLDS)
def test_drop_and_wrap_give_every_rank_as_many_batches(world, start):
    ends = {
        tail: last_batch(43, batch_size=3, tail=tail, world_size=world, start=start)
        for tail in ("drop", "wrap", "uneven")
    }
    for tail in ("drop", "wrap"):
        shares = [
            rank_share(start, ends[tail], rank=rank, world_size=world) for rank in range(world)
        ]
        assert len(set(map(len, shares))) == 1

    assert ends["drop"] <= max(start, 14)
    assert max(start, 14) - ends["drop"] < world
    assert 0 <= ends["wrap"] - ends["uneven"] < world


def test_an_unknown_tail_is_refused():
    with pytest.raises(SelectionError, match="tail must be 'drop', 'wrap' or 'uneven', got 'keep'"):
        last_batch(1, batch_size=1, tail="keep", world_size=1)


def test_wrapped_batches_go_on_from_the_epochs_start():
    order = order_of([5, 9, 2, 7, 7, 1, 12], batch_size=5)
    epoch = flat(all_batches(order))
    wrapped = flat(order.full_batch(number).tolist() for number in range(20))

    assert order.batches == 9
    assert wrapped == (epoch * 3)[:100]


def test_two_seeds_and_two_epochs_differ_from_the_first_epoch_on():
    orders = {
        (seed, epoch): tuple(flat(all_batches(order_of([6] * 20, seed=seed, epoch=epoch))))
        for seed, epoch in itertools.product(range(4), range(4))
    }

    assert len(set(orders.values())) == 16


def test_the_order_of_version_2_never_changes():
    """If this fails, orders that users have saved positions in have changed: see ORDER_VERSION."""
    order = order_of(
        [3, 4, 5, 4, 3, 4, 5, 4], batch_size=4, shuffle_groups=2, open_scenes=2, seed=7, epoch=3
    )

    assert all_batches(order) == PINNED

    long = order_of(np.arange(150) % 11 + 20, seed=2**40, epoch=1)
    numbers = np.array(flat(all_batches(long)), dtype="<i8")
    assert hashlib.sha256(numbers.tobytes()).hexdigest() == PINNED_SHA256


PINNED_SHA256 = "61ce2c7cdae1609b7d9ed3fd51348f400b52d1f6b56ee0b0c34bf63713661be3"
PINNED = [
    [0, 28, 1, 29],
    [16, 20, 17, 21],
    [2, 30, 3, 31],
    [18, 22, 7, 23],
    [4, 12, 5, 13],
    [8, 24, 9, 25],
    [6, 14, 19, 15],
    [10, 26, 11, 27],
]


def test_a_sequential_order_is_that_of_the_numbers():
    order = order_of([3, 5, 2], batch_size=4, kind="sequential")

    assert all_batches(order) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]


@pytest.mark.parametrize("scenes", [64, 65, 71, 79, 90, 127, 128, 150, 400])
@pytest.mark.parametrize("lengths", ["one", "few", "frames", "about as many", "some pairs"])
def test_a_batch_of_16_holds_at_least_12_scenes_of_64_or_more(scenes, lengths):
    generator = np.random.default_rng(scenes)
    found = {
        "one": np.full(scenes, 1),
        "few": np.full(scenes, 3),
        "frames": np.full(scenes, 81),
        "about as many": generator.integers(60, 100, scenes),
        "some pairs": generator.integers(1, 16, scenes) * 9,
    }[lengths]
    for seed in range(3):
        assert order_quality(order_of(found, seed=seed, epoch=seed)).fewest_scenes >= 12


def test_neighbours_are_hardly_correlated():
    order = order_of([81] * 2000, batch_size=16)
    quality = order_quality(order)

    assert abs(quality.neighbour_correlation) < 0.03
    assert quality.mean_scenes > 15.5
    assert order_quality(order_of([81] * 2000, kind="sequential")).neighbour_correlation > 0.99


def test_frames_of_a_batch_come_from_all_over_their_scenes():
    order = order_of([81] * 2000, batch_size=16)
    frames = np.array([order.batch(number) % 81 for number in range(2000, 4000)])

    assert frames.std(axis=1).mean() > 0.8 * np.arange(81).std()


@pytest.mark.parametrize(
    ("scenes", "groups"), [(1, 1), (3, 1), (4, 2), (15, 2), (63, 2), (64, 4), (9000, 4)]
)
def test_small_selections_have_fewer_groups(scenes, groups):
    assert order_of([5] * scenes).groups == groups


def test_the_whole_release_is_ordered_within_seconds():
    order = order_of([81 * 15] * 8493, batch_size=16)
    began = time.perf_counter()
    sizes = [len(order.group(group)) for group in range(order.groups)]

    assert sum(sizes) == 10_318_995
    assert time.perf_counter() - began < 10


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"batch_size": 0}, "batch_size must be a whole number from 1, got 0"),
        ({"batch_size": 2.0}, r"batch_size must be a whole number from 1, got 2\.0"),
        ({"shuffle_groups": True}, "shuffle_groups must be a whole number from 1, got True"),
        ({"open_scenes": 0}, "open_scenes must be a whole number from 1, got 0"),
        ({"seed": -1}, "seed must be a whole number from 0, got -1"),
        ({"kind": "random"}, "order must be 'shuffled' or 'sequential', got 'random'"),
    ],
    ids=str,
)
def test_a_rule_that_orders_nothing_is_refused(rule, message):
    with pytest.raises(SelectionError, match=message):
        OrderRule(**({"batch_size": 4} | rule))


@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=40),
    size=st.integers(1, 6),
    asked=st.lists(st.tuples(st.integers(1, 6), st.integers(1, 24)), min_size=2, max_size=6),
    kind=st.sampled_from(KINDS),
)
@settings(deadline=None, max_examples=60)
def test_rules_that_are_the_same_in_effect_give_the_same_order(lengths, size, asked, kind):
    found = {}
    for shuffle_groups, open_scenes in asked:
        rule = OrderRule(
            batch_size=size, shuffle_groups=shuffle_groups, open_scenes=open_scenes, kind=kind
        )
        batches = all_batches(EpochOrder(np.concatenate([[0], np.cumsum(lengths)]), rule, epoch=0))

        assert found.setdefault(rule.in_effect(np.array(lengths)), batches) == batches


@pytest.mark.parametrize("number", [-1, 9])
def test_a_batch_beyond_the_last_is_an_index_error(number):
    with pytest.raises(IndexError, match=f"no batch {number}: the epoch has 9"):
        order_of([43], batch_size=5).batch(number)
