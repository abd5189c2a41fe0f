"""A pass over a loader owns its state: within another pass, in a fork, and broken off."""

import contextlib
import copy
import gc
import itertools
import multiprocessing
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import connection
from pathlib import Path

import pytest
from torch.utils.data import DataLoader, dataloader

from stereogenbench_data import PassError, StereoPairs, StereoPairStream, WorkerError
from stereogenbench_data.datasets import workers as processes
from tests.datasets.conftest import flat, fork_and, is_true, keys_of

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")

OPEN_FILES = Path("/proc/self/fd")
THREADS = Path("/proc/self/task")
FIELDS = ("left", "frame_index", "__key__")


@pytest.fixture
def pairs(small_index):
    return StereoPairs(small_index, fields=FIELDS, pairs="adjacent", frames="all")


@pytest.mark.parametrize(("workers", "inner"), [(0, 6), (1, 15), (2, 1)])
def test_a_pass_within_a_pass_takes_nothing_from_it(pairs, truth, workers, inner):
    loader = pairs.loader(9, num_workers=workers)
    expected = keys_of(pairs.loader(9))
    outer, held = [], []
    for number, batch in enumerate(loader):
        outer.append(batch["__key__"])
        held.append(batch)
        if number in (0, 4, 14):
            held += itertools.islice(loader, inner)
        if inner < 15:
            assert loader.state_dict()["batches_consumed"] in (number + 1, inner)

    assert outer == expected
    assert all(is_true(batch, truth) for batch in held)


def test_workers_that_persist_tell_the_older_of_two_passes_that_it_is_over(pairs):
    loader = pairs.loader(9, num_workers=1, persistent_workers=True)
    older = iter(loader)
    next(older)
    newer = iter(loader)
    whole = keys_of(newer)

    assert whole == keys_of(pairs.loader(9))
    with pytest.raises(PassError, match=r"epoch 0 ended after 1 of 15 batches, as another one was"):
        next(older)
    closed = iter(loader)
    next(closed)
    loader.close()
    with pytest.raises(PassError, match=r"epoch 1 ended after 1 of 15 batches, .* loader closed"):
        next(closed)
    assert len(list(loader)) == 15


def test_epochs_set_during_a_pass_are_those_of_the_next_one(small_index):
    """Frames are drawn for the epoch of the pass, also in workers that read ahead."""
    pairs = StereoPairs(small_index, fields=("__key__",), frames=("random", 3))
    expected = [pairs.set_epoch(epoch) or keys_of(pairs.loader(2)) for epoch in (0, 5)]
    pairs.set_epoch(0)
    for workers in (0, 1):
        loader = pairs.loader(2, num_workers=workers)
        loader.set_epoch(0)
        found = []
        for batch in loader:
            found.append(batch["__key__"])
            loader.set_epoch(5)

        assert found == expected[0]
        assert keys_of(loader) == expected[1]


@pytest.mark.parametrize("copied", [copy.copy, lambda loader: pickle.loads(pickle.dumps(loader))])
def test_a_copy_of_a_loader_has_passes_of_its_own(pairs, truth, copied):
    loader = pairs.loader(9, num_workers=1, persistent_workers=True)
    batches = iter(loader)
    taken = [next(batches)]
    other = copied(loader)

    assert keys_of(other) == keys_of(pairs.loader(9))
    taken += batches
    assert all(is_true(batch, truth) for batch in taken)
    assert keys_of(taken) == keys_of(pairs.loader(9))


@pytest.mark.parametrize(("workers", "copied"), [(0, copy.deepcopy), (2, pickle.dumps)])
@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_a_pass_is_not_copied(pairs, workers, copied):
    batches = iter(pairs.loader(9, num_workers=workers))
    taken = [next(batches)]
    with pytest.raises(PassError, match="a pass over a loader cannot be copied"):
        copied(batches)
    gc.collect()

    assert len(taken) + len(list(batches)) == 15


@pytest.mark.parametrize("kind", ["persistent loader", "stream"])
def test_a_fork_that_lets_go_of_a_batch_leaves_it_to_its_parent(pairs, small_index, truth, kind):
    if kind == "stream":
        stream = StereoPairStream(small_index, 9, fields=FIELDS, pairs="adjacent", frames="all")
        loader = DataLoader(stream, batch_size=9, num_workers=1, collate_fn=stream.collate)
    else:
        loader = pairs.loader(9, num_workers=1, persistent_workers=True)
    held = []
    for number, batch in enumerate(loader):
        held.append(batch)
        del batch
        if number in (3, 6):
            assert fork_and(lambda: [held.clear(), gc.collect()]) == 0

    assert len(held) == 15
    assert all(is_true(batch, truth) for batch in held)


