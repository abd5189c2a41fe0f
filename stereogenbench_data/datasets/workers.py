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

import functools
import os
import queue
import signal
import threading
import time
from multiprocessing import connection, get_context
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from multiprocessing.queues import Queue
from typing import TYPE_CHECKING, Any

from stereogenbench_data.errors import WorkerError

_BEGUN_WITHIN_S = 20.0
"""How long a forked worker may take to its first line of Python; usually milliseconds."""

_MOST_FORKS = 3
"""How often a worker is forked that does not begin."""

_NOTICED_AFTER_S = 2.0
"""How long torch may know of a death before this module's thread does."""


class WorkerContext:
    """What starts the workers of a pass: a `multiprocessing` context of the requested start method.

    Attributes:
        context: To be passed to `DataLoader`.
        dead: The first worker that ended while it was watched.
    """

    def __init__(self, given: BaseContext | str | None) -> None:
        """Begin without workers.

        Args:
            given: A start method ("fork", "spawn", "forkserver"), a context, or None for the
                system's own.
        """
        base = given.get_context() if isinstance(given, BaseContext) else get_context(given)
        kind: Any = type(base)
        self.context: Any = _watched(kind)()
        self.dead: BaseProcess | None = None
        self._is_dead = threading.Event()
        self._stop_reader, self._stop_writer = connection.Pipe(duplex=False)
        self._thread: threading.Thread | None = None
        self._pid = os.getpid()

    @property
    def pids(self) -> set[int]:
        """The numbers of the worker processes."""
        return {process.pid for process in self.context.processes}

    @property
    def is_of_this_process(self) -> bool:
        """Whether the workers are this process's, not those of one that it was forked from."""
        return os.getpid() == self._pid

    def watch(self) -> None:
        """Begin to wait for the end of each worker that was started."""
        self._thread = threading.Thread(target=self._wait, name="worker-watch", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop waiting: from now on workers may end."""
        if self._thread is not None and self.is_of_this_process:
            self._stop_writer.send_bytes(b"stop")
            if threading.current_thread() is not self._thread:
                self._thread.join()
        self._thread = None

    def error(self, noticed: BaseException) -> WorkerError | None:
        """Return an error that names the worker that died; None if none did.

        Args:
            noticed: What the loop met. Where torch says that a worker process raised it, that is no
                death; where it says so of its thread that pins memory, that thread may have read
                what a dead worker left behind.
        """
        is_a_workers_own = "in DataLoader worker process" in str(noticed).partition("\n")[0]
        if is_a_workers_own or not self._is_dead.wait(_NOTICED_AFTER_S) or self.dead is None:
            return None
        self.dead.join(_NOTICED_AFTER_S)
        code = self.dead.exitcode
        how, cure = f"exited with status {code}", "Its traceback is above."
        method = getattr(self.dead, "_start_method", "fork")
        if code is not None and code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
            cure = "If memory ran out, use fewer workers or open_scenes."
        elif method != "fork":
            cure += (
                f" Workers of the start method {method!r} import the script again: its loop must "
                "stand below `if __name__ == '__main__':`."
            )
        return WorkerError(
            f"a DataLoader worker (pid {self.dead.pid}) {how} in the middle of a pass "
            f"({type(noticed).__name__}: {noticed}). {cure} Load the last state_dict() to go on."
        )

    def _wait(self) -> None:
        sentinels = {process.sentinel: process for process in self.context.processes}
        ready = connection.wait([self._stop_reader, *sentinels])
        if self._stop_reader in ready or self.context.told_to_end():
            return
        self.dead = next(sentinels[each] for each in ready if isinstance(each, int))
        for process in self.context.processes:
            if process is not self.dead:
                process.kill()
        # torch makes the queue of results first; the others lead to one worker each.
        self.context.queues[0].end()
        self._is_dead.set()


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


@functools.cache
def _forked(kind: Any) -> Any:
    """Return a class of forked processes that are sure to have begun once they were started."""

    class Forked(kind):  # type: ignore[misc]  # the class depends on the context
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

    return Forked


@functools.cache
def _watched(kind: Any) -> Any:
    """Return a context's class whose processes and queues can be watched."""

    class Watched(kind):  # type: ignore[misc]  # the class depends on the start method
        def __init__(self) -> None:
            self.processes: list[BaseProcess] = []
            self.queues: list[_ClosableQueue] = []
            self.events: list[_LocklessEvent] = []

        def told_to_end(self) -> bool:
            """Whether torch has told the workers to end, as it does after the last batch."""
            return any(event.is_set() for event in self.events)

        def Process(self, *args: Any, **kwargs: Any) -> BaseProcess:
            make = kind.Process
            if getattr(make, "_start_method", "") == "fork":
                make = _forked(make)
            process: BaseProcess = make(*args, **kwargs)
            self.processes.append(process)
            return process

        def Queue(self, maxsize: int = 0) -> _ClosableQueue:
            made = _ClosableQueue(maxsize, ctx=self)
            self.queues.append(made)
            return made

        def Event(self) -> _LocklessEvent:
            made = _LocklessEvent(self)
            self.events.append(made)
            return made

    return Watched
