"""What the protocols have in common: the requests they make, and what they say of an object."""

import re
import time
from collections.abc import Generator
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Final, Protocol

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.sources.pauses import begin_pause, pause_end_s
from stereogenbench_data.sources.retry import Attempt, TransientError

MISSING: Final = "Check the URL, and that the index and its shards lie in one folder."
"""The cure where an object does not exist."""

_DELAY_S: Final = re.compile(r"[0-9]{1,9}")


class MissingObject(StorageError):
    """The object that a URL names does not exist."""


class Transport(Protocol):
    """The requests for one object of one protocol, each in one attempt.

    A method raises `TransientError` where another attempt may help, else `StorageError`. Each
    checks the object's size, as its server states it, where an index records one. Threads may
    make requests at the same time.
    """

    def size(self, attempt: Attempt) -> int:
        """Return the size of the object in bytes."""

    def part(self, start: int, stop: int, attempt: Attempt) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""

    def entries(self, attempt: Attempt) -> dict[str, int | None]:
        """List a folder: name to size in bytes, None for a folder."""


def require_expected_size(found: int, *, expected: int | None, where: str) -> None:
    """Refuse an object of another size than the index records; None expects any.

    Raises:
        ShardError: If the sizes differ.
    """
    if expected not in (None, found):
        raise ShardError(
            f"{where}: has {found} bytes, and the index says {expected}. The index is of another "
            f"pack, or the file was replaced or cut short: use the index that was made with it."
        )


def replaced(where: str, place: str, changes: str) -> ShardError:
    """Return the error of an object that was replaced since the first read."""
    return ShardError(
        f"{where}: was replaced {place} while it was read: {changes}. What was read before is of "
        f"the old file: open the data again, with the index that was made with the new one."
    )


def busy(reason: str, *, server: str, wait_s: float, attempt: Attempt) -> TransientError:
    """Return the error of a busy server; a wait that it asks for holds for the whole machine."""
    until_s = 0.0
    if 0 < wait_s <= attempt.policy.longest_retry_after_s:
        until_s = begin_pause(server, wait_s=wait_s)
    return TransientError(reason, wait_s=wait_s, pause_until_s=until_s)


def require_no_pause(server: str, attempt: Attempt) -> None:
    """Refuse to ask a server that asked this machine to wait, unless this read has waited for it.

    Raises:
        TransientError: It says how long is left.
    """
    until_s = pause_end_s(server)
    if until_s > attempt.waited_for_s:
        raise TransientError(
            "the server asked this machine to wait",
            wait_s=max(0.0, until_s - time.time()), pause_until_s=until_s, was_sent=False,
        )  # fmt: skip


def retry_after_s(header: str) -> float:
    """Return how many seconds a Retry-After header asks to wait, 0 if it is not valid."""
    if _DELAY_S.fullmatch(header):
        return float(header)
    try:
        until = parsedate_to_datetime(header)
        until = until if until.tzinfo else until.replace(tzinfo=UTC)
        return max(0.0, (until - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError, IndexError, OverflowError):
        return 0.0