def test_a_fork_keeps_its_batches_while_the_parent_goes_on(pairs, truth):
    """A process that saves pictures, say, may be slower than training."""
    loader = pairs.loader(9, num_workers=1)
    batches = iter(loader)
    for _ in range(4):
        next(batches)
    batch = next(batches)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(reader, 1)
        os._exit(not is_true(batch, truth))
    del batch
    for after in batches:
        del after
    os.write(writer, b"x")
    os.close(writer)
    os.close(reader)

    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_a_pass_is_refused_in_a_fork_of_its_process(pairs):
    batches = iter(pairs.loader(9, num_workers=1))
    next(batches)

    def take():
        with pytest.raises(PassError, match=r"process \d+ began this pass, and its fork \d+ uses"):
            next(batches)

    assert fork_and(take) == 0
    assert len(list(batches)) == 14


def test_reading_starts_no_thread_that_a_fork_would_wait_for(small_index):
    """FFmpeg waits for the threads of what it frees, and a fork has none of them."""
    threads = {thread.name for thread in THREADS.iterdir()}
    held = [StereoPairs(small_index, fields=("left", "right", "disparity"), size=(40, 56))]
    assert held[0][0]["left"].shape[-2:] == (40, 56)

    assert {thread.name for thread in THREADS.iterdir()} <= threads
    assert fork_and(lambda: [held.clear(), gc.collect()]) == 0


def test_a_fork_may_begin_a_pass_of_its_own(pairs, truth):
    loader = pairs.loader(9, num_workers=1, persistent_workers=True)
    found = []
    for number, batch in enumerate(loader):
        found.append(batch)
        if number == 3:
            assert fork_and(lambda: all(is_true(other, truth) for other in loader) or 1 / 0) == 0

    assert keys_of(found) == keys_of(pairs.loader(9))


def test_threads_that_share_a_pass_take_turns(pairs):
    batches = iter(pairs.loader(9, num_workers=1))
    with ThreadPoolExecutor(3) as threads:
        found = flat(threads.map(keys_of, [batches] * 3))

    assert sorted(found) == sorted(keys_of(pairs.loader(9)))


def test_a_fork_that_lets_go_of_a_pass_does_not_end_its_workers(pairs):
    kept = [iter(pairs.loader(9, num_workers=2))]
    next(kept[0])

    assert fork_and(lambda: [kept.clear(), gc.collect(), time.sleep(0.2)]) == 0
    assert len(list(kept[0])) == 14


def test_nothing_outlives_a_pass_that_is_broken_off(pairs):
    loader = pairs.loader(9, num_workers=2)

    def held():
        gc.collect()
        return len(list(OPEN_FILES.iterdir())), threading.active_count()

    next(iter(loader))
    files, threads = held()
    for _ in range(8):
        next(iter(loader))

    # Threads of queues end a moment after their queue.
    for _ in range(100):
        if held()[0] < files + 8 and held()[1] <= threads + 2:
            break
        time.sleep(0.05)
    assert held()[0] < files + 8
    assert held()[1] <= threads + 2
    assert not multiprocessing.active_children()


class FailAtFrame3:
    """A transform that fails, or that kills its worker, which holds what a worker may hold then."""

    swaps_views = False

    def __init__(self, how):
        self.how = how

    def __call__(self, views, generator):
        if 3 in views.frames and self.how == "an error":
            raise ArithmeticError("frame 3")
        if 3 in views.frames and self.how is not None:
            frame = sys._getframe()
            while "data_queue" not in frame.f_locals:
                frame = frame.f_back
            queue = frame.f_locals["data_queue"]
            if self.how == "queue's lock":
                queue._wlock.acquire()
            if self.how == "half a message":
                queue._wlock.acquire()
                os.write(queue._writer.fileno(), b"\x00\x00\x10\x00half")
            if self.how == "index queue's lock":
                frame.f_locals["index_queue"]._rlock.acquire()
            os.kill(os.getpid(), signal.SIGKILL)
        return views


