"""Bytes of things that lie elsewhere: any range of them, resumed where a connection broke off.

How a request is made is up to a transport: `web` for http and https, `filesystems` for the rest.
"""

from collections.abc import Callable, Generator, Iterator
from typing import Protocol, TypeVar

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.sources.filesystems import FilesystemTransport
from stereogenbench_data.sources.http import WebTransport
from stereogenbench_data.sources.location import is_web, shown
from stereogenbench_data.sources.retry import Effort, Fault, Pace, Patience

_T = TypeVar("_T")


class Transport(Protocol):
    """One way to reach one remote object."""

    def size(self, pace: Pace) -> int:
        """Return how many bytes it has.

        Raises:
            Fault: If trying again may help.
            StorageError: If not.
        """
        ...

    def part(self, start: int, stop: int, pace: Pace) -> Generator[bytes, None, None]:
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

        Raises:
            StorageError: If it is no URL.
        """
        self.where = shown(url)
        self._expected_size = expected_size
        self._is_checked = expected_size is None
        self._patience = patience or Patience()
        self._transport: Transport = (WebTransport if is_web(url) else FilesystemTransport)(url)

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
        effort = Effort(self._patience)
        while start < stop:
            begin = start
            fault = Fault("the answer ended early")
            pieces = self._transport.part(start, stop, effort.pace())
            try:
                while True:
                    with effort.timed():
                        data = next(pieces, None)
                    if data is None:
                        break
                    start += len(data)
                    effort.gain(len(data))
                    if start > stop:
                        raise StorageError(
                            f"{self.where}: sent more than the {stop - begin} bytes asked for "
                            f"from byte {begin} on. Its server does not honour ranges: fetch the "
                            f"data and pass the folder."
                        )
                    yield data
            except Fault as found:
                fault = found
            finally:
                pieces.close()
            if start < stop:
                self._wait(effort, fault, gained=start - begin, doing=f"at byte {start} of {stop}")

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

    def _persist(self, ask: Callable[[Pace], _T]) -> _T:
        effort = Effort(self._patience)
        while True:
            try:
                with effort.timed():
                    return ask(effort.pace())
            except Fault as fault:
                self._wait(effort, fault, gained=0, doing="asked for its size")

    def _wait(self, effort: Effort, fault: Fault, *, gained: int, doing: str) -> None:
        if not effort.goes_on(fault, gained=gained):
            raise StorageError(
                f"{self.where}: cannot be read, {doing} ({effort.told(fault)}). Check the network "
                f"and the server, then try again; or fetch the data and pass the folder; or allow "
                f"for a slower one: SceneIndex.open(..., patience=Patience(...)), which has "
                f"{self._patience.bounds} now."
            ) from fault
