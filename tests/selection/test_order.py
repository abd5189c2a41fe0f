"""The order of an epoch, as arithmetic: no data, no torch."""

import hashlib
import itertools
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.selection.order import (
    EpochOrder,
    OrderRule,
    Runs,
    groups_for,
    last_batch,
    open_runs_for,
    rank_share,
)

WORLDS = range(1, 6)


def runs_of(lengths, *, pairs=1, key_distance=1):
    """Return runs with so many moments each, of each of which there are so many pairs."""
    first_sample = np.concatenate([[0], np.cumsum(np.array(lengths) * pairs)])
    count = len(lengths)
    return Runs(first_sample, np.full(count, pairs), np.full(count, key_distance))


def order_of(lengths, *, pairs=1, key_distance=1, epoch=0, **rule):
    """Return the order of runs with so many moments each."""
    rule = OrderRule(**({"batch_size": 16} | rule))
    return EpochOrder(runs_of(lengths, pairs=pairs, key_distance=key_distance), rule, epoch=epoch)


NO_LIMIT = 10**6
"""So many open runs fit into memory."""


def usual_order(lengths, batch_size, *, world_size=1, fitting=NO_LIMIT, **options):
    """Return the order that runs have where nobody asks for groups or open runs."""
    key_distance = options.pop("key_distance", 1)
    runs = runs_of(lengths, pairs=options.pop("pairs", 1), key_distance=key_distance)
    groups = groups_for(runs, batch_size=batch_size, fitting=fitting, world_size=world_size)
    opened = open_runs_for(runs, batch_size=batch_size, fitting=fitting, groups=groups)
    seed, epoch = options.get("seed", 0), options.get("epoch", 0)
    rule = OrderRule(batch_size, seed=seed, shuffle_groups=groups, open_scenes=opened)
    return EpochOrder(runs, rule, epoch=epoch)


def run_of(order, numbers):
    """Return which run each sample belongs to."""
    return np.searchsorted(order.runs.first_sample, numbers, side="right") - 1


def all_batches(order):
    return [order.batch(number).tolist() for number in range(order.batches)]


def flat(batches):
    return list(itertools.chain.from_iterable(batches))


lengths_of_scenes = st.lists(st.integers(1, 30), min_size=1, max_size=40)
rules = st.fixed_dictionaries(
    {
        "batch_size": st.integers(1, 20),
        "shuffle_groups": st.integers(1, 6),
        "open_scenes": st.integers(1, 20),
        "open_frames": st.integers(1, 5),
        "pairs": st.sampled_from([1, 1, 3, 15]),
        "seed": st.integers(0, 2**70),
        "epoch": st.integers(0, 9),
        "shuffle": st.booleans(),
    }
)


@given(lengths=lengths_of_scenes, rule=rules)
@settings(max_examples=80)
def test_every_sample_is_in_one_batch_and_only_the_last_batch_is_short(lengths, rule):
    order = order_of(lengths, **rule)
    batches = all_batches(order)

    assert sorted(flat(batches)) == list(range(sum(lengths) * rule["pairs"]))
    assert all(len(batch) == rule["batch_size"] for batch in batches[:-1])
    assert 0 < len(batches[-1]) <= rule["batch_size"]


def group_of(order, group):
    """Return the samples of a shuffle group, in order."""
    batches = [order.batch(n) for n in range(group, order.batches, order.groups)]
    return np.concatenate([np.empty(0, dtype=np.int64), *batches])


def pieces_of(order, group):
    """Return the group's samples, part by part of its runs, in order."""
    numbers = group_of(order, group)
    runs = run_of(order, numbers)
    return {run: numbers[runs == run] for run in set(runs.tolist())}


def parts_of(order, group, *, pairs):
    """Return the same where a run that a stream starts inside is two: to its end, and from it."""
    for run, numbers in pieces_of(order, group).items():
        blocks = (numbers - order.runs.first_sample[run]) // pairs
        if pairs > 1:
            blocks = blocks // order.rule.open_frames
        yield from (
            (run, part) for part in np.split(numbers, 1 + np.flatnonzero(np.diff(blocks) < 0))
        )


