"""The worker processes of one pass: torch's own, but a worker that dies always ends the pass.

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
import time
from collections.abc import Iterator
from multiprocessing import connection, get_context
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from multiprocessing.queues import Queue
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakSet

from torch.utils.data import DataLoader, Sampler

from stereogenbench_data.datasets.batch_buffers import forget_slots
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
    """

    def __init__(self, loader: DataLoader[Any]) -> None:
        """Begin without processes; they are started as a loader says, when the first pass begins.

        Without worker processes this one loads.
        """
        self._torch: DataLoader[Any] | None = None
        self._batches: Iterator[Any] = iter(())
        self.serves: Pass | None = None
        self._numbers = _DueBatches()
        self._context: _WatchedContext | None = None
        if loader.num_workers > 0:
            given: Any = loader.multiprocessing_context
            base = given.get_context() if isinstance(given, BaseContext) else get_context(given)
            self._context = _WatchedContext(base)
        self._torch = DataLoader(
            loader.dataset,
            batch_sampler=self._numbers,
            num_workers=loader.num_workers,
            collate_fn=loader.collate_fn,
            pin_memory=loader.pin_memory,
            timeout=loader.timeout,
            worker_init_fn=loader.worker_init_fn,
            multiprocessing_context=self._context,
            generator=loader.generator,
            prefetch_factor=loader.prefetch_factor,
            persistent_workers=loader.persistent_workers,
        )
        self._death = _Death()
        self._stop_reader, self._stop_writer = connection.Pipe(duplex=False)
        self._thread: threading.Thread | None = None
        self._pid = os.getpid()
        _running.add(self)

    @property
    def pids(self) -> set[int]:
        """The numbers of the processes that run."""
        if self._context is None or self._torch is None:
            return set()
        return {process.pid for process in self._context.processes if process.pid is not None}

    @property
    def is_of_this_process(self) -> bool:
        """Whether this process started them, and not one that it was forked from."""
        return self._context is None or os.getpid() == self._pid

    def begin(self, begun: Pass, numbers: Iterator[Any]) -> Iterator[Any]:
        """Return the batches of a pass; the pass that these workers served before has ended."""
        if self._torch is None:
            raise PassError("these workers have ended: call iter(loader) again.")
        are_new, self.serves = self.serves is None, begun
        self._numbers.due = numbers
        self._batches = iter(self._torch)
        if self._context is not None and are_new:
            # The thread does not refer to these workers: without other references they end.
            of_thread = (self._context, self._stop_reader, self._death)
            self._thread = threading.Thread(
                target=_watch, args=of_thread, name="worker-watch", daemon=True
            )
            self._thread.start()
        return self._batches

    def __del__(self) -> None:
        """End the workers when no reference is left."""
        self.end()

    def end(self) -> None:
        """End the workers, and release the memory that came from them."""
        batches, self._batches = self._batches, iter(())
        loader, self._torch = self._torch, None
        if loader is None or self._context is None or sys.is_finalizing():
            return
        if not self.is_of_this_process:
            _inherited.append((loader, batches))
            return
        if self._thread is not None:
            # From now on workers may end.
            self._stop_writer.send_bytes(b"stop")
            if threading.current_thread() is not self._thread:
                self._thread.join()
            self._thread = None
        # Now, and not when the last traceback is gone that knows the iterator. Lightning ends
        # workers in this way, too; where none could be started there is nothing to end.
        shutdown = getattr(batches, "_shutdown_workers", None)
        if shutdown is not None:
            shutdown()
        forget_slots({each.pid for each in self._context.processes if each.pid is not None})

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
        if is_a_workers_own or not self._death.is_handled.wait(_NOTICED_AFTER_S):
            return None
        dead: Any = self._death.process
        dead.join(_NOTICED_AFTER_S)
        code = dead.exitcode
        how, cure = f"exited with status {code}", "Its traceback is above."
        method = getattr(dead, "_start_method", "fork")
        if code is not None and code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
            cure = "If memory ran out, use fewer workers or open_scenes."
        elif method != "fork":
            cure += (
                f" Workers of the start method {method!r} import the script again: its loop must "
                "stand below `if __name__ == '__main__':`."
            )
        return WorkerError(
            f"a DataLoader worker (pid {dead.pid}) {how} in the middle of a pass "
            f"({type(noticed).__name__}: {noticed}). {cure} Load the last state_dict() to go on."
        )


