"""Fetching ahead: the bytes that coming samples need are fetched while others are decoded.

The caller plans samples in the order in which they will be read, and releases each after it was
read. Ranges that lie beside each other are fetched in one request, as long as none of them has
begun. Threads fetch the ranges in the order in which they are needed; a thread ends when there is
nothing left to fetch. What could not be fetched raises its error where it is read.
"""

import operator
import os
import sys
import threading
import weakref
from bisect import bisect_right, insort
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, field
from itertools import islice, takewhile
from typing import Final, NamedTuple

from stereogenbench_data.errors import SelectionError

FETCH_AHEAD_BYTES: Final = 256_000_000
"""Bytes that a process fetches ahead at the most, unless the user says otherwise."""

CONNECTIONS: Final = 8
"""Requests that a process makes at a time."""

LARGEST_REQUEST: Final = 2 * 1024 * 1024
"""Bytes to which ranges beside each other are merged."""

LARGEST_GAP: Final = 2048
"""Bytes that nobody needs between two ranges that are merged: the headers of a tar."""

_START: Final = operator.attrgetter("start")


class Wanted(NamedTuple):
    """A range of bytes that a sample needs.

    Attributes:
        place: What tells objects apart: ranges of one place are merged.
        start: The first byte.
        stop: The byte behind the last one.
        fetch: Returns the bytes from a start to a stop.
        held_bytes: How many bytes it counts for, where these are not those of the range.
    """

    place: Hashable
    start: int
    stop: int
    fetch: Callable[[int, int], bytes]
    held_bytes: int | None = None


@dataclass(slots=True, eq=False)
class _Part:
    """A range that is fetched in one request.

    Attributes:
        first: The sample that needs it first.
        last: The sample that needs it last.
    """

    place: Hashable
    start: int
    stop: int
    fetch: Callable[[int, int], bytes]
    first: int
    last: int
    held_bytes: int
    data: Future[bytes] = field(default_factory=Future)

    @property
    def has_begun(self) -> bool:
        """Whether its request is under way, or was made; or nobody wants it any more."""
        return self.data.running() or self.data.done()


@dataclass(slots=True)
class _State:
    """What the threads of a process share."""

    pid: int = field(default_factory=os.getpid)
    lock: threading.Lock = field(default_factory=threading.Lock)
    queue: deque[_Part] = field(default_factory=deque)
    threads: set[threading.Thread] = field(default_factory=set)
    parts: dict[Hashable, list[_Part]] = field(default_factory=lambda: defaultdict(list))
    due: dict[int, list[_Part]] = field(default_factory=lambda: defaultdict(list))
    planned_bytes: int = 0
    up_to: int = -1


class FetchAhead:
    """Fetches ranges ahead of their reader, which is one thread.

    It belongs to the process that uses it: a fork begins with nothing planned.

    Attributes:
        limit_bytes: How many bytes may be planned and not yet released; 0 plans nothing ahead.
        requests: How many ranges were fetched, of those that were released.
        bytes: Their bytes.
    """

    def __init__(self, *, limit_bytes: int = FETCH_AHEAD_BYTES) -> None:
        """Fetch nothing yet.

        Raises:
            SelectionError: If the number is out of its range.
        """
        try:
            self.limit_bytes = -1 if isinstance(limit_bytes, bool) else operator.index(limit_bytes)
        except TypeError:
            self.limit_bytes = -1
        if self.limit_bytes < 0:
            raise SelectionError(
                f"fetch_ahead_bytes must be a whole number from 0, got {limit_bytes!r}."
            )
        self.requests = self.bytes = 0
        self._own: _State | None = None
        self._finalizer: Callable[[], object] | None = None

    @property
    def _state(self) -> _State:
        if self._own is None or self._own.pid != os.getpid():
            self._own = _State()
            self._finalizer = weakref.finalize(self, _end, self._own)
        return self._own

    @property
    def planned_bytes(self) -> int:
        """How many bytes are planned, under way or here."""
        return self._state.planned_bytes

    def plan(self, sample: int, wanted: Iterable[Wanted]) -> None:
        """Plan ranges for a sample, whose number is above those of all samples before."""
        state = self._state
        with state.lock:
            for each in wanted:
                for start, stop in _uncovered(state, each, sample):
                    _add(state, each, start, stop, sample)

    def begin(self, sample: int = sys.maxsize) -> None:
        """Fetch what is planned for the samples up to one; what is planned for others may grow."""
        state = self._state
        with state.lock:
            state.up_to = sample
            waiting = sum(part.first <= sample for part in state.queue)
            for _ in range(min(waiting, CONNECTIONS - len(state.threads))):
                thread = threading.Thread(
                    target=_work, args=(state,), name="fetch-ahead", daemon=True
                )
                thread.start()  # it waits until this block is left
                state.threads.add(thread)

    def read(self, place: Hashable, at: int) -> tuple[int, bytes] | None:
        """Return the fetched range that holds a byte, and where it begins; None if none is planned.

        Raises:
            StorageError: If it could not be fetched.
        """
        state = self._state
        with state.lock:
            found = _touching(state, place, at, at + 1)
            if not found or found[0].first > state.up_to:
                return None
            part = found[0]
        try:
            return part.start, part.data.result()
        except CancelledError:
            return None
        except BaseException:
            with state.lock:
                _drop(state, part)  # who tries again fetches again
            raise

    def release(self, sample: int) -> None:
        """Forget what no sample after this one needs."""
        state = self._state
        with state.lock:
            for part in state.due.pop(sample, ()):
                if part.last != sample:
                    continue
                has_ended = part.data.done() and not part.data.cancelled()
                is_here = has_ended and part.data.exception() is None
                if is_here and part.held_bytes == part.stop - part.start:
                    self.requests, self.bytes = self.requests + 1, self.bytes + part.held_bytes
                _drop(state, part)

    def close(self) -> None:
        """Forget everything; threads end with their requests. It can be used again."""
        self._own = None
        if self._finalizer is not None:
            self._finalizer()

    def __getstate__(self) -> dict[str, object]:
        """Return the state for a copy in another process."""
        return self.__dict__ | {"_own": None, "_finalizer": None, "requests": 0, "bytes": 0}