@given(lengths=lengths_of_scenes, rule=rules)
@settings(max_examples=40)
def test_moments_of_a_run_ascend_but_for_where_a_stream_starts(lengths, rule):
    order = order_of(lengths, **(rule | {"shuffle": True, "open_frames": 1}))
    parts, goes_back = 0, 0
    for group in range(order.groups):
        for run, numbers in pieces_of(order, group).items():
            moments = (numbers - order.runs.first_sample[run]) // rule["pairs"]
            goes_back += int((np.diff(moments) < 0).sum())
            assert (np.diff(moments) < 0).sum() <= 1
            parts += 1

    assert goes_back <= order.open_runs()
    assert parts - len(lengths) <= order.groups - 1


@given(lengths=lengths_of_scenes, rule=rules)
@settings(max_examples=60)
def test_the_last_sample_of_each_part_of_a_run_is_marked(lengths, rule):
    order = order_of(lengths, **rule)
    seen, wanted = set(), set()
    for number in range(order.batches):
        batch = order.described(number)
        seen |= set(batch.samples[batch.ends_run].tolist())
    if not order.rule.shuffle:
        wanted = set((order.runs.first_sample[1:] - 1).tolist())
    else:
        for group in range(order.groups):
            parts = parts_of(order, group, pairs=rule["pairs"])
            wanted |= {int(numbers[-1]) for _, numbers in parts}

    assert seen == wanted


@pytest.mark.parametrize("runs", [3, 13, 2123])
@pytest.mark.parametrize("open_scenes", [1, 4, 15, 64])
def test_the_number_of_open_runs_is_reached_and_never_exceeded(runs, open_scenes):
    order = order_of([7] * runs, batch_size=1, shuffle_groups=1, open_scenes=open_scenes)
    numbers = group_of(order, 0)
    place = np.argsort(numbers)
    parts = [part for _, part in parts_of(order, 0, pairs=1)]
    first, last = (np.sort([place[part[end]] for part in parts]) for end in (0, -1))
    opened = np.searchsorted(first, np.arange(len(numbers)), side="right")
    closed = np.searchsorted(last, np.arange(len(numbers)))

    assert (opened - closed).max() == order.open_runs([0]) == min(runs, open_scenes)


@pytest.mark.parametrize("batches", [1, 15, 40])
def test_ranks_share_what_is_left_of_an_epoch_in_order_and_exactly_once(batches):
    """Whichever world stopped before, after any of its steps."""
    for before, world in itertools.product(WORLDS, WORLDS):
        for start in range(0, batches + 1, before):
            options = {"drop_last": False, "world_size": world, "start": start}
            end = last_batch(3 * batches - 1, batch_size=3, **options)
            shares = [rank_share(start, end, rank=rank, world_size=world) for rank in range(world)]

            steps = itertools.zip_longest(*shares)
            given = [sorted(n for n in step if n is not None) for step in steps]
            assert flat(given) == list(range(start, batches))


@pytest.mark.parametrize("start", [0, 13])
@pytest.mark.parametrize("world", WORLDS)
def test_dropping_and_padding_give_every_rank_as_many_batches(world, start):
    ends = {
        each: last_batch(43, batch_size=3, drop_last=each, world_size=world, start=start)
        for each in (True, "pad", False)
    }
    for each in (True, "pad"):
        shares = [
            rank_share(start, ends[each], rank=rank, world_size=world) for rank in range(world)
        ]
        assert len(set(map(len, shares))) == 1

    assert ends[True] <= max(start, 14)
    assert max(start, 14) - ends[True] < world
    assert 0 <= ends["pad"] - ends[False] < world


def test_wrapped_batches_go_on_from_the_epochs_start():
    order = order_of([5, 9, 2, 7, 7, 1, 12], batch_size=5)
    epoch = flat(all_batches(order))
    wrapped = flat(order.full_batch(number).tolist() for number in range(20))

    assert order.batches == 9
    assert wrapped == (epoch * 3)[:100]


def test_the_order_of_version_5_never_changes():
    """If this fails, orders that users have saved positions in have changed: see ORDER_VERSION."""
    order = order_of(
        [3, 4, 5, 4, 3, 4, 5, 4], batch_size=4, shuffle_groups=2, open_scenes=2, seed=7, epoch=3
    )

    assert all_batches(order) == PINNED

    long = order_of(np.arange(150) % 11 + 20, seed=2**40, epoch=1, pairs=3, open_frames=2)
    numbers = np.array(flat(all_batches(long)), dtype="<i8")
    assert hashlib.sha256(numbers.tobytes()).hexdigest() == PINNED_SHA256


