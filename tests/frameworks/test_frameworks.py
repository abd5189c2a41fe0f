"""Accelerate, Lightning and Hugging Face's Trainer as they are used: no epoch set by hand.

Each sample comes once an epoch, epochs differ, and a run that goes on equals the unbroken one.
"""

import json
from importlib import import_module

import pytest
from accelerate import skip_first_batches

from stereogenbench_data import SelectionError, StereoPairs
from tests.datasets.conftest import flat, keys_of
from tests.servers.tools import run_python

pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning:lightning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]


@pytest.fixture(scope="module")
def runs():
    """The runs of trainers. Importing Lightning takes seconds, which other tests need not wait."""
    return import_module("tests.frameworks.runs")


@pytest.fixture(scope="module")
def ranks(indexed_release, tmp_path_factory):
    """What two real processes found, by rank."""
    out = tmp_path_factory.mktemp("ranks")
    run_python("-m", "tests.frameworks.ranks", indexed_release, out)
    return [json.loads((out / f"rank{rank}.json").read_text()) for rank in range(2)]


def of_epochs(steps, *, epochs):
    """Return the keys of each epoch of a run."""
    size = len(steps) // epochs
    return [flat(steps[epoch * size : (epoch + 1) * size]) for epoch in range(epochs)]


@pytest.mark.parametrize(
    ("name", "given", "different"),
    [
        ("accelerate", 56, 56),
        ("hugging face loader", 56, 56),
        ("hugging face dataset", 64, 60),  # the trainer fills up the last batches
        ("lightning", 56, 56),
    ],
)
def test_two_ranks_get_each_sample_once_and_other_frames_each_epoch(
    runs, ranks, name, given, different
):
    shares = [of_epochs(rank[name][0], epochs=runs.EPOCHS) for rank in ranks]
    together = [flat(of_ranks) for of_ranks in zip(*shares, strict=True)]

    for keys in together:
        assert (len(keys), len(set(keys))) == (given, different)
    assert len({frozenset(keys) for keys in together}) == runs.EPOCHS


@pytest.mark.parametrize(
    ("name", "stop"),
    [("accelerate", 9), ("hugging face loader", 10), ("hugging face dataset", 10),
     ("lightning", 7)],
)  # fmt: skip
def test_a_run_of_two_ranks_that_goes_on_equals_the_unbroken_one(ranks, name, stop):
    for rank in ranks:
        whole, before, after = rank[name]

        assert len(before) == stop
        assert before + after == whole


def test_shares_are_not_shared_again(ranks):
    for number, rank in enumerate(ranks):
        batches, stream = rank["refused"]
        assert f"2 processes, and this EpochBatches gives rank {number} of 2 its share" in batches
        assert "this StereoPairStream gives rank" in stream
        assert "Prepare pairs.loader(...) instead" in stream


@pytest.fixture(scope="module")
def run(runs):
    """Return the steps of a run, by the trainer and what it is given."""

    def run(name, data, folder, **options):
        pairs = runs.random_frames(data)
        loader = pairs.loader(4, num_workers=1)
        if name == "lightning":
            return runs.lightning(loader, folder, **options)
        own = loader if name == "loader" else None
        return runs.hugging_face(pairs, folder / "run", loader=own, **options)

    return run


@pytest.fixture(scope="module")
def whole_runs(run, indexed_release, tmp_path_factory):
    """The steps of a run that is not stopped, by the trainer and what it was given."""
    folder = tmp_path_factory.mktemp("whole")
    return {name: run(name, indexed_release, folder) for name in ("lightning", "loader", "dataset")}


@pytest.mark.parametrize(
    ("name", "stop"),
    [("lightning", 15), ("lightning", 22), ("loader", 15), ("dataset", 22)],
)
def test_a_run_goes_on_as_if_it_had_not_stopped(
    runs, run, whole_runs, indexed_release, tmp_path, name, stop
):
    """After the last batch of an epoch, and in the second one."""
    before = run(name, indexed_release, tmp_path, stop_at=stop)
    after = run(name, indexed_release, tmp_path, resume=True)
    whole = whole_runs[name]

    epochs = of_epochs(whole, epochs=runs.EPOCHS)
    assert len({tuple(sorted(keys)) for keys in epochs}) == runs.EPOCHS
    assert len(before) == stop
    assert before + after == whole


@pytest.mark.parametrize("limit", ["overfit_batches", "limit_train_batches"])
def test_lightning_overfits_the_first_batches_in_order(runs, indexed_release, tmp_path, limit):
    pairs = StereoPairs(indexed_release, fields=("left", "__key__"), frames="all")
    steps = runs.lightning(pairs.loader(4, shuffle=False), tmp_path, **{limit: 2})

    assert steps == keys_of(pairs.loader(4, shuffle=False))[:2] * runs.EPOCHS


def test_lightning_sees_other_samples_in_each_of_some_short_epochs(runs, indexed_release, tmp_path):
    pairs = StereoPairs(indexed_release, fields=("left", "__key__"), frames="all")
    steps = runs.lightning(pairs.loader(4), tmp_path, limit_train_batches=2)
    expected = [
        pairs.set_epoch(epoch) or keys_of(pairs.loader(4))[:2] for epoch in range(runs.EPOCHS)
    ]

    assert steps == flat(expected)


def test_a_shuffled_loader_that_lightning_would_overfit_says_what_to_use(
    runs, indexed_release, tmp_path
):
    pairs = runs.random_frames(indexed_release)

    match = r"limit_train_batches=.*pairs.loader\(..., shuffle=Fal"
    with pytest.raises(SelectionError, match=match):
        runs.lightning(pairs.loader(4), tmp_path, overfit_batches=2)


def test_lightning_predicts_each_sample_once(runs, indexed_release):
    pairs = runs.random_frames(indexed_release)
    keys = runs.predicted(pairs.loader(8, num_workers=1, drop_last=False))

    assert len(keys) == len(set(keys)) == 60


def test_accelerates_skipped_batches_are_followed_by_the_next_epoch(runs, indexed_release):
    pairs = runs.random_frames(indexed_release)
    loader = pairs.loader(4, num_workers=1)
    expected = [pairs.set_epoch(epoch) or keys_of(pairs.loader(4)) for epoch in (0, 1)]
    pairs.set_epoch(0)

    assert keys_of(skip_first_batches(loader, 5)) == expected[0][5:]
    assert keys_of(loader) == expected[1]
