"""Retries: what is tried again, after which wait, and when reading from a server gives up."""

import math
import os
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import ClassVar, Final

from stereogenbench_data.errors import StorageError

_BYTES_PER_TIME_LIMIT: Final = 8 * 2**20
"""The time limit of a read starts anew after this many bytes."""


class ReadCancelled(StorageError):
    """A read was ended by its `Cancellation`."""


class TransientError(Exception):
    """A failure that may pass.

    Attributes:
        wait_s: Seconds that the server asked to wait, 0 if it did not ask.
        pause_until_s: The time at which a pause of all connections to the server ends, in seconds
            since 1970; 0 if there is none. A read waits for each pause once.
        was_sent: Whether a request was sent, so that the failure counts as an attempt.
    """

    def __init__(
        self,
        reason: str,
        *,
        wait_s: float = 0.0,
        pause_until_s: float = 0.0,
        was_sent: bool = True,
    ) -> None:
        """Take what happened, for messages."""
        super().__init__(reason)
        self.wait_s = wait_s
        self.pause_until_s = pause_until_s
        self.was_sent = was_sent


class TooSlow(TimeoutError):
    """A response was too slow; the message names the limit that it exceeded."""


class Cancellation:
    """Ends reads from another thread: those under way at once, later ones when they begin.

    Any number of reads of any number of threads may share one.
    """

    def __init__(self) -> None:
        """Begin without having cancelled anything."""
        self._event = threading.Event()
        self._lock = threading.RLock()  # a signal handler may cancel
        self._ends: dict[int, Callable[[], None]] = {}
        self._number = 0

    @property
    def is_cancelled(self) -> bool:
        """Whether `cancel` was called."""
        return self._event.is_set()

    def cancel(self) -> None:
        """End all reads: their sockets are shut down, their waits end."""
        self._event.set()
        with self._lock:
            for end in list(self._ends.values()):
                end()

    def wait(self, seconds: float) -> None:
        """Wait so many seconds, or until `cancel` is called."""
        self._event.wait(seconds)

    def add(self, end: Callable[[], None]) -> int:
        """Let `cancel` call a function, which must not wait; return a number for `remove`."""
        with self._lock:
            self._number += 1
            self._ends[self._number] = end
            return self._number

    def remove(self, number: int) -> None:
        """Forget a function."""
        with self._lock:
            self._ends.pop(number, None)


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How long reading waits for a server, and how often it tries again.

    Attributes:
        timeout_s: Seconds until a response begins, connecting and redirects included. The other
            limits of time grow with it: reading gives up after 2.25 times as long without data.
    """

    timeout_s: float | int = 20.0

    attempts: ClassVar[int] = 10
    """Consecutive attempts below the least rate before reading gives up."""
    first_wait_s: ClassVar[float] = 0.02
    """Seconds before the second attempt. The wait doubles with each attempt and is shortened at
    random by up to a half, so that many workers do not retry at once."""
    longest_wait_s: ClassVar[float] = 10.0
    """The longest wait, unless the server asks for more."""
    longest_retry_after_s: ClassVar[float] = 300.0
    """The longest wait that a server may request (Retry-After); beyond it reading gives up."""
    least_rate_bytes_s: ClassVar[float] = 4096.0
    """Bytes per second that a response must deliver once it has begun. Fewer over ``window_s`` end
    the attempt."""

    def __post_init__(self) -> None:
        """Refuse a limit without an effect.

        Raises:
            StorageError: If the time is not a number above 0.
        """
        if not self.timeout_s > 0:
            raise StorageError(f"RetryPolicy: timeout_s must be above 0, got {self.timeout_s!r}.")

    @property
    def window_s(self) -> float:
        """Seconds over which the rate of a response is measured."""
        return self.timeout_s / 2

    @property
    def longest_outage_s(self) -> float:
        """Seconds without the least rate, over all attempts and waits, until reading gives up.

        Waits that the server asks for do not count.
        """
        return self.timeout_s * 2.25

    @property
    def longest_read_s(self) -> float:
        """Seconds that one read may take with all attempts and waits; of a long one, each 8 MiB.

        Time without a request to the server does not count.
        """
        return self.timeout_s * 30.0

    def clock(self) -> float:
        """Return the time in seconds."""
        return time.monotonic()

    def chance(self) -> float:
        """Draw from 0 to 1, without changing the program's own random numbers."""
        return random.SystemRandom().random()

    def sleep(self, wait_s: float, *, cancellation: Cancellation | None) -> None:
        """Wait so many seconds, or until reads are cancelled."""
        if cancellation is None:
            time.sleep(wait_s)
        else:
            cancellation.wait(wait_s)

    def backoff_s(self, failures: int) -> float:
        """Return the wait before the next attempt, after so many consecutive failures."""
        longest_s = min(self.longest_wait_s, self.first_wait_s * 2.0 ** min(failures - 1, 60))
        return longest_s * (1 - self.chance() / 2)

    def spread_s(self, wait_s: float) -> float:
        """Return a wait that the server asked for, up to a second longer if others waited too.

        So the connections of a machine do not all ask again in the same moment.
        """
        return wait_s + self.chance() * min(1.0, 0.1 * wait_s)


