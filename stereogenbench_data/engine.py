"""Batch work on one interface with two engines: processes of this machine, or a Ray cluster.

`Engine.map` works on items in parallel and yields each result as it comes. A task is a function of
a module. It takes an item, and a function that it calls now and then with how much it has done
since the last call; that call raises an exception when the work is stopped. Results depend neither
on the engine nor on the number of workers.
"""

import importlib
import multiprocessing
import os
import platform
import signal
import socket
import threading
from abc import abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Final, TypeVar

from stereogenbench_data.errors import (
    StorageError,
    explain_os_errors,
    missing_extra,
    needs_extra,
)
from stereogenbench_data.schema.text import shortened

Item = TypeVar("Item")
Result = TypeVar("Result")
Advance = Callable[[int], None]
"""Called with how many bytes, frames or scenes were done since the last call."""

Progress = Callable[[int, int], None]
"""Called with how much is done by now, and how much there is."""

_POLL_S: Final = 0.2
_SHOWN: Final = 3


def no_advance(count: int) -> None:
    """Ignore what is done."""


def advance_of(progress: Progress | None, *, done: int = 0, total: int) -> Advance:
    """Return an `Advance` that adds up what is done, and reports the sum and the total."""

    def advance(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(min(done, total), total)

    return advance


class Engine:
    """Where the items of a batch are worked on: a `ProcessPool` or a `RayCluster`."""

    def map(
        self,
        task: Callable[[Item, Advance], Result],
        items: Sequence[Item],
        *,
        name: Callable[[Item], str],
        workers: int | None = None,
        advance: Advance = no_advance,
    ) -> Generator[Result, None, None]:
        """Do a task for each item and yield the results in any order; closing stops the rest.

        The error of a task is raised as it is, with a note that names the item, once the other
        tasks are stopped.

        Args:
            task: A function of a module, which other processes can import.
            items: The arguments of its calls; each can be pickled.
            name: Returns what messages call an item.
            workers: How many items are worked on at the same time; None for one per core.
            advance: Called now and then in this process with how much was done since.

        Raises:
            StorageError: If ``workers`` is below 1, or a worker died; the message names its item.
                Of Ray, also if no cluster is there or it has too few GPUs.
            ExtraError: If Ray is to be used and not installed.
        """
        require_workers(workers)
        with closing(self._results(_Work(task, items, name, advance), workers)) as results:
            yield from results

    @abstractmethod
    def _results(self, work: "_Work", workers: int | None) -> Generator[Any, None, None]:
        """Yield the result of each item as it comes."""


@dataclass(frozen=True, slots=True)
class _Work:
    """What `Engine.map` was given."""

    task: Callable[[Any, Advance], Any]
    items: Sequence[Any]
    name: Callable[[Any], str]
    advance: Advance

    @contextmanager
    def noting(self, item: Any) -> Iterator[None]:
        """Add the name of an item to any error that its task raises."""
        try:
            yield
        except BrokenProcessPool:
            raise
        except BaseException as error:
            error.add_note(f"This happened while {self.name(item)} was worked on.")
            raise


def engine_of(text: str, *, device: str = "cpu") -> Engine:
    """Return the engine that an option names.

    Args:
        text: "local"; "ray" for the cluster that Ray finds by itself (``RAY_ADDRESS``, or one on
            this machine); "ray://HOST:PORT" or "HOST:PORT" for the cluster at an address.
        device: Where tasks compute. On Ray each task has its own GPU, unless this is "cpu".

    Raises:
        StorageError: If the name is another one.
    """
    if text == "local":
        return LOCAL
    if text == "ray":
        text = "auto"
    elif not (text.startswith("ray://") or text.rpartition(":")[2].isdecimal()):
        raise StorageError(
            f"engine {text!r}: there is no such engine. Choose local, ray, ray://HOST:PORT or "
            f"HOST:PORT."
        )
    return RayCluster(text, gpus=int(device != "cpu"))


def require_workers(workers: int | None) -> None:
    """Refuse a number of workers below 1.

    Raises:
        StorageError: If it is one.
    """
    if workers is not None and workers < 1:
        raise StorageError(f"workers must be at least 1, got {workers}.")


# Processes of this machine.


class _Stopped(Exception):
    """The work was stopped."""


@dataclass(frozen=True, slots=True)
class _Shared:
    """State shared by the processes: how much is done, whether to stop, who works on which item."""

    done: "Synchronized[int]"
    stop: Event
    worked_on_by: Any
    """An array of the process id that works on each item; 0 before and after."""


_shared: list[_Shared] = []
"""In a worker process the state that it shares; empty elsewhere."""


@dataclass(frozen=True, slots=True)
class ProcessPool(Engine):
    """Processes of this machine; for one worker or one item, this process alone.

    The items of a dead worker are not tried again.
    """

    def _results(self, work: _Work, workers: int | None) -> Generator[Any, None, None]:
        items = work.items
        needed = min(workers or os.cpu_count() or 1, len(items))
        if needed <= 1:
            for item in items:
                with work.noting(item):
                    result = work.task(item, work.advance)
                yield result
            return
        context = multiprocessing.get_context("spawn")
        shared = _Shared(context.Value("q", 0), context.Event(), context.RawArray("q", len(items)))
        others = set(multiprocessing.active_children())
        workers_here: set[BaseProcess] = set()
        pool = ProcessPoolExecutor(
            needed, mp_context=context, initializer=_start_worker, initargs=(shared,)
        )
        try:
            cure = "Use one worker, or see whether Python may be executed here."
            failed = explain_os_errors("worker processes cannot be started", cure)
            with failed, _interrupts_held():
                futures = {
                    pool.submit(_run_in_process, work.task, item, number): item
                    for number, item in enumerate(items)
                }
            workers_here = set(multiprocessing.active_children()) - others
            reported, waiting = 0, set(futures)
            while waiting:
                finished, waiting = wait(waiting, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                done = shared.done.value
                work.advance(done - reported)
                reported = done
                for future in finished:
                    with work.noting(futures[future]):
                        result = future.result()
                    yield result
        except BrokenProcessPool as error:
            pool.shutdown()
            # Of the workers, the pool itself ended those with these codes.
            ended = {each.pid for each in workers_here if each.exitcode in (0, -signal.SIGTERM)}
            worked_on = zip(items, shared.worked_on_by, strict=True)
            named = [work.name(item) for item, pid in worked_on if pid and pid not in ended]
            where = f"{', '.join(named[:_SHOWN])}: " if named else ""
            raise StorageError(
                f"{where}a worker process died: it was killed (is memory short?), or the calling "
                f"script starts work without `if __name__ == '__main__':`. Run it again, with "
                f"fewer workers; what is finished is kept."
            ) from error
        finally:
            shared.stop.set()
            pool.shutdown(cancel_futures=True)


LOCAL: Final = ProcessPool()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Block Ctrl-C in processes that the block starts; here it takes effect after the block."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(shared: _Shared) -> None:
    """Prepare a worker: the main process handles Ctrl-C, and the worker ends when that ends."""

    def die_with_parent() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=die_with_parent, daemon=True).start()
    _shared.append(shared)


def _run_in_process(task: Callable[[Item, Advance], Result], item: Item, number: int) -> Result:
    (shared,) = _shared

    def advance(count: int) -> None:
        with shared.done.get_lock():
            shared.done.value += count
        if shared.stop.is_set():
            raise _Stopped

    shared.worked_on_by[number] = os.getpid()
    try:
        advance(0)
        return task(item, advance)
    finally:
        shared.worked_on_by[number] = 0


# A Ray cluster.

_TRIES: Final = 3
"""How often an item is tried whose workers die."""
_CANCEL_S: Final = 30.0
"""How long cancelled tasks have to remove their unfinished files."""
_RAY_POLL_S: Final = 1.0
_ANSWER_S: Final = 8.0
"""How long an address has to take a connection, and to answer."""
_HTTP2_PREFACE: Final = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
_HTTP2_KIND_AT: Final = 3
_HTTP2_SETTINGS: Final = b"\x04"
"""The kind of the frame that a server of HTTP/2 begins with (RFC 9113, section 3.4)."""
_START_RAY: Final = (
    "Start a cluster with `ray start --head` and give its address as the engine or by RAY_ADDRESS, "
    "or choose the engine `local`."
)
_LONGEST_TOLD: Final = 600
_PER_CORE: Final = 2
"""How many items are submitted to Ray for each core of the cluster, one of them waiting."""


@dataclass(frozen=True, slots=True)
class RayCluster(Engine):
    """A running Ray cluster, with one task per item; none is started. Needs the extra ``ray``.

    All nodes need this package, the same files at the same paths, and the working folder that
    relative paths start from. An item whose worker or node dies is tried again, twice at most.
    Progress is reported when an item is finished.

    Attributes:
        address: "ray://HOST:PORT" or "HOST:PORT"; "auto" for the cluster of ``RAY_ADDRESS`` or of
            this machine. If this process is connected to Ray already, that connection is used
            instead, and stays.
        gpus: How many GPUs each task has to itself.
    """

    address: str = "auto"
    gpus: int = 0

    def _results(self, work: _Work, workers: int | None) -> Generator[Any, None, None]:
        if not work.items:
            return
        with needs_extra("the engine 'ray'", "ray"):
            ray = importlib.import_module("ray")
        with _connected(ray, self.address):
            options = {"max_retries": _TRIES - 1, "num_cpus": 1, "num_gpus": self.gpus}
            remote = ray.remote(**options)(_run_on_ray)
            there = ray.cluster_resources()
            if there.get("GPU", 0) < self.gpus:
                raise StorageError(
                    f"{self.address}: this Ray cluster has {there.get('GPU', 0):g} GPUs, and each "
                    f"task needs {self.gpus}. Compute on the device cpu, or add a node with GPUs."
                )
            limit = workers or _PER_CORE * max(1, int(there.get("CPU", 1)))
            folder = str(Path.cwd())
            waiting = list(reversed(work.items))
            running: dict[Any, Any] = {}
            try:
                while waiting or running:
                    while waiting and len(running) < limit:
                        item = waiting.pop()
                        running[remote.remote(work.task, item, folder)] = item
                    finished, _ = ray.wait(list(running), num_returns=1, timeout=_RAY_POLL_S)
                    work.advance(0)
                    for reference in finished:
                        found, count = _ray_result(ray, reference, work, running.pop(reference))
                        work.advance(count)
                        yield found
            finally:
                for reference in running:
                    ray.cancel(reference)
                if running:
                    ray.wait(list(running), num_returns=len(running), timeout=_CANCEL_S)


def _ray_result(ray: Any, reference: Any, work: _Work, item: Any) -> tuple[Any, int]:
    """Return a task's result and how much it did."""
    try:
        found: tuple[Any, int] = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        if isinstance(cause, RuntimeError) and "failed to import" in str(cause).partition("\n")[0]:
            raise StorageError(
                f"{work.name(item)}: a node of the Ray cluster cannot import this package, or has "
                f"another version of it. Install the same stereogenbench-data on all nodes."
            ) from error
        failure = cause if isinstance(cause, Exception) else error
    except ray.exceptions.RayError as error:
        raise StorageError(
            f"{work.name(item)}: Ray did not finish it in {_TRIES} tries ({_one_line(error)}). "
            f"Check whether its worker was killed for lack of memory, and run it again with fewer "
            f"workers; what is finished is kept."
        ) from error
    else:
        return found
    with work.noting(item):
        raise failure


def _run_on_ray(
    task: Callable[[Item, Advance], Result], item: Item, working_folder: str
) -> tuple[Result, int]:
    """Return the result of a task, and how much it reported as done; a worker of Ray calls this."""
    where = f"{working_folder}: the working folder cannot be entered on the node {platform.node()}"
    with explain_os_errors(where, "Start the command in a folder that all nodes have."):
        os.chdir(working_folder)
    # Ray cancels a task as Ctrl-C does, which the workers of a node that a script started ignore.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count

    return task(item, advance), done


@contextmanager
def _connected(ray: Any, address: str) -> Iterator[None]:
    if ray.is_initialized():
        yield
        return
    on_end = signal.getsignal(signal.SIGTERM)
    if address == "auto":  # of which Ray itself takes no ray:// from there
        address = os.environ.get("RAY_ADDRESS") or address
    try:
        # What Ray finds by itself may be a cluster that has died.
        find = ray._private.services.canonicalize_bootstrap_address
        _require_answer(find(address) if address == "auto" else address)
        ray.init(address=address, log_to_driver=False)
    except (ConnectionError, ImportError, RuntimeError, ValueError) as error:
        if "ray[client]" in str(error):
            raise missing_extra(f"the engine {address!r}", "ray", _one_line(error)) from error
        cure = _START_RAY
        if "version" in str(error).lower():
            cure = "Install the same releases of Ray and of Python here and on all nodes."
        raise StorageError(
            f"{address}: no Ray cluster could be connected to ({_one_line(error)}). {cure}"
        ) from error
    try:
        if threading.current_thread() is threading.main_thread() and on_end is not None:
            signal.signal(signal.SIGTERM, on_end)  # Ray has replaced it.
        yield
    finally:
        ray.shutdown()


def _require_answer(address: str) -> None:
    """Raise unless what is at HOST:PORT answers by HTTP/2, as Ray does; Ray itself waits for long.

    Other addresses, which Ray looks up, are not asked.

    Raises:
        StorageError: If nothing is there, or something else than Ray.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=_ANSWER_S) as there:
            if os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true"):
                return
            there.sendall(_HTTP2_PREFACE)
            with there.makefile("rb") as answer:
                kind = answer.read(_HTTP2_KIND_AT + 1)[_HTTP2_KIND_AT:]
    except (OSError, OverflowError, UnicodeError) as error:
        raise StorageError(f"{address}: nothing answers there ({error}). {_START_RAY}") from error
    if kind != _HTTP2_SETTINGS:
        raise StorageError(f"{address}: what answers there is not Ray. {_START_RAY}")


def _one_line(error: BaseException) -> str:
    return shortened(" ".join(str(error).split()), _LONGEST_TOLD) or type(error).__name__