def test_a_script_without_a_main_guard_is_told_to_have_one(small_index, tmp_path):
    small_index.write(tmp_path / "index.parquet")
    script = tmp_path / "script.py"
    script.write_text(
        "from stereogenbench_data import SceneIndex, StereoPairs\n"
        f"index = SceneIndex.open({str(tmp_path / 'index.parquet')!r}, root={small_index.root!r})\n"
        f"pairs = StereoPairs(index, fields={FIELDS!r})\n"
        f"list(pairs.loader(2, num_workers=1, multiprocessing_context='spawn'))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)

    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert re.search(r"WorkerError: .* below `if __name__ == '__main__':`", last)


@pytest.mark.parametrize(
    ("how", "options"),
    [
        ("nothing", {}),
        ("queue's lock", {"pin_memory": True}),
        ("half a message", {"pin_memory": True, "persistent_workers": True}),
        ("index queue's lock", {"persistent_workers": True}),
    ],
)
@pytest.mark.filterwarnings("ignore:'pin_memory' argument is set as true but no accelerator")
def test_a_worker_that_dies_ends_the_pass_whatever_it_held(small_index, how, options):
    dying = FailAtFrame3(how)
    pairs = StereoPairs(small_index, fields=FIELDS, frames="all", transform=dying)
    loader = pairs.loader(
        2, num_workers=2, shuffle=False, multiprocessing_context="fork", **options
    )
    with pytest.raises(WorkerError, match=r"worker \(pid \d+\) was killed by SIGKILL in"):
        list(loader)
    loader.close()
    dying.how = None

    assert len(list(loader)) == 14


def test_a_worker_that_is_killed_between_two_passes_is_named_by_the_second(small_index):
    loader = StereoPairs(small_index, fields=FIELDS, frames="all").loader(
        2, num_workers=2, persistent_workers=True, multiprocessing_context="fork"
    )
    assert len(list(loader)) == len(loader)
    with contextlib.suppress(RuntimeError):  # torch's handler of the signal, wherever the loop is
        os.kill(next(iter(processes.pids_for(loader))), signal.SIGKILL)
        time.sleep(1)

    with pytest.raises(WorkerError, match=r"worker \(pid \d+\) was killed by SIGKILL in"):
        next(iter(loader))
    assert len(list(loader)) == len(loader)


def test_a_worker_that_is_killed_as_the_loader_is_closed_raises_nothing(small_index, monkeypatch):
    loader = StereoPairs(small_index, fields=FIELDS, frames="all").loader(
        2, num_workers=2, persistent_workers=True, multiprocessing_context="fork"
    )
    next(iter(loader))
    ending = dataloader._MultiProcessingDataLoaderIter._shutdown_workers

    def killed_meanwhile(batches):
        for process in batches._workers:
            process.kill()
            connection.wait([process.sentinel])  # torch's handler of its signal raises here
        ending(batches)

    monkeypatch.setattr(
        dataloader._MultiProcessingDataLoaderIter, "_shutdown_workers", killed_meanwhile
    )
    loader.close()
    monkeypatch.undo()

    assert len(list(loader)) == len(loader)


def test_an_error_ends_its_pass_and_says_so_to_who_asks_on(small_index):
    failing = FailAtFrame3("an error")
    pairs = StereoPairs(small_index, fields=FIELDS, frames="all", transform=failing)
    batches = iter(pairs.loader(2, num_workers=1, shuffle=False))
    next(batches)
    with pytest.raises(ArithmeticError, match="frame 3"):
        list(batches)

    with pytest.raises(PassError, match="epoch 0 ended after 1 of 14 batches with an error"):
        next(batches)


@pytest.mark.parametrize("hanging", [2, 9])
def test_a_worker_that_hangs_in_its_fork_is_forked_again(small_index, monkeypatch, hanging):
    monkeypatch.setattr(processes, "_BEGUN_WITHIN_S", 1.0)
    pairs = StereoPairs(small_index, split="train", fields=("__key__",))
    expected = sorted(sample["__key__"] for sample in pairs)
    forks = []

    def hang():  # as a lock does that a thread held while the process was forked
        while len(forks) <= hanging:
            time.sleep(1)

    def load():
        os.register_at_fork(before=lambda: forks.append(0), after_in_child=hang)
        refused = pytest.raises(WorkerError, match="worker did not begin within 1 s of its fork")
        with refused if hanging > 3 else contextlib.nullcontext():
            assert sorted(flat(keys_of(pairs.loader(1, num_workers=2)))) == expected

    assert fork_and(load) == 0