class Attempt:
    """The time limits of one attempt: it counts each wait for bytes and limits the next one.

    Attributes:
        clock: Returns the time in seconds.
        left_s: Seconds that the read has left.
        outage_left_s: Seconds that the read has left without the least rate.
        policy: The limits.
        waited_for_s: Pauses of the server until this time, in seconds since 1970, are over for
            this read: it has waited for them.
    """

    def __init__(
        self,
        policy: RetryPolicy,
        *,
        left_s: float,
        outage_left_s: float = math.inf,
        cancellation: Cancellation | None = None,
        waited_for_s: float = 0.0,
    ) -> None:
        """Begin with the head of a response, in a read that has ``left_s`` left."""
        self.clock = policy.clock
        self.left_s = left_s
        self.outage_left_s = outage_left_s
        self.policy = policy
        self.waited_for_s = waited_for_s
        self._cancellation = cancellation
        self._ends: list[Callable[[], None]] = []
        self._number = 0
        self._in_body = False
        self._waited_s = 0.0
        self._received = 0

    def begin_body(self) -> None:
        """Begin the body of a response, whose rate is measured."""
        self._in_body, self._waited_s, self._received = True, 0.0, 0

    def next_wait_s(self) -> float:
        """Return how many seconds the next wait may last, above 0.

        Raises:
            TooSlow: If no time is left, or the read was cancelled.
        """
        limit_s = self.policy.window_s if self._in_body else self.policy.timeout_s
        wait_s = min(limit_s - self._waited_s, self.left_s, self.outage_left_s)
        if wait_s <= 0 or self.is_cancelled:
            raise self.too_slow()
        return wait_s

    def add(self, waited_s: float, received: int) -> None:
        """Count a wait, and the bytes received in it."""
        self.left_s -= waited_s
        self.outage_left_s -= waited_s
        self._waited_s += waited_s
        self._received += received
        enough = self.policy.least_rate_bytes_s * self.policy.window_s
        if self._in_body and received and self._received >= enough:
            self._waited_s, self._received = 0.0, 0
            self.outage_left_s = self.policy.longest_outage_s

    def too_slow(self) -> TooSlow:
        """Return the error that names the exceeded limit."""
        if self.is_cancelled:
            return TooSlow("cancelled")
        if self.left_s <= 0:
            return TooSlow(f"a read may take {self.policy.longest_read_s:g} s")
        if self.outage_left_s <= 0:
            return TooSlow(f"too little came for {self.policy.longest_outage_s:g} s")
        if self._in_body:
            return TooSlow(
                f"fewer than {self.policy.least_rate_bytes_s:.10g} bytes a second over "
                f"{self.policy.window_s:g} s"
            )
        return TooSlow(f"no answer within {self.policy.timeout_s:g} s")

    @property
    def is_cancelled(self) -> bool:
        """Whether the read was cancelled."""
        return self._cancellation is not None and self._cancellation.is_cancelled

    def on_cancel(self, end: Callable[[], None]) -> None:
        """Call a function, which must not wait, if the read is cancelled during this attempt."""
        if self._cancellation is not None:
            self._ends.append(end)
            if self._cancellation.is_cancelled:
                end()

    def __enter__(self) -> "Attempt":
        """Begin the attempt."""
        if self._cancellation is not None:
            self._number = self._cancellation.add(self._end)
        return self

    def __exit__(self, *_: object) -> None:
        """End the attempt: cancelling has no effect on its connection any more."""
        if self._cancellation is not None:
            self._cancellation.remove(self._number)
            self._ends.clear()

    def _end(self) -> None:
        for end in list(self._ends):
            end()