class PlannedFetches(FetchAhead):
    """Counts what would be fetched, and fetches nothing."""

    def begin(self, sample: int = sys.maxsize) -> None:
        """Take what is planned for the samples up to one as fetched."""
        state = self._state
        state.up_to = sample
        while state.queue and state.queue[0].first <= sample:
            part = state.queue.popleft()
            if part.data.set_running_or_notify_cancel():
                part.data.set_result(b"")


def _uncovered(state: _State, wanted: Wanted, sample: int) -> list[tuple[int, int]]:
    """Return what is not planned of a range; what is planned is kept for the sample."""
    left, start = [], wanted.start
    for part in _touching(state, wanted.place, wanted.start, wanted.stop):
        if part.last < sample:
            part.last = sample
            state.due[sample].append(part)
        left.append((start, part.start))
        start = part.stop
    left.append((start, wanted.stop))
    return [(begin, end) for begin, end in left if begin < end]


def _touching(state: _State, place: Hashable, start: int, stop: int) -> list[_Part]:
    """Return the parts that share a byte with a range; parts do not overlap."""
    parts = state.parts.get(place, [])
    first = bisect_right(parts, start, key=_START)
    first -= first > 0 and parts[first - 1].stop > start
    return list(takewhile(lambda part: part.start < stop, islice(parts, first, None)))


def _add(state: _State, wanted: Wanted, start: int, stop: int, sample: int) -> None:
    """Plan a range: by a request that has not begun and ends just before it, else by its own."""
    parts = state.parts[wanted.place]
    place = bisect_right(parts, start, key=_START)
    before = parts[place - 1] if place else None
    if (
        before is not None
        and not before.has_begun
        and start - before.stop <= LARGEST_GAP
        and stop - before.start <= LARGEST_REQUEST
    ):
        state.planned_bytes += stop - before.stop
        before.held_bytes += stop - before.stop
        before.stop = stop
        if before.last < sample:
            before.last = sample
            state.due[sample].append(before)
        return
    for begin in range(start, stop, LARGEST_REQUEST):
        end = min(begin + LARGEST_REQUEST, stop)
        held_bytes = end - begin if wanted.held_bytes is None else wanted.held_bytes
        part = _Part(wanted.place, begin, end, wanted.fetch, sample, sample, held_bytes)
        insort(parts, part, key=_START)
        state.due[sample].append(part)
        state.planned_bytes += held_bytes
        state.queue.append(part)


def _drop(state: _State, part: _Part) -> None:
    parts = state.parts[part.place]
    if part in parts:
        parts.remove(part)
        state.planned_bytes -= part.held_bytes
        part.data.cancel()
    if not parts:
        del state.parts[part.place]


def _work(state: _State) -> None:
    """Fetch what is queued, in a thread of its own."""
    while True:
        with state.lock:
            if not state.queue or state.queue[0].first > state.up_to:
                state.threads.discard(threading.current_thread())
                return
            part = state.queue.popleft()
            if not part.data.set_running_or_notify_cancel():
                continue
        try:
            part.data.set_result(part.fetch(part.start, part.stop))
        except BaseException as error:  # noqa: BLE001 - raised again in the thread that reads
            part.data.set_exception(error)


def _end(state: _State) -> None:
    """Let the threads of this process find nothing more to fetch."""
    if state.pid == os.getpid():
        with state.lock:
            for part in [part for parts in state.parts.values() for part in parts]:
                _drop(state, part)
            state.queue.clear()
            state.due.clear()
