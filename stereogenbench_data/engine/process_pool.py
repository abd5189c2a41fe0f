"""Work shared among processes: counted as it is done, told when to stop, missed if they die."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from typing import Final, TypeVar

from stereogenbench_data.errors import StorageError

Task = TypeVar("Task")
Result = TypeVar("Result")
AfterBytes = Callable[[int], None]

_POLL_S: Final = 0.2


class _Stopped(Exception):
    """The work was called off."""


@dataclass(frozen=True, slots=True)
class _Shared:
    """What the processes tell each other: bytes done, and whether to stop."""

    done_bytes: "Synchronized[int]"
    stop: Event


_shared: list[_Shared] = []
"""What a worker process was given when it started; empty elsewhere."""


def run_tasks(
    work: Callable[[Task, AfterBytes], Result],
    tasks: Sequence[Task],
    *,
    workers: int | None,
    after_bytes: AfterBytes,
) -> Generator[Result, None, None]:
    """Do tasks in any order and yield the result of each; close it to stop the rest.

    Args:
        work: A function of a module, called with a task and with what it is to call after each
            few bytes; there it is interrupted when the work is stopped.
        tasks: What is to be done.
        workers: How many processes, None for one a core; with one, or one task, this one works.
        after_bytes: Called now and then with how many bytes were done since.

    Raises:
        StorageError: If ``workers`` is below 1, or a worker process died. Of a task that fails
            the error is raised, once the other tasks are stopped.
    """
    if workers is not None and workers < 1:
        raise StorageError(f"workers must be at least 1, got {workers}.")
    needed = min(workers or os.cpu_count() or 1, len(tasks))
    if needed <= 1:
        for task in tasks:
            yield work(task, after_bytes)
        return
    context = multiprocessing.get_context("spawn")
    shared = _Shared(context.Value("q", 0), context.Event())
    pool = ProcessPoolExecutor(
        needed, mp_context=context, initializer=_start_worker, initargs=(shared,)
    )
    try:
        with _interrupts_held():
            futures = {pool.submit(_run_task, work, task) for task in tasks}
        yield from _results(futures, shared=shared, after_bytes=after_bytes)
    except BrokenProcessPool as error:
        raise StorageError(
            "a worker process died: it was killed (is memory short?), or the calling script "
            "starts work without `if __name__ == '__main__':`. Run it again, with fewer workers; "
            "what is finished is kept."
        ) from error
    finally:
        shared.stop.set()
        pool.shutdown(cancel_futures=True)


def _results(
    futures: set[Future[Result]], *, shared: _Shared, after_bytes: AfterBytes
) -> Iterator[Result]:
    told = 0
    while futures:
        done, futures = wait(futures, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        done_bytes = shared.done_bytes.value
        after_bytes(done_bytes - told)
        told = done_bytes
        for future in done:
            yield future.result()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Start processes so that Ctrl-C never reaches them; here it counts as soon as they started."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(shared: _Shared) -> None:
    """Prepare a worker: Ctrl-C is left to the main process, and there is no life without it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _shared.append(shared)


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run_task(work: Callable[[Task, AfterBytes], Result], task: Task) -> Result:
    (shared,) = _shared

    def after_bytes(count: int) -> None:
        with shared.done_bytes.get_lock():
            shared.done_bytes.value += count
        if shared.stop.is_set():
            raise _Stopped

    after_bytes(0)
    return work(task, after_bytes)
