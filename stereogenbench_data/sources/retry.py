"""Patience with a network: what is tried again, after which wait, and when to give up."""

import math
import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from stereogenbench_data.errors import StorageError

_BYTES_A_BOUND: Final = 8 * 2**20
"""Bytes of a read for which the bound on its time holds; the next ones have as long again."""

_JITTER: Final = random.SystemRandom()
"""Not the program's own random numbers: reading must not disturb them."""


def _chance() -> float:
    return _JITTER.random()


class Fault(Exception):
    """Something that may pass if it is tried again; ``wait_s`` is what the other side asked for."""

    def __init__(self, what: str, *, wait_s: float = 0.0) -> None:
        """Say what happened."""
        super().__init__(what)
        self.wait_s = wait_s


class TooSlow(TimeoutError):
    """An answer came too slowly; the message says which bound it broke."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How often to try, how long to wait between, and how slow a server may be.

    Attributes:
        attempts: Tries in a row that gain less than the least rate before giving up.
        first_wait_s: Seconds before the second try; doubled for each that follows, and shortened
            at random by up to a half, so that many workers do not come back at once.
        longest_wait_s: Seconds that no wait of our own exceeds.
        longest_asked_s: Seconds that the other side may ask for; beyond them we give up.
        timeout_s: Seconds that a connection and the begin of an answer, with all redirects, may
            each take.
        least_rate_bytes_s: Bytes a second that an answer must bring once it has begun: fewer over
            ``window_s``, silence among them, end the try.
        window_s: Seconds over which the rate is taken.
        longest_read_s: Seconds that one read may take in all, its tries and waits counted; of a
            longer read, each 8 MiB. Time in which nothing is asked of the server does not count.
        sleep: What waits.
        chance: What gives a number of 0 to 1.
        clock: What tells the time in seconds.
    """

    attempts: int = 6
    first_wait_s: float | int = 0.5
    longest_wait_s: float | int = 30.0
    longest_asked_s: float | int = 300.0
    timeout_s: float | int = 30.0
    least_rate_bytes_s: float | int = 4096.0
    window_s: float | int = 10.0
    longest_read_s: float | int = 600.0
    sleep: Callable[[float], None] = time.sleep
    chance: Callable[[], float] = _chance
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        """Refuse numbers that bound nothing.

        Raises:
            StorageError: If there is to be no try, or a bound is negative or no number.
        """
        above_zero = ("attempts", "timeout_s", "window_s", "longest_read_s")
        for name in (*above_zero, "least_rate_bytes_s", "first_wait_s", "longest_wait_s"):
            value = getattr(self, name)
            if not value >= 0 or (name in above_zero and value == 0):
                least = "above 0" if name in above_zero else "0 or more"
                raise StorageError(f"Patience: {name} must be {least}, got {value!r}.")

    def wait(self, fault: Fault, *, failures: int, left_s: float = math.inf) -> bool:
        """Wait before the next try, after so many failures in a row; False is to give up.

        A wait that would last longer than ``left_s`` is one too many.
        """
        if failures >= self.attempts or fault.wait_s > self.longest_asked_s:
            return False
        own_s = min(self.longest_wait_s, self.first_wait_s * 2.0 ** min(failures - 1, 60))
        wait_s = max(fault.wait_s, own_s * (1 - self.chance() / 2))
        if wait_s >= left_s:
            return False
        self.sleep(wait_s)
        return True

    @property
    def bounds(self) -> str:
        """What a server must keep to, in words."""
        return (
            f"least_rate_bytes_s={self.least_rate_bytes_s:.10g} over window_s={self.window_s:g}, "
            f"timeout_s={self.timeout_s:g}, longest_read_s={self.longest_read_s:g}"
        )


class Pace:
    """The time that one try has: told of each wait for bytes, it says how long the next may be."""

    def __init__(self, patience: Patience, *, left_s: float) -> None:
        """Begin with an answer's head, in a read that has so many seconds left."""
        self.clock = patience.clock
        self.timeout_s = patience.timeout_s
        self._patience = patience
        self._left_s = left_s
        self._in_body = False
        self._waited_s = 0.0
        self._gained = 0

    @property
    def left_s(self) -> float:
        """Seconds that the read has left."""
        return self._left_s

    def begin_body(self) -> None:
        """Go on to an answer's body: from here on the rate counts."""
        self._in_body, self._waited_s, self._gained = True, 0.0, 0

    def allowed_s(self) -> float:
        """Return how many seconds the next wait may last, above 0.

        Raises:
            TooSlow: If none is left.
        """
        bound_s = self._patience.window_s if self._in_body else self._patience.timeout_s
        allowed_s = min(bound_s - self._waited_s, self._left_s)
        if allowed_s <= 0:
            raise self.broken()
        return allowed_s

    def add(self, waited_s: float, gained: int) -> None:
        """Take note of a wait, and of the bytes that came."""
        self._left_s -= waited_s
        self._waited_s += waited_s
        self._gained += gained
        enough = self._patience.least_rate_bytes_s * self._patience.window_s
        if self._in_body and gained and self._gained >= enough:
            self._waited_s, self._gained = 0.0, 0

    def broken(self) -> TooSlow:
        """Return the error that says which bound was broken."""
        if self._left_s <= 0:
            return TooSlow(f"a read may take {self._patience.longest_read_s:g} s")
        if self._in_body:
            return TooSlow(
                f"fewer than {self._patience.least_rate_bytes_s:.10g} bytes a second over "
                f"{self._patience.window_s:g} s"
            )
        return TooSlow(f"no answer within {self._patience.timeout_s:g} s")


class Effort:
    """What one read has taken so far: its time, and the tries in a row that gained too little."""

    def __init__(self, patience: Patience) -> None:
        """Begin a read."""
        self.failures = 0
        self._patience = patience
        self._spent_s = 0.0
        self._of_try_s = 0.0
        self._gained = 0

    def pace(self) -> Pace:
        """Return the pace of the next try."""
        return Pace(self._patience, left_s=max(0.0, self._patience.longest_read_s - self._spent_s))

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Count the time of what is done meanwhile."""
        began_s = self._patience.clock()
        try:
            yield
        finally:
            self._spend(self._patience.clock() - began_s)

    def gain(self, count: int) -> None:
        """Take note of bytes that came."""
        before, self._gained = self._gained, self._gained + count
        if before // _BYTES_A_BOUND != self._gained // _BYTES_A_BOUND:
            self._spent_s = 0.0

    def goes_on(self, fault: Fault, *, gained: int) -> bool:
        """Wait before the next try, after one that gained so many bytes; False is to give up."""
        patience = self._patience
        is_fair = gained > 0 and gained >= patience.least_rate_bytes_s * self._of_try_s
        self.failures = 1 if is_fair else self.failures + 1
        self._of_try_s = 0.0
        with self.timed():
            left_s = patience.longest_read_s - self._spent_s
            return patience.wait(fault, failures=self.failures, left_s=left_s)

    def _spend(self, seconds: float) -> None:
        self._spent_s += seconds
        self._of_try_s += seconds

    def told(self, fault: Fault) -> str:
        """Return what happened, and what was tried, as a message says it."""
        asked = f", which asks to wait {fault.wait_s:.0f} s" if fault.wait_s else ""
        tries = f"{self.failures} tr{'y' if self.failures == 1 else 'ies'}"
        return f"{fault}{asked}; {tries}"
