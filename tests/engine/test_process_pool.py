"""The process pool: results as they come, errors and dead workers that name their item."""

import errno
import multiprocessing
import os
import signal

import pytest

from stereogenbench_data.engine import LOCAL, RayCluster, engine_of
from stereogenbench_data.errors import StorageError
from tests.cli.command import refused


def doubled(item, advance):
    advance(item)
    return 2 * item


def refuse_three(item, advance):
    if item == 3:
        raise ValueError("three is refused")
    return item


def killed_at_three(item, advance):
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def called(item):
    return f"item {item}"


@pytest.mark.parametrize("workers", [1, 2])
def test_every_item_is_done_and_all_is_counted(workers):
    counts = []

    results = list(
        LOCAL.map(doubled, range(5), name=called, workers=workers, advance=counts.append)
    )

    assert sorted(results) == [0, 2, 4, 6, 8]
    assert sum(counts) == 10
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("workers", [1, 2])
def test_the_error_of_a_task_is_raised_with_the_name_of_its_item(workers):
    with pytest.raises(ValueError, match="three is refused") as raised:
        list(LOCAL.map(refuse_three, range(5), name=called, workers=workers))

    assert "item 3" in raised.value.__notes__[0]


def test_a_dead_worker_is_an_error_that_names_its_item_and_not_a_wait():
    with pytest.raises(StorageError, match=r"^item 3: a worker process died.* fewer workers"):
        list(LOCAL.map(killed_at_three, range(5), name=called, workers=2))


def test_workers_that_cannot_be_started_are_an_error_with_the_cure(monkeypatch):
    def refuse(*_):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr("concurrent.futures.ProcessPoolExecutor.submit", refuse)

    with pytest.raises(StorageError, match=r"cannot be started \(Broken pipe\)\. Use one worker"):
        list(LOCAL.map(doubled, range(5), name=called, workers=2))


class Deadly:
    """Ends the process that unpickles it."""

    def __reduce__(self):
        return os._exit, (9,)


def test_a_worker_that_dies_before_its_item_begins_is_an_error():
    with pytest.raises(StorageError, match="a worker process died: it was killed"):
        list(LOCAL.map(print, [Deadly(), Deadly()], name=str, workers=2))


def test_no_workers_are_refused():
    with pytest.raises(StorageError, match="workers must be at least 1, got 0"):
        list(LOCAL.map(doubled, [1], name=str, workers=0))


@pytest.mark.parametrize(
    ("text", "device", "engine"),
    [
        ("local", "cpu", LOCAL),
        ("ray", "cpu", RayCluster()),
        ("ray", "cuda", RayCluster(gpus=1)),
        ("ray://head:10001", "cpu", RayCluster("ray://head:10001")),
        ("10.0.0.1:6379", "cpu", RayCluster("10.0.0.1:6379")),
    ],
)
def test_an_engine_has_a_name_or_an_address(text, device, engine):
    assert engine_of(text, device=device) == engine


@pytest.mark.parametrize(
    "command",
    ["index {release} -o {out}/index.parquet", "pack {release} {out}/shards",
     "audit {release} -o {out}/audit.md", "eval score {release} {out} --tier G1",
     "synth {out}/scenes", "doctor {shards}"],
    ids=lambda command: command.partition(" ")[0],
)  # fmt: skip
def test_each_batch_command_takes_an_engine(command, small_release, small_shards, tmp_path):
    arguments = command.format(release=small_release, shards=small_shards, out=tmp_path)

    told = refused(*arguments.split(), "--workers", "dask")

    assert "engine 'dask': there is no such engine. Choose local, ray, ray://" in told
    assert list(tmp_path.iterdir()) == []
