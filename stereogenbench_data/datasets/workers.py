"""The worker processes of a pass: torch's own, but one that dies always ends the pass.

torch shares an event and a queue with its workers, each guarded by a lock between processes. A
worker that is killed while it holds such a lock, as by a system short of memory, would leave the
training process waiting for ever. So the event made here has no lock, and a thread waits for the
end of each worker: when one ends too soon it kills the others and closes the queue, so that nobody
waits for what will not come.

A fork copies locks as they are. Where a thread of another library held one, as gloo's threads do
the interpreter's own in CPython 3.11, the new process waits for ever before its first line of
Python. So a forked worker says that it has begun; one that does not is forked again.
"""

import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from multiprocessing.queues import Queue
from time import sleep
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakSet, ref

from torch.utils.data import DataLoader, Sampler, get_worker_info

from stereogenbench_data.datasets.batch_buffers import BatchMemory, memory_file
from stereogenbench_data.datasets.batch_parts import PartedBatches, part_as_made
from stereogenbench_data.datasets.batches import Pass
from stereogenbench_data.errors import PassError, WorkerError

if sys.platform != "win32":
    from multiprocessing.context import ForkProcess

_BEGUN_WITHIN_S = 20.0
"""How long a forked worker may take to its first line of Python; usually milliseconds."""

_MOST_FORKS = 3
"""How often a worker is forked that does not begin."""

_NOTICED_AFTER_S = 2.0
"""How long torch may know of a death before this module's thread does."""


class Workers:
    """The workers of one pass, or of several one after another where they persist.

    Attributes:
        serves: The pass whose batches they load; None before the first.
        parted: Its batches on their way.
    """

    def __init__(self, loader: DataLoader[Any]) -> None:
        """Begin without processes; they are started as a loader says, when the first pass begins.

        Without worker processes this one loads.
        """
        self._pid = os.getpid()
        self._torch: DataLoader[Any] | None = None
        self._results: Iterator[Any] = iter(())
        self.serves: Pass | None = None
        self.parted: PartedBatches | None = None
        self._due = _DueTasks()
        self._context: _WatchedContext | None = None
        workers, ahead = loader.num_workers, loader.prefetch_factor or 0
        # Of what is on its way, and what the loop holds.
        self._memory = BatchMemory(kept=workers * ahead + 2, fd=memory_file() if workers else None)
        own: dict[str, Any] = {"collate_fn": part_as_made}
        if workers > 0:
            given: Any = loader.multiprocessing_context
            base = given.get_context() if isinstance(given, BaseContext) else get_context(given)
            self._context = _WatchedContext(base)
            own |= {
                "worker_init_fn": _Beginning(self._memory, loader.worker_init_fn),
                "prefetch_factor": ahead * workers,
                "in_order": True,
            }
        self._torch = DataLoader(
            loader.dataset,
            batch_sampler=self._due,
            num_workers=workers,
            pin_memory=loader.pin_memory,
            timeout=loader.timeout,
            multiprocessing_context=self._context,
            generator=loader.generator,
            persistent_workers=loader.persistent_workers,
            **own,
        )
        self._loader = ref(loader)
        self._stop_reader, self._stop_writer = connection.Pipe(duplex=False)
        self._thread: threading.Thread | None = None
        _running.add(self)

    @property
    def is_of_this_process(self) -> bool:
        """Whether this process started them, and not one that it was forked from."""
        return self._context is None or os.getpid() == self._pid

    def begin(self, begun: Pass, numbers: Iterator[Any], loader: Any) -> None:
        """Begin a pass over batches; the pass that these workers served before has ended.

        Args:
            begun: The pass.
            numbers: Its batches.
            loader: The `PairsLoader`, whose module imports this one; not kept.
        """
        if self._torch is None:
            raise PassError("these workers have ended: call iter(loader) again.")
        are_new, self.serves = self.serves is None, begun
        self.parted = PartedBatches(
            numbers,
            loader.batches.of_all_ranks,
            loader.share,
            memory=self._memory,
            making=loader.making,
            before=self.parted,
        )
        self._due.tasks = self.parted.tasks()
        # So workers do not end by it before they have begun.
        with _sigterm_blocked(self._context):
            self._results = iter(self._torch)
        if self._context is not None and are_new:
            # The thread does not refer to these workers: without other references they end.
            of_thread = (self._context, self._stop_reader)
            self._thread = threading.Thread(
                target=_watch, args=of_thread, name="worker-watch", daemon=True
            )
            self._thread.start()

    def next(self) -> Any:
        """Return the next batch of the pass that was begun."""
        assert self.parted is not None  # `begin` made it
        return self.parted.next(self._results)

    def __del__(self) -> None:
        """End the workers when no reference is left."""
        self.end()

    def end(self) -> None:
        """End the workers; batches that came from them keep their memory."""
        if not self.is_of_this_process:
            return
        self.serves = None  # a pass that goes on is told
        results, self._results = self._results, iter(())
        loader, self._torch = self._torch, None
        self._due.tasks = iter(())
        if loader is None or self._context is None or sys.is_finalizing():
            return
        if self._thread is not None:
            # From now on workers may end.
            self._stop_writer.send_bytes(b"stop")
            if threading.current_thread() is not self._thread:
                self._thread.join()
            self._thread = None
        # Now, and not when the last traceback is gone that knows the iterator. Lightning ends
        # workers in this way, too; where none could be started there is nothing to end.
        shutdown = getattr(results, "_shutdown_workers", None)
        if shutdown is not None:
            # torch may raise here that a worker was killed, which ends with the others anyway.
            with suppress(RuntimeError):
                shutdown()
        self._memory.close()

    def error(self, noticed: BaseException) -> WorkerError | None:
        """Return an error that names the worker that died; None if none did.

        Args:
            noticed: What the loop met. Where torch says that a worker process raised it, that is no
                death; where it says so of its thread that pins memory, that thread may have read
                what a dead worker left behind.
        """
        if self._context is None:
            return None
        is_a_workers_own = "in DataLoader worker process" in str(noticed).partition("\n")[0]
        if is_a_workers_own or not self._context.is_dead.wait(_NOTICED_AFTER_S):
            return None
        dead: Any = self._context.dead
        dead.join(_NOTICED_AFTER_S)
        code = dead.exitcode
        how, cure = f"exited with status {code}", "Its traceback is above."
        method = getattr(dead, "_start_method", "fork")
        if code is not None and code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
            cure = "If memory ran out, use fewer workers or open_scenes."
            if code == -signal.SIGBUS:
                cure = "Memory for batches is full: use smaller ones, or a smaller prefetch_factor."
        elif method != "fork":
            cure += (
                f" Workers of the start method {method!r} import the script again: its loop must "
                "stand below `if __name__ == '__main__':`."
            )
        return WorkerError(
            f"a DataLoader worker (pid {dead.pid}) {how} in the middle of a pass "
            f"({type(noticed).__name__}: {noticed}). {cure} Load the last state_dict() to go on."
        )


