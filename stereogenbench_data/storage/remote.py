"""Bytes of things that lie elsewhere: any range of them, resumed where a connection broke off.

How a request is made is up to a transport: `web` for http and https, `filesystems` for the rest.
"""

from collections.abc import Callable, Iterator
from typing import Protocol, TypeVar

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.storage.filesystems import FilesystemTransport
from stereogenbench_data.storage.location import WEB_SCHEMES, shown
from stereogenbench_data.storage.retry import Fault, Patience
from stereogenbench_data.storage.web import WebTransport

_T = TypeVar("_T")


class Transport(Protocol):
    """One way to reach one remote object."""

    def size(self) -> int:
        """Return how many bytes it has.

        Raises:
            Fault: If trying again may help.
            StorageError: If not.
        """
        ...

    def part(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield its bytes from start to stop, or the first of them.

        Raises:
            Fault: If trying again may help.
            StorageError: If not.
        """
        ...


class RemoteObject:
    """A file somewhere else. It holds no connection: any thread and process may read it.

    Attributes:
        where: Its URL as messages may show it.
    """

    def __init__(
        self, url: str, *, expected_size: int | None = None, patience: Patience | None = None
    ) -> None:
        """Name an object; nothing is asked of it yet.

        Args:
            url: Where it is.
            expected_size: The bytes that it must have, by an index; None if that is not known.
            patience: How often and how long to try; None for a minute or so.
        """
        self.where = shown(url)
        self._expected_size = expected_size
        self._is_checked = expected_size is None
        self._patience = patience or Patience()
        is_web = url.partition("://")[0] in WEB_SCHEMES
        self._transport: Transport = (WebTransport if is_web else FilesystemTransport)(
            url, timeout_s=self._patience.timeout_s
        )

    def size(self) -> int:
        """Return how many bytes it has.

        Raises:
            StorageError: If it cannot be had.
        """
        return self._persist(self._transport.size)

    def read(self, start: int, stop: int) -> bytes:
        """Return the bytes from start to stop.

        Raises:
            StorageError: If they cannot be had.
        """
        return b"".join(self.chunks(start, stop))

    def chunks(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from start to stop, piece by piece; none comes twice.

        Raises:
            StorageError: If they cannot be had.
        """
        self._require_expected_size()
        failures = 0
        while start < stop:
            begin = start
            fault = Fault("the answer ended early")
            try:
                for data in self._transport.part(start, stop):
                    start += len(data)
                    if start > stop:
                        raise StorageError(
                            f"{self.where}: sent more than the {stop - begin} bytes asked for "
                            f"from byte {begin} on. Its server does not honour ranges: fetch the "
                            f"data and pass the folder."
                        )
                    yield data
            except Fault as found:
                fault = found
            if start < stop:
                failures = 1 if start > begin else failures + 1
                self._wait(fault, failures=failures, doing=f"at byte {start} of {stop}")

    def entries(self) -> dict[str, int | None]:
        """Return what it holds as a folder: names, with a file's size, and None for a folder.

        Raises:
            StorageError: If it cannot be listed; plain web servers have no lists.
        """
        if not isinstance(self._transport, FilesystemTransport):
            raise StorageError(
                f"{self.where}: a web server does not list its folders. Pass a folder with an "
                "index.parquet, or an index that names this URL as its root."
            )
        return self._persist(self._transport.entries)

    def _require_expected_size(self) -> None:
        if self._is_checked:
            return
        found = self.size()
        if found != self._expected_size:
            raise ShardError(
                f"{self.where}: has {found} bytes, and the index says {self._expected_size}. The "
                f"index is of another pack, or the file was replaced or cut short: use the index "
                f"that was made with it."
            )
        self._is_checked = True

    def _persist(self, ask: Callable[[], _T]) -> _T:
        failures = 0
        while True:
            try:
                return ask()
            except Fault as fault:
                failures += 1
                self._wait(fault, failures=failures, doing="asked for its size")

    def _wait(self, fault: Fault, *, failures: int, doing: str) -> None:
        if not self._patience.wait(fault, failures=failures):
            asked = f", which asks to wait {fault.wait_s:.0f} s" if fault.wait_s else ""
            raise StorageError(
                f"{self.where}: cannot be read, {doing} ({fault}{asked}; {failures} tries). Check "
                f"the network and the server, then try again; or fetch the data and pass the "
                f"folder."
            ) from fault
