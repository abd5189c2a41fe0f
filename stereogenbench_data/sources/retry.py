"""Reading from servers: which failures may pass, how long a read waits, and when it gives up."""

import os
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic, sleep
from typing import ClassVar, Final

from stereogenbench_data.errors import ShardError, StorageError

MISSING: Final = "Check the URL, and that the index and its shards lie in one folder."
"""The cure where an object does not exist."""

CHUNK_BYTES: Final = 64 * 1024
"""A read that received this many more bytes has its whole time and all its attempts again."""

PASSING: Final = (408, 425, 429, 500, 502, 503, 504)
"""Status codes of failures that may pass."""

_pauses: Final[dict[str, float]] = {}
"""Until when, on the monotonic clock, servers asked this process to wait."""


class MissingObject(StorageError):
    """The object that a URL names does not exist."""


class TransientError(Exception):
    """A failure that may pass.

    Attributes:
        wait_s: Seconds that the server asked to wait, 0 if it did not ask.
    """

    def __init__(self, reason: str, *, wait_s: float = 0.0) -> None:
        """Take what happened, for messages."""
        super().__init__(reason)
        self.wait_s = wait_s


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How long reading waits for a server.

    Attributes:
        timeout_s: Seconds that a wait for the server may take; then another request goes on.
            Reading gives up 2.25 times as long after its last progress, connecting and retries
            included.
    """

    timeout_s: float | int = 20.0

    attempts: ClassVar[int] = 10
    """Attempts without progress before reading gives up."""
    first_wait_s: ClassVar[float] = 0.02
    """Seconds before the second attempt. The wait doubles with each attempt and is shortened at
    random by up to a half, so that many workers do not retry at once."""
    longest_wait_s: ClassVar[float] = 10.0
    """The longest wait, unless the server asks for more."""
    longest_pause_s: ClassVar[float] = 600.0
    """The longest that a server may let one read wait (Retry-After), all its waits together."""

    def __post_init__(self) -> None:
        """Refuse a limit without an effect.

        Raises:
            StorageError: If the time is not a number above 0.
        """
        if not self.timeout_s > 0:
            raise StorageError(f"RetryPolicy: timeout_s must be above 0, got {self.timeout_s!r}.")

    @property
    def longest_outage_s(self) -> float:
        """Seconds without progress until reading gives up; waits that the server asks for apart."""
        return self.timeout_s * 2.25


class Attempts:
    """The attempts of one read: how long each may wait, and whether there is another one."""

    def __init__(self, where: str, *, server: str, policy: RetryPolicy) -> None:
        """Begin a read of an object."""
        self._where = where
        self._server = server
        self._policy = policy
        self._doing = ""
        self._received = 0
        self._renew()

    def _renew(self) -> None:
        self._tries = 0
        self._asked_s = 0.0
        self._until_s = monotonic() + self._policy.longest_outage_s

    def begin(self, doing: str) -> float:
        """Wait while the server asked for that; return the seconds that it may take to answer."""
        self._doing = doing
        pause_s = _pauses.get(self._server, 0.0) - monotonic()
        if pause_s > 0:
            with self.waiting():
                sleep(pause_s)
        return max(0.001, min(self._policy.timeout_s, self._until_s - monotonic()))

    def add(self, received: int) -> None:
        """Count received bytes.

        Raises:
            TransientError: If too few came for too long.
        """
        self._received += received
        if self._received >= CHUNK_BYTES:
            self._received = 0
            self._renew()
        elif monotonic() > self._until_s:
            raise TransientError(f"too little came for {self._policy.longest_outage_s:g} s")

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Leave the time that the block takes out of account."""
        began_s = monotonic()
        try:
            yield
        finally:
            self._until_s += monotonic() - began_s

    def failed(self, error: TransientError) -> None:
        """Wait before the next attempt.

        Raises:
            StorageError: If no attempt is left.
        """
        policy = self._policy
        self._tries += 1
        self._asked_s += error.wait_s
        # Drawn without changing the program's own random numbers.
        wait_s = min(policy.longest_wait_s, policy.first_wait_s * 2.0 ** (self._tries - 1))
        wait_s *= 1 - random.SystemRandom().random() / 2
        is_in_time = error.wait_s > 0 or monotonic() + wait_s < self._until_s
        if (
            self._tries >= policy.attempts
            or self._asked_s > policy.longest_pause_s
            or not is_in_time
        ):
            asked = f", which asks to wait {error.wait_s:.0f} s" if error.wait_s else ""
            tries = "1 try" if self._tries == 1 else f"{self._tries} tries"
            raise StorageError(
                f"{self._where}: cannot be read, {self._doing} ({error}{asked}; {tries}). Check "
                f"the network and the server, then try again; or fetch the data and pass the "
                f"folder; or allow a server that is slower than timeout_s={policy.timeout_s:g}: "
                f"SceneIndex.open(..., retry=RetryPolicy(timeout_s={2 * policy.timeout_s:g}))."
            ) from error
        if error.wait_s > 0:  # all reads of this process wait, in `begin`
            until_s = monotonic() + error.wait_s
            _pauses[self._server] = max(until_s, _pauses.get(self._server, 0.0))
        else:
            sleep(wait_s)


class ProcessLock:
    """A lock for the threads of one process: after a fork, or in a pickled copy, it is free."""

    def __init__(self) -> None:
        """Begin free."""
        self._locks: dict[int, threading.Lock] = {}

    def __reduce__(self) -> tuple[type["ProcessLock"], tuple[()]]:
        """Return how a copy is made: free."""
        return ProcessLock, ()

    @contextmanager
    def held(self, timeout_s: float) -> Iterator[None]:
        """Hold the lock.

        Raises:
            TransientError: If it is not free in time.
        """
        lock = self._locks.setdefault(os.getpid(), threading.Lock())
        if not lock.acquire(timeout=timeout_s):
            raise TransientError(f"no answer within {timeout_s:g} s")
        try:
            yield
        finally:
            lock.release()


def retry_after_s(header: str) -> float:
    """Return how many seconds a Retry-After header asks to wait, 0 if it is not valid."""
    from urllib3 import Retry
    from urllib3.exceptions import InvalidHeader

    try:
        return Retry().parse_retry_after(header)
    except (InvalidHeader, ValueError, OverflowError):
        return 0.0


def require_expected_size(found: int, *, expected: int | None, where: str) -> None:
    """Refuse an object of another size than the index records; None expects any.

    Raises:
        ShardError: If the sizes differ.
    """
    if expected not in (None, found):
        raise ShardError(
            f"{where}: has {found} bytes, and the index says {expected}. It was replaced or "
            f"cut short, or the index is of another: use the index that was made with it, or fetch "
            f"the file again."
        )


def replaced(where: str, place: str, changes: str) -> ShardError:
    """Return the error of an object that was replaced since the first read."""
    return ShardError(
        f"{where}: was replaced {place} while it was read: {changes}. What was read before is of "
        f"the old file: open the data again, with the index that was made with the new one."
    )