class ProcessLock:
    """A lock for the threads of one process: after a fork, or in a pickled copy, it is free."""

    def __init__(self) -> None:
        """Begin free."""
        self._process, self._lock = os.getpid(), threading.Lock()

    def __reduce__(self) -> tuple[type["ProcessLock"], tuple[()]]:
        """Return how a copy is made: free."""
        return ProcessLock, ()

    @contextmanager
    def held(self, attempt: Attempt) -> Iterator[None]:
        """Hold the lock; wait for it within the limits of an attempt.

        Raises:
            TransientError: If that takes longer.
        """
        if self._process != os.getpid():  # a thread that does not exist here may hold it
            self._process, self._lock = os.getpid(), threading.Lock()
        lock, began_s = self._lock, attempt.clock()
        try:
            has_turn = lock.acquire(timeout=attempt.next_wait_s())
        except TooSlow as error:
            raise TransientError(str(error)) from None
        attempt.add(attempt.clock() - began_s, 0)
        if not has_turn:
            raise TransientError(str(attempt.too_slow()))
        try:
            yield
        finally:
            lock.release()


def shut_down(connection: socket.socket) -> None:
    """End all waits for a connection, of any thread; the connection stays to be closed."""
    with suppress(OSError):
        # Of a TLS connection, too, without a farewell for which it would wait.
        socket.socket.shutdown(connection, socket.SHUT_RDWR)


class RetryState:
    """One read's state: the time spent, and the consecutive attempts below the least rate."""

    def __init__(self, policy: RetryPolicy, *, cancellation: Cancellation | None = None) -> None:
        """Begin a read."""
        self.failures = 0
        self._policy = policy
        self._cancellation = cancellation
        self._spent_s = 0.0
        self._outage_s = 0.0
        self._attempt_s = 0.0
        self._received = 0
        self._waited_for_s = 0.0

    @property
    def is_cancelled(self) -> bool:
        """Whether the read was cancelled."""
        return self._cancellation is not None and self._cancellation.is_cancelled

    def attempt(self) -> Attempt:
        """Return the limits of the next attempt."""
        return Attempt(
            self._policy,
            left_s=max(0.0, self._policy.longest_read_s - self._spent_s),
            outage_left_s=max(0.0, self._policy.longest_outage_s - self._outage_s),
            cancellation=self._cancellation,
            waited_for_s=self._waited_for_s,
        )

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Count the time that the block takes."""
        began_s = self._policy.clock()
        try:
            yield
        finally:
            spent_s = self._policy.clock() - began_s
            self._spent_s += spent_s
            self._attempt_s += spent_s

    def add(self, received: int) -> None:
        """Count received bytes."""
        before, self._received = self._received, self._received + received
        if before // _BYTES_PER_TIME_LIMIT != self._received // _BYTES_PER_TIME_LIMIT:
            self._spent_s = 0.0

    def wait(self, error: TransientError, *, received: int) -> bool:
        """Wait before the next attempt; ``received`` is of the last one.

        Returns:
            False, at once, to give up: after the last attempt, or if no time would be left.
        """
        policy = self._policy
        is_fast = received > 0 and received >= policy.least_rate_bytes_s * self._attempt_s
        self._outage_s = 0.0 if is_fast else self._outage_s + self._attempt_s
        if error.was_sent:
            self.failures = 1 if is_fast else self.failures + 1
        if self.failures >= policy.attempts or error.wait_s > policy.longest_retry_after_s:
            return False
        backoff_s = policy.backoff_s(max(1, self.failures))
        is_asked = error.wait_s >= backoff_s
        wait_s = policy.spread_s(error.wait_s) if is_asked else backoff_s
        self._attempt_s = 0.0
        if wait_s >= policy.longest_read_s - self._spent_s:
            return False
        if not is_asked and wait_s >= policy.longest_outage_s - self._outage_s:
            return False
        with self.timed():
            policy.sleep(wait_s, cancellation=self._cancellation)
        if is_asked:
            self._attempt_s = 0.0
        self._waited_for_s = max(self._waited_for_s, error.pause_until_s)
        return True

    def describe(self, error: TransientError) -> str:
        """Return what happened, and how often it was tried, for a message."""
        asked = f", which asks to wait {error.wait_s:.0f} s" if error.wait_s else ""
        tries = f"{self.failures} tr{'y' if self.failures == 1 else 'ies'}"
        return f"{error}{asked}; {tries}"
