"""The stream: the loader's batches, sample by sample."""

import copy
import itertools
import json

import pytest
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import StatefulDataLoader

from stereogenbench_data import StateError, StereoPairs, StereoPairStream
from tests.datasets.conftest import flat, keys_of, same

pytestmark = [
    pytest.mark.filterwarnings("ignore::stereogenbench_data.RepeatedEpochWarning"),
    pytest.mark.filterwarnings("ignore:This DataLoader will create"),
    pytest.mark.filterwarnings("ignore:'set_vital' is deprecated"),
]
SELECTION = {"fields": ("__key__",), "pairs": "adjacent", "frames": "all"}


@pytest.fixture
def stream_of(small_index):
    def made(batch_size=9, **options):
        return StereoPairStream(
            small_index, batch_size, **({"drop_last": False} | SELECTION | options)
        )

    return made


def loaded(stream, workers=0, **options):
    return DataLoader(
        stream, batch_size=stream.batches.rule.batch_size, num_workers=workers, **options
    )


@pytest.mark.parametrize(
    ("world", "workers", "drop_last"), [(1, 3, True), (2, 2, "pad"), (3, 0, False)], ids=str
)
def test_its_batches_are_those_of_the_loader(keyed, stream_of, world, workers, drop_last):
    for rank in range(world):
        options = {"rank": rank, "world_size": world, "drop_last": drop_last}
        stream = stream_of(**options)
        stream.set_epoch(1)
        keyed.set_epoch(1)
        expected = list(keyed.loader(9, **options))
        found = list(loaded(stream, workers))

        assert all(same(one, other) for one, other in zip(found, expected, strict=True))
        assert len(stream) == len(flat(keys_of(found)))


@pytest.mark.parametrize(
    ("loader", "context"), [(DataLoader, "spawn"), (StatefulDataLoader, "fork")], ids=str
)
def test_batches_made_in_place_are_those_of_the_loader_and_stay_while_held(
    small_index, loader, context
):
    options = {"pairs": "adjacent", "frames": range(3)}
    stream = StereoPairStream(small_index, 4, drop_last="pad", **options)
    expected = list(StereoPairs(small_index, **options).loader(4, drop_last="pad"))
    held = {}
    found = loader(
        stream, batch_size=4, num_workers=2, collate_fn=stream.collate,
        multiprocessing_context=context,
    )  # fmt: skip
    for number, batch in enumerate(found):
        assert same(batch, expected[number])
        if number in (3, 4, 8):
            held[number] = batch

    assert number == len(expected) - 1
    assert all(same(batch, expected[number]) for number, batch in held.items())


def test_streams_used_side_by_side_and_their_copies_send_their_own_batches(small_index):
    options = {"pairs": "adjacent", "frames": range(3), "drop_last": False}
    stream = StereoPairStream(small_index, 4, **options)
    streams = [stream, copy.deepcopy(stream), StereoPairStream(small_index, 4, seed=1, **options)]
    loaders = [loaded(each, 1, collate_fn=each.collate) for each in streams]
    expected = [list(loaded(each)) for each in streams]
    for each in streams:
        each.load_state_dict(each.batches.state_at(0, 0))

    for numbers, *batches in zip(itertools.count(), *loaders, strict=False):
        assert all(same(batch, own[numbers]) for batch, own in zip(batches, expected, strict=True))
    assert numbers == len(expected[0]) - 1


@pytest.mark.parametrize(("workers", "persistent"), [(0, False), (2, True)])
def test_a_position_goes_on_under_other_ranks_and_workers_once(stream_of, workers, persistent):
    unbroken = keys_of(loaded(stream_of()))
    first = stream_of(rank=0, world_size=2)
    taken = keys_of(itertools.islice(loaded(first, 1), 3))
    state = json.loads(json.dumps(first.state_dict(batches=3)))
    assert state["batches_consumed"] == 6
    assert taken == unbroken[0:6:2]

    stream = stream_of()
    stream.load_state_dict(state)
    loader = loaded(stream, workers, persistent_workers=persistent)

    assert keys_of(loader) == unbroken[6:]
    assert keys_of(loader) == unbroken
    stream.set_epoch(1)
    assert sorted(flat(keys_of(loader))) == sorted(flat(unbroken))


def test_a_stream_iterated_in_this_process_counts_by_itself(stream_of, keyed):
    stream = stream_of()
    batches = iter(loaded(stream))
    for taken in range(1, 5):
        next(batches)
        assert stream.state_dict()["batches_consumed"] == taken

    loader = keyed.loader(9, drop_last=False)
    loader.load_state_dict(stream.state_dict())
    assert keys_of(loader) == keys_of(batches)


def test_a_stream_iterated_by_workers_asks_how_far_the_loop_is(stream_of):
    stream = stream_of()
    assert stream.state_dict()["batches_consumed"] == 0
    next(iter(loaded(stream, 1)))

    with pytest.raises(StateError, match=r"worker processes .* state_dict\(batches=\.\.\.\)"):
        stream.state_dict()
    assert stream.state_dict(batches=1)["batches_consumed"] == 1


@pytest.mark.parametrize(("workers", "stop"), [(0, 4), (2, 0), (2, 4)])
def test_torchdatas_loader_saves_and_loads_its_position(stream_of, workers, stop):
    def loader():
        return StatefulDataLoader(stream_of(), batch_size=9, num_workers=workers)

    unbroken = keys_of(loader())
    broken = loader()
    before = keys_of(itertools.islice(broken, stop))
    resumed = loader()
    resumed.load_state_dict(broken.state_dict())

    assert before + keys_of(resumed) == unbroken
    assert keys_of(resumed) == unbroken


@pytest.mark.parametrize("taken", [13, 70])
def test_a_stream_goes_on_after_its_last_sample_and_other_ranks_after_its_last_batch(
    stream_of, taken
):
    first = stream_of(rank=0, world_size=2)
    samples = iter(first)
    for _ in range(taken):
        next(samples)
    state = json.loads(json.dumps(first.state_dict()))
    same, alone = stream_of(rank=0, world_size=2), stream_of()
    same.load_state_dict(state)
    alone.load_state_dict(state)

    whole = [sample["__key__"] for sample in stream_of()]
    assert [sample["__key__"] for sample in same] == [sample["__key__"] for sample in samples]
    assert [sample["__key__"] for sample in alone] == whole[18 * (taken // 9) :]
    assert len(list(same)) == len(same)


def test_a_workers_own_position_is_refused_by_another_worker(stream_of):
    first, second = (
        StatefulDataLoader(stream_of(rank=rank, world_size=2), batch_size=9, num_workers=1)
        for rank in (0, 1)
    )
    next(iter(first))
    second.load_state_dict(first.state_dict())

    with pytest.raises(StateError, match="rank is 1 here and 0 there"):
        next(iter(second))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": 17}, "start is 17, and there are 16"),
        ({"samples_given": 145}, "samples_given is 145, and there are 144"),
    ],
    ids=str,
)
def test_a_workers_damaged_position_is_refused(stream_of, change, message):
    stream = stream_of()
    next(iter(stream))

    with pytest.raises(StateError, match=message):
        stream.load_state_dict(stream.state_dict() | change)