def test_how_much_is_ordered_at_a_time_changes_nothing(monkeypatch):
    lengths = np.arange(40) % 7 + 5
    whole = all_batches(order_of(lengths, pairs=3, batch_size=5, shuffle_groups=2))
    monkeypatch.setattr("stereogenbench_data.selection.order._CHUNK", 7)

    assert all_batches(order_of(lengths, pairs=3, batch_size=5, shuffle_groups=2)) == whole


PINNED_SHA256 = "6975469ad1221e0a5077bba3484393b0a72b2bd242cc31931861594000322c89"
PINNED = [
    [2, 28, 3, 29],
    [16, 22, 17, 23],
    [4, 30, 5, 31],
    [18, 24, 7, 25],
    [6, 12, 19, 13],
    [8, 26, 9, 27],
    [0, 14, 1, 15],
    [10, 20, 11, 21],
]


def test_a_sequential_order_is_that_of_the_numbers():
    order = order_of([3, 5, 2], batch_size=4, shuffle=False)

    assert all_batches(order) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]


def shown(order, batches, *, pairs=1, frames=81):
    """Return moments and frame numbers of batches, (b, n) each, of scenes of such runs."""
    moments = np.array([order.batch(number) for number in batches]) // pairs
    return moments, moments % frames


def different(values):
    return np.array([len(set(row)) for row in values.tolist()])