class _Death:
    """The first worker that ended too soon, and whether all that follows from it is done."""

    def __init__(self) -> None:
        self.process: BaseProcess | None = None
        self.is_handled = threading.Event()


def _watch(context: Any, stop_reader: Any, death: _Death) -> None:
    """Wait for the end of each worker: where one ends too soon, kill the others."""
    sentinels = {process.sentinel: process for process in context.processes}
    ready = connection.wait([stop_reader, *sentinels])
    if stop_reader in ready or context.told_to_end():
        return
    death.process = next(sentinels[each] for each in ready if isinstance(each, int))
    for process in context.processes:
        if process is not death.process:
            process.kill()
    # torch makes the queue of results first; the others lead to one worker each.
    context.queues[0].end()
    death.is_handled.set()


class _DueBatches(Sampler[list[int]]):
    """The batch sampler of workers: the numbers of the samples that are due."""

    def __init__(self) -> None:
        self.due: Iterator[list[int]] = iter(())

    def __iter__(self) -> Iterator[list[int]]:
        return self.due


_running: Final[WeakSet[Workers]] = WeakSet()
"""The workers of the passes of this process."""

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
            time.sleep(0.01)
            raise queue.Empty from None

    def put(self, obj: Any, block: bool = True, timeout: float | None = None) -> None:  # noqa: FBT001, FBT002
        """Put an item, unless the queue was ended."""
        if not self._is_ended:
            super().put(obj, block, timeout)


if sys.platform != "win32":

    class _ForkedProcess(ForkProcess):
        """A forked process that is sure to have begun once it was started."""

        _begun_signal: Any
        _target: Any
        _args: Any
        _kwargs: Any

        def run(self) -> None:
            self._begun_signal.send_bytes(b"begun")
            super().run()

        def start(self) -> None:
            """Start the process, again where it did not begin.

            Raises:
                WorkerError: If it never does.
            """
            work = (self._target, self._args, self._kwargs)
            for _ in range(_MOST_FORKS):
                self._target, self._args, self._kwargs = work  # a start drops them
                begun, self._begun_signal = connection.Pipe(duplex=False)
                with begun, self._begun_signal:
                    super().start()
                    if begun.poll(_BEGUN_WITHIN_S):
                        return
                self.kill()
                self.join()
                self._popen = None  # as before the start
            raise WorkerError(
                f"a DataLoader worker did not begin within {_BEGUN_WITHIN_S:g} s of its fork, in "
                f"{_MOST_FORKS} attempts: a thread of this process holds a lock. Use "
                f"multiprocessing_context='forkserver', which starts workers from a process "
                f"without threads."
            )


class _WatchedContext(BaseContext):
    """A context whose processes and queues can be watched; it starts them as another one does."""

    def __init__(self, base: BaseContext) -> None:
        self._base: Any = base  # the standard library does not declare its process
        self.processes: list[BaseProcess] = []
        self.queues: list[_ClosableQueue] = []
        self.events: list[_LocklessEvent] = []

    def get_start_method(self, allow_none: bool = False) -> str:  # noqa: FBT001, FBT002
        """Return the start method, by which locks are made."""
        method: str = self._base.get_start_method(allow_none)
        return method

    def told_to_end(self) -> bool:
        """Whether torch has told the workers to end, as it does after the last batch."""
        return any(event.is_set() for event in self.events)

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