def _watch(context: "_WatchedContext", stop_reader: Any) -> None:
    """Wait for the end of each worker: where one ends too soon, kill the others."""
    sentinels = {process.sentinel: process for process in context.processes}
    ready = connection.wait([stop_reader, *sentinels])
    # torch tells the workers to end after the last batch.
    if stop_reader in ready or any(event.is_set() for event in context.events):
        return
    context.dead = next(sentinels[each] for each in ready if isinstance(each, int))
    for process in context.processes:
        if process is not context.dead:
            process.kill()
    # torch makes the queue of results first; the others lead to one worker each.
    context.queues[0].end()
    context.is_dead.set()


class _DueTasks(Sampler[Any]):
    """The batch sampler of workers: the tasks, or the batches, that are due."""

    def __init__(self) -> None:
        self.tasks: Iterator[Any] = iter(())

    def __iter__(self) -> Iterator[Any]:
        return self.tasks


class _Beginning(NamedTuple):
    """What a worker does first: it obeys, takes the memory of its batches, and what users ask."""

    memory: BatchMemory
    worker_init_fn: Callable[[int], object] | None

    def __call__(self, worker: int) -> None:
        _end_with_parent_alone()
        info: Any = get_worker_info()
        info.dataset.begin_worker(worker, self.memory)
        if self.worker_init_fn is not None:
            self.worker_init_fn(worker)


@contextmanager
def _sigterm_blocked(context: "_WatchedContext | None") -> Iterator[None]:
    """Let this thread, and the processes that it starts, take no SIGTERM for now."""
    if context is None or not hasattr(signal, "sigwaitinfo"):
        yield
        return
    if context.get_start_method() != "fork":
        resource_tracker.ensure_running()  # where it has to be started, it unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent_alone() -> None:
    """Let SIGTERM end this worker only where its parent sends it.

    Launchers and schedulers send it to a whole process group. A worker that ended would end the
    training process in the middle of its step, before it could save. It cannot be ignored, as
    multiprocessing ends its processes by it and waits for them. So it is blocked, as it was when
    this process was started, and taken by a thread. Where a system does not tell who sent a signal
    (macOS), workers end as usual.
    """
    if not hasattr(signal, "sigwaitinfo"):
        return
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})

    def obey() -> None:
        while signal.sigwaitinfo({signal.SIGTERM}).si_pid != os.getppid():
            pass
        os._exit(0)

    threading.Thread(target=obey, name="sigterm", daemon=True).start()