@pytest.mark.parametrize("scenes", [64, 400])
@pytest.mark.parametrize("lengths", ["frames", "some pairs"])
def test_a_batch_of_16_holds_at_least_12_scenes_of_64_or_more(scenes, lengths):
    generator = np.random.default_rng(scenes)
    found = {
        "frames": np.full(scenes, 81),
        "some pairs": generator.integers(1, 16, scenes) * 9,
    }[lengths]
    for seed in range(3):
        order = usual_order(found, 16, seed=seed, epoch=seed)
        batches = range(min(1000, order.samples // 16))
        runs = run_of(order, np.array([order.batch(number) for number in batches]))
        assert different(runs).min() >= 12


INDEPENDENT = np.random.default_rng(0).integers(0, 81, (4000, 16)).std(axis=1).mean()
"""The spread of 16 frame numbers of 81 that are drawn independently, on average."""


@pytest.mark.parametrize("scenes", [64, 2000])
def test_whole_scenes_are_not_in_step(scenes):
    order = usual_order([81] * scenes, 16)
    _, frames = shown(order, range(min(2000, order.samples // 16)))
    spread = frames.std(axis=1)

    assert spread.mean() > 0.9 * INDEPENDENT
    assert spread.min() > 0.5 * INDEPENDENT
    assert spread[0] > 0.8 * INDEPENDENT


def test_moments_of_few_open_scenes_are_interleaved():
    options = {"pairs": 15, "shuffle_groups": 2, "open_scenes": 3}
    few = order_of([81] * 64, **options)
    more = order_of([81] * 64, **options, open_frames=4)
    moments = [different(shown(each, range(800), pairs=15)[0]).mean() for each in (few, more)]

    assert moments[0] < 5
    assert moments[1] > 12
    pairs = [set((more.batch(number) % 15).tolist()) for number in range(100)]
    assert np.mean([len(each) for each in pairs]) > 4


@pytest.mark.parametrize(("pairs", "open_frames"), [(1, 1), (15, 1), (15, 3)])
def test_streams_start_where_decoding_can_begin(pairs, open_frames):
    """What lies between a key frame and a start would be decoded twice."""
    order = order_of([24] * 64, pairs=pairs, key_distance=4, open_frames=open_frames)
    for group in range(order.groups):
        for run, numbers in pieces_of(order, group).items():
            moments = (numbers - order.runs.first_sample[run]) // pairs // open_frames
            starts = np.concatenate([moments[:1], moments[1:][np.diff(moments) < 0]])

            assert all(start * open_frames % 4 == 0 for start in starts.tolist())


@given(lengths=lengths_of_scenes, rule=rules)
@settings(max_examples=40)
def test_in_a_block_each_pair_is_read_at_ascending_moments(lengths, rule):
    """Else a camera would go back to decode a moment that it had passed."""
    order = order_of(lengths, **(rule | {"shuffle": True, "pairs": 3}))
    for group in range(order.groups):
        for run, numbers in parts_of(order, group, pairs=3):
            moments, pairs = np.divmod(numbers - order.runs.first_sample[run], 3)
            for pair in range(3):
                assert (np.diff(moments[pairs == pair]) > 0).all()


@pytest.mark.parametrize(
    ("scenes", "groups"), [(1, 1), (3, 1), (4, 2), (15, 2), (47, 4), (64, 8), (9000, 8)]
)
def test_small_selections_have_fewer_groups_than_were_asked_for(scenes, groups):
    assert order_of([5] * scenes, batch_size=8).groups == groups


@pytest.mark.parametrize(
    ("scenes", "batch_size", "fitting", "expected"),
    [
        (64, 8, NO_LIMIT, (8, 8)),
        (7754, 8, NO_LIMIT, (8, 8)),
        (7754, 16, NO_LIMIT, (4, 16)),
        (7754, 24, NO_LIMIT, (2, 32)),
        (7754, 100, NO_LIMIT, (1, 100)),
        (7754, 1, NO_LIMIT, (8, 8)),
        (7754, 8, 17, (2, 8)),
        (500, 8, NO_LIMIT, (8, 9)),
        (500, 8, 64, (8, 8)),
        (100, 16, NO_LIMIT, (4, 25)),
        (4, 8, NO_LIMIT, (1, 4)),
    ],
)
def test_about_64_runs_are_open_in_groups_that_fill_a_batch(scenes, batch_size, fitting, expected):
    """As far as memory allows; with few runs a stream some more, so that streams are even."""
    order = usual_order([81] * scenes, batch_size, fitting=fitting)

    assert (order.groups, order.rule.open_scenes) == expected


@pytest.mark.parametrize(
    ("ranks", "groups"), [(1, 8), (2, 8), (4, 8), (8, 8), (3, 9), (64, 64), (969, 969), (970, 8)]
)
def test_groups_are_raised_to_a_multiple_of_the_ranks_while_their_batches_have_scenes(
    ranks, groups
):
    assert usual_order([81] * 7754, 8, world_size=ranks).groups == groups


def packets_of(order, *, ranks, workers, pairs=1, key_distance=None):
    """Return how many packets workers decode for each moment, of one camera that all pairs show.

    Every worker keeps a video open from the first of its samples to the last of a part. Runs begin
    with a key frame, and have others at a distance.
    """
    apart = np.gcd(order.groups, ranks)
    packets = 0
    for rank in range(ranks):
        groups = range(rank % apart, order.groups, apart)
        reached = {}
        for number in range(rank, order.batches, ranks):
            batch = order.described(number)
            own = order.workers_of(number, groups=groups, workers=workers)
            runs = run_of(order, batch.samples)
            places = (batch.samples - order.runs.first_sample[runs]) // pairs
            for sample in zip(
                own.tolist(), runs.tolist(), places.tolist(), batch.ends_run.tolist(), strict=True
            ):
                worker, run, place, ends_run = sample
                video = worker, number % order.groups, run
                before = reached.get(video, -1)
                # A decoder that is behind goes on; another one begins at the key frame before.
                skipped = place % key_distance if key_distance else place
                if place != before:
                    goes_on = before < place <= before + skipped + 1
                    packets += place - before if goes_on else skipped + 1
                reached[video] = place
                if ends_run:
                    del reached[video]
    return packets / (order.samples / pairs)


@pytest.mark.parametrize(
    ("scenes", "batch_size", "ranks", "workers", "most"),
    [
        (64, 8, 1, 3, 1.35),
        (64, 8, 2, 7, 1.35),
        (500, 8, 1, 6, 1.05),
        (500, 8, 8, 2, 1.05),
        (500, 16, 1, 14, 1.05),
        (500, 16, 8, 3, 1.05),
        (500, 1, 4, 16, 1.05),
        (2177, 8, 64, 1, 1.10),
        (2177, 8, 1, 5, 1.05),
    ],
)
def test_workers_decode_each_video_about_once(scenes, batch_size, ranks, workers, most):
    order = usual_order([81] * scenes, batch_size, world_size=ranks)

    assert 1 <= packets_of(order, ranks=ranks, workers=workers) < most


@pytest.mark.parametrize(
    ("shape", "ranks", "workers", "most"),
    [
        ({"lengths": [81] * 64, "pairs": 15}, 1, 6, 1.35),
        ({"lengths": [81] * 500, "pairs": 15}, 2, 7, 1.05),
        ({"lengths": [24] * 64, "key_distance": 8}, 1, 5, 1.01),
        ({"lengths": [24] * 300, "key_distance": 8, "pairs": 3}, 4, 3, 1.02),
        ({"lengths": [*range(20, 81)] * 9}, 2, 5, 1.05),
    ],
    ids=["64, all pairs", "500, all pairs", "key frames", "three pairs", "of many lengths"],
)
def test_so_they_do_with_all_pairs_key_frames_and_scenes_of_many_lengths(
    shape, ranks, workers, most
):
    shape = dict(shape)
    how = {name: shape[name] for name in ("pairs", "key_distance") if name in shape}
    order = usual_order(shape.pop("lengths"), 8, world_size=ranks, **shape)

    assert 1 <= packets_of(order, ranks=ranks, workers=workers, **how) < most


@pytest.mark.parametrize("workers", [1, 3, 8, 14])
def test_each_stream_is_one_workers_and_workers_have_about_as_many(workers):
    order = usual_order([81] * 200, 8, world_size=2)
    for rank in (0, 1):
        groups, found = range(rank, order.groups, 2), {}
        for number in range(rank, order.batches, 2):
            streams = order.described(number).stream.tolist()
            own = order.workers_of(number, groups=groups, workers=workers).tolist()
            for stream, worker in zip(streams, own, strict=True):
                assert found.setdefault((number % order.groups, stream), worker) == worker
        counts = np.bincount(list(found.values()), minlength=workers)

        assert len(found) == order.open_runs(groups)
        assert counts.max() - counts.min() <= 1


def test_memory_grows_with_the_runs_and_not_with_the_samples():
    """Half a billion samples, of which a numpy array would take 4 GB."""
    tracemalloc.start()
    order = order_of([81] * 424_650, pairs=15)
    batches = [order.batch(number) for number in (0, 1, 2, 3, order.batches - 1)]
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert sum(map(len, batches)) == 4 * 16 + 515_949_750 % 16
    assert most < 200e6


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"batch_size": 0}, "batch_size must be a whole number from 1, got 0"),
        ({"seed": -1}, "seed must be a whole number from 0, got -1"),
        ({"open_frames": 0}, "open_frames must be a whole number from 1, got 0"),
        ({"shuffle": 1}, "shuffle must be True or False, got 1"),
    ],
    ids=str,
)
def test_a_rule_that_orders_nothing_is_refused(rule, message):
    with pytest.raises(SelectionError, match=message):
        OrderRule(**({"batch_size": 4} | rule))


@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=40),
    pairs=st.sampled_from([1, 3]),
    size=st.integers(1, 6),
    asked=st.lists(
        st.fixed_dictionaries(
            {
                "shuffle_groups": st.integers(1, 6),
                "open_scenes": st.integers(1, 24),
                "open_frames": st.integers(1, 2),
            }
        ),
        min_size=2,
        max_size=6,
    ),
    shuffle=st.booleans(),
)
@settings(max_examples=60)
def test_rules_that_are_the_same_in_effect_give_the_same_order(
    lengths, pairs, size, asked, shuffle
):
    runs, found = runs_of(lengths, pairs=pairs), {}
    for options in asked:
        rule = OrderRule(batch_size=size, shuffle=shuffle, **options)
        batches = all_batches(EpochOrder(runs, rule, epoch=0))

        assert found.setdefault(rule.in_effect(runs), batches) == batches


@pytest.mark.parametrize("number", [-1, 9])
def test_a_batch_beyond_the_last_is_an_index_error(number):
    with pytest.raises(IndexError, match=f"no batch {number}: the epoch has 9"):
        order_of([43], batch_size=5).batch(number)
