"""Retries: what is tried again, after which wait, and when reading from a server gives up."""

import math
import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

from stereogenbench_data.errors import StorageError

_BYTES_PER_TIME_LIMIT: Final = 8 * 2**20
"""The time limit of a read starts anew after this many bytes."""


def _random() -> float:
    """Draw from 0 to 1, without changing the program's own random numbers."""
    return random.SystemRandom().random()


class TransientError(Exception):
    """A failure that may pass; ``wait_s`` is the wait that the server asked for, in seconds."""

    def __init__(self, reason: str, *, wait_s: float = 0.0) -> None:
        """Take what happened, for messages."""
        super().__init__(reason)
        self.wait_s = wait_s


class TooSlow(TimeoutError):
    """A response was too slow; the message names the limit that it exceeded."""


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How often reading from a server is retried, how long it waits, and how slow a server may be.

    Attributes:
        attempts: Consecutive attempts below the least rate before reading gives up.
        first_wait_s: Seconds before the second attempt. The wait doubles with each attempt and is
            shortened at random by up to a half, so that many workers do not retry at once.
        longest_wait_s: The longest wait in seconds, unless the server asks for more.
        longest_asked_s: The longest wait in seconds that a server may ask for; beyond it reading
            gives up.
        timeout_s: Seconds until a connection is made, and seconds until a response begins,
            redirects included.
        least_rate_bytes_s: Bytes per second that a response must deliver once it has begun. Fewer
            over ``window_s`` end the attempt.
        window_s: Seconds over which the rate is measured.
        longest_read_s: Seconds that one read may take with all attempts and waits; of a long read,
            each 8 MiB. Time without a request to the server does not count.
        sleep: Waits so many seconds.
        chance: Draws a random number from 0 to 1.
        clock: Returns the time in seconds.
    """

    attempts: int = 6
    first_wait_s: float | int = 0.5
    longest_wait_s: float | int = 30.0
    longest_asked_s: float | int = 300.0
    timeout_s: float | int = 30.0
    least_rate_bytes_s: float | int = 4096.0
    window_s: float | int = 10.0
    longest_read_s: float | int = 600.0
    sleep: Callable[[float], None] = field(default=time.sleep, repr=False)
    chance: Callable[[], float] = field(default=_random, repr=False)
    clock: Callable[[], float] = field(default=time.monotonic, repr=False)

    def __post_init__(self) -> None:
        """Refuse limits without an effect.

        Raises:
            StorageError: If there is no attempt, or a limit is negative or not a number.
        """
        above_zero = ("attempts", "timeout_s", "window_s", "longest_read_s")
        for name in (*above_zero, "least_rate_bytes_s", "first_wait_s", "longest_wait_s"):
            value = getattr(self, name)
            if not value >= 0 or (name in above_zero and value == 0):
                least = "above 0" if name in above_zero else "0 or more"
                raise StorageError(f"RetryPolicy: {name} must be {least}, got {value!r}.")

    def wait(self, error: TransientError, *, failures: int, left_s: float = math.inf) -> bool:
        """Wait before the next attempt, after so many consecutive failures.

        Returns:
            False, at once, to give up: after the last attempt, or if the wait would take as long
            as ``left_s``.
        """
        if failures >= self.attempts or error.wait_s > self.longest_asked_s:
            return False
        backoff_s = min(self.longest_wait_s, self.first_wait_s * 2.0 ** min(failures - 1, 60))
        wait_s = max(error.wait_s, backoff_s * (1 - self.chance() / 2))
        if wait_s >= left_s:
            return False
        self.sleep(wait_s)
        return True


class Attempt:
    """The time limits of one attempt: it counts each wait for bytes and limits the next one.

    Attributes:
        clock: Returns the time in seconds.
        left_s: Seconds that the read has left.
    """

    def __init__(self, policy: RetryPolicy, *, left_s: float) -> None:
        """Begin with the head of a response, in a read that has ``left_s`` left."""
        self.clock = policy.clock
        self.left_s = left_s
        self._policy = policy
        self._in_body = False
        self._waited_s = 0.0
        self._received = 0

    def begin_body(self) -> None:
        """Begin the body of a response, whose rate is measured."""
        self._in_body, self._waited_s, self._received = True, 0.0, 0

    def next_wait_s(self) -> float:
        """Return how many seconds the next wait may last, above 0.

        Raises:
            TooSlow: If no time is left.
        """
        limit_s = self._policy.window_s if self._in_body else self._policy.timeout_s
        wait_s = min(limit_s - self._waited_s, self.left_s)
        if wait_s <= 0:
            raise self.too_slow()
        return wait_s

    def add(self, waited_s: float, received: int) -> None:
        """Count a wait, and the bytes received in it."""
        self.left_s -= waited_s
        self._waited_s += waited_s
        self._received += received
        enough = self._policy.least_rate_bytes_s * self._policy.window_s
        if self._in_body and received and self._received >= enough:
            self._waited_s, self._received = 0.0, 0

    def too_slow(self) -> TooSlow:
        """Return the error that names the exceeded limit."""
        if self.left_s <= 0:
            return TooSlow(f"a read may take {self._policy.longest_read_s:g} s")
        if self._in_body:
            return TooSlow(
                f"fewer than {self._policy.least_rate_bytes_s:.10g} bytes a second over "
                f"{self._policy.window_s:g} s"
            )
        return TooSlow(f"no answer within {self._policy.timeout_s:g} s")


class RetryState:
    """One read's state: the time spent, and the consecutive attempts below the least rate."""

    def __init__(self, policy: RetryPolicy) -> None:
        """Begin a read."""
        self.failures = 0
        self._policy = policy
        self._spent_s = 0.0
        self._attempt_s = 0.0
        self._received = 0

    def attempt(self) -> Attempt:
        """Return the limits of the next attempt."""
        left_s = max(0.0, self._policy.longest_read_s - self._spent_s)
        return Attempt(self._policy, left_s=left_s)

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
        """Wait before the next attempt; ``received`` is of the last one. False gives up."""
        policy = self._policy
        is_fast = received > 0 and received >= policy.least_rate_bytes_s * self._attempt_s
        self.failures = 1 if is_fast else self.failures + 1
        self._attempt_s = 0.0
        with self.timed():
            left_s = policy.longest_read_s - self._spent_s
            return policy.wait(error, failures=self.failures, left_s=left_s)

    def describe(self, error: TransientError) -> str:
        """Return what happened, and how often it was tried, for a message."""
        asked = f", which asks to wait {error.wait_s:.0f} s" if error.wait_s else ""
        tries = f"{self.failures} tr{'y' if self.failures == 1 else 'ies'}"
        return f"{error}{asked}; {tries}"
