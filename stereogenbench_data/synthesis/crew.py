"""Work shared among processes: started afresh, told when to stop, and missed when they die."""

import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Final

import torch

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.synthesis.filming import film_camera
from stereogenbench_data.synthesis.plan import plan_scene
from stereogenbench_data.synthesis.request import SynthRequest

_POLL_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Job:
    """One camera of one scene, to be written into a folder."""

    request: SynthRequest
    index: int
    camera: int
    folder: Path

    def run(self, after_frame: Callable[[], None]) -> None:
        """Do the work.

        Raises:
            SynthesisError: If a file cannot be written; the message names the scene.
        """
        plan = plan_scene(self.request, index=self.index)
        try:
            film_camera(plan, camera=self.camera, folder=self.folder, after_frame=after_frame)
        except OSError as error:
            raise SynthesisError(
                f"{plan.key}: camera {self.camera} could not be written to {self.folder}: {error}. "
                f"See that the disk has room and may be written to, then run again: finished "
                f"scenes are kept."
            ) from error


class _Stopped(Exception):
    """The work was called off."""


@dataclass(frozen=True, slots=True)
class _Shared:
    """What the processes tell each other: frames done, and whether to stop."""

    frames: "Synchronized[int]"
    stop: Event


_shared: list[_Shared] = []
"""What a worker process was given when it started; empty elsewhere."""


def run_jobs(
    jobs: Iterable[Job], *, workers: int, after_frames: Callable[[int], None]
) -> Generator[Job, None, None]:
    """Do jobs in any order and yield each when it is done; close it to stop the rest.

    Args:
        jobs: The work; taken one by one, shortly before it is done.
        workers: How many processes; 1 works in this one.
        after_frames: Called now and then with how many frames were drawn since it was called.

    Raises:
        SynthesisError: If a job fails or a worker dies; the others are stopped first.
    """
    if workers == 1:
        with _one_thread():
            for job in jobs:
                job.run(lambda: after_frames(1))
                yield job
        return
    context = multiprocessing.get_context("spawn")
    shared = _Shared(context.Value("q", 0), context.Event())
    pool = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_start_worker, initargs=(shared,)
    )
    try:
        yield from _in_pool(
            pool, jobs=iter(jobs), shared=shared, workers=workers, after_frames=after_frames
        )
    except BrokenProcessPool as error:
        raise SynthesisError(
            "A worker process died (killed, or out of memory). Run again with fewer workers: "
            "finished scenes are kept."
        ) from error
    finally:
        shared.stop.set()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Work as a worker process does: how torch rounds depends on how it shares work out."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _in_pool(
    pool: ProcessPoolExecutor,
    *,
    jobs: Iterator[Job],
    shared: _Shared,
    workers: int,
    after_frames: Callable[[int], None],
) -> Iterator[Job]:
    """Keep the pool busy with few jobs ahead, so that none is left waiting when work is stopped."""
    running: dict[Future[None], Job] = {}
    told = 0
    while True:
        for job in itertools.islice(jobs, workers + 1 - len(running)):
            with _interrupts_held():
                running[pool.submit(_run_job, job)] = job
        if not running:
            return
        done, _ = wait(running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        drawn = shared.frames.value
        after_frames(drawn - told)
        told = drawn
        for future in done:
            future.result()
            yield running.pop(future)


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
    """Prepare a worker: one thread, Ctrl-C left to the main process, no life without it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _shared.append(shared)


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run_job(job: Job) -> None:
    (shared,) = _shared

    def after_frame() -> None:
        with shared.frames.get_lock():
            shared.frames.value += 1
        if shared.stop.is_set():
            raise _Stopped

    job.run(after_frame)