_running: Final[WeakSet[Workers]] = WeakSet()
"""The workers of the passes of this process."""


def pids_for(loader: DataLoader[Any]) -> set[int]:
    """Return the numbers of the processes that run for a loader."""
    contexts = [each._context for each in _running if each._loader() is loader]
    started = [each.processes for each in contexts if each is not None]
    return {process.pid for each in started for process in each if process.pid is not None}


_inherited: Final[list[object]] = []
"""Workers that a fork copied. They are the parent's: if the last reference to torch's iterator were
dropped here, torch would end them. The operating system frees all of it when this process ends."""


def _keep_inherited() -> None:
    _inherited.extend(_running)
    _running.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep_inherited)


class _LocklessEvent:
    """What torch asks of an event: one byte that all processes see, and no lock.

    Only the process that made it sets it: a fork that lets go of a pass does not end its workers.
    """

    def __init__(self, context: BaseContext) -> None:
        self._byte: Any = context.RawValue("b", 0)
        self._pid = os.getpid()

    def is_set(self) -> bool:
        return bool(self._byte.value)

    def set(self) -> None:
        if os.getpid() == self._pid:
            self._byte.value = 1


if TYPE_CHECKING:
    _Queue = Queue[Any]
else:
    _Queue = Queue  # generic only in the stubs of Python 3.11


class _ClosableQueue(_Queue):
    """A queue that can be ended though a dead process holds its lock or wrote half a message."""

    _is_ended = False

    def end(self) -> None:
        """Make readers see an empty queue, without waiting for a dead writer."""
        self._is_ended = True
        pipe: Any = self  # torch and the standard library do not declare the pipe's end
        pipe._writer.close()  # without it a reader sees no end

    def get(self, block: bool = True, timeout: float | None = None) -> Any:  # noqa: FBT001, FBT002
        """Return the next item, as the queue that this stands for."""
        try:
            return super().get(block, timeout)
        except (EOFError, OSError):
            if not self._is_ended:
                raise
            sleep(0.01)
            raise queue.Empty from None

    def put(self, obj: Any, block: bool = True, timeout: float | None = None) -> None:  # noqa: FBT001, FBT002
        """Put an item, unless the queue was ended."""
        if not self._is_ended:
            super().put(obj, block, timeout)


if sys.platform != "win32":

    class _ForkedProcess(ForkProcess):
        """A forked process that is sure to have begun once it was started."""

        _begun_signal: Any

        def run(self) -> None:
            self._begun_signal.send_bytes(b"begun")
            super().run()

        def start(self) -> None:
            """Start the process, again where it did not begin.

            Raises:
                WorkerError: If it never does.
            """
            before = dict(self.__dict__)
            for _ in range(_MOST_FORKS):
                self.__dict__.update(before)  # a start drops what it is to run
                begun, self._begun_signal = connection.Pipe(duplex=False)
                with begun, self._begun_signal:
                    super().start()
                    if begun.poll(_BEGUN_WITHIN_S):
                        return
                self.kill()
                self.join()
            raise WorkerError(
                f"a DataLoader worker did not begin within {_BEGUN_WITHIN_S:g} s of its fork, in "
                f"{_MOST_FORKS} attempts: a thread of this process holds a lock. Use "
                f"multiprocessing_context='forkserver', which starts workers from a process "
                f"without threads."
            )


class _WatchedContext(BaseContext):
    """A context whose processes and queues can be watched; it starts them as another one does.

    Attributes:
        processes: The workers.
        queues: The queue of results, and one for each worker.
        events: What tells the workers to end.
        dead: The first worker that ended too soon.
        is_dead: Set when all that follows from its end is done.
    """

    def __init__(self, base: BaseContext) -> None:
        self._base: Any = base  # the standard library does not declare its process
        self.processes: list[BaseProcess] = []
        self.queues: list[_ClosableQueue] = []
        self.events: list[_LocklessEvent] = []
        self.dead: BaseProcess | None = None
        self.is_dead = threading.Event()

    def get_start_method(self, allow_none: bool = False) -> str:  # noqa: FBT001, FBT002
        """Return the start method, by which locks are made."""
        method: str = self._base.get_start_method(allow_none)
        return method

    def Process(self, *args: Any, **kwargs: Any) -> BaseProcess:
        make = self._base.Process
        if sys.platform != "win32" and make is ForkProcess:
            make = _ForkedProcess
        process: BaseProcess = make(*args, **kwargs)
        self.processes.append(process)
        return process

    def Queue(self, maxsize: int = 0) -> _ClosableQueue:
        made = _ClosableQueue(maxsize, ctx=self)
        self.queues.append(made)
        return made

    def Event(self) -> Any:
        made = _LocklessEvent(self)
        self.events.append(made)
        return made
