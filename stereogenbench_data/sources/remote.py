"""Files behind URLs: any range of their bytes, resumed where a connection broke off.

A transport makes the requests: `http` for http and https, `filesystems` for everything else. Its
methods raise `TransientError` where another attempt may help, else `StorageError`.
"""

from collections.abc import Callable, Iterator
from typing import TypeVar

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.sources.filesystems import FilesystemTransport
from stereogenbench_data.sources.http import WebTransport
from stereogenbench_data.sources.location import is_web, shown
from stereogenbench_data.sources.retry import Attempt, RetryPolicy, RetryState, TransientError

_T = TypeVar("_T")


class RemoteObject:
    """A file behind a URL. It holds no connection: any thread and process may read it.

    Attributes:
        where: Its URL as messages may show it, without login and query.
    """

    def __init__(
        self, url: str, *, expected_size: int | None = None, retry: RetryPolicy | None = None
    ) -> None:
        """Name a file; nothing is requested yet.

        Args:
            url: Where it is.
            expected_size: The size in bytes that the index records; None if it is not known.
            retry: How reading is retried; None for the defaults.

        Raises:
            StorageError: If it is not a URL.
        """
        self.where = shown(url)
        self._expected_size = expected_size
        self._is_checked = expected_size is None
        self._policy = retry or RetryPolicy()
        self._transport = WebTransport(url) if is_web(url) else FilesystemTransport(url)

    def __repr__(self) -> str:
        """Return the URL, without login and query."""
        return f"RemoteObject({self.where!r})"

    def size(self) -> int:
        """Return the size of the file in bytes.

        Raises:
            StorageError: If it cannot be fetched.
        """
        return self._retried(self._transport.size)

    def read(self, start: int, stop: int) -> bytes:
        """Return the bytes from start to stop.

        Raises:
            StorageError: If they cannot be fetched.
        """
        return b"".join(self.chunks(start, stop))

    def chunks(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from start to stop in pieces; each byte comes once.

        Raises:
            ShardError: If the file does not have the expected size, or was replaced meanwhile.
            StorageError: If they cannot be fetched.
        """
        self._require_expected_size()
        state = RetryState(self._policy)
        while start < stop:
            begin = start
            error = TransientError("the answer ended early")
            pieces = self._transport.part(start, stop, state.attempt())
            try:
                while True:
                    with state.timed():
                        data = next(pieces, None)
                    if data is None:
                        break
                    start += len(data)
                    state.add(len(data))
                    if start > stop:
                        raise StorageError(
                            f"{self.where}: sent more than the {stop - begin} bytes requested from "
                            f"byte {begin} on. Its server does not honour ranges: fetch the data "
                            f"and pass the folder."
                        )
                    yield data
            except TransientError as found:
                error = found
            finally:
                pieces.close()
            if start < stop:
                doing = f"at byte {start} of {stop}"
                self._wait(state, error, received=start - begin, doing=doing)

    def entries(self) -> dict[str, int | None]:
        """List a folder: name to size in bytes, None for a folder.

        Raises:
            StorageError: If it cannot be listed; plain web servers have no listings.
        """
        if not isinstance(self._transport, FilesystemTransport):
            raise StorageError(
                f"{self.where}: a web server does not list its folders. Pass a folder with an "
                "index.parquet, or an index that names this URL as its root."
            )
        return self._retried(self._transport.entries)

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

    def _retried(self, request: Callable[[Attempt], _T]) -> _T:
        state = RetryState(self._policy)
        while True:
            try:
                with state.timed():
                    return request(state.attempt())
            except TransientError as error:
                self._wait(state, error, received=0, doing="asked for its size")

    def _wait(self, state: RetryState, error: TransientError, *, received: int, doing: str) -> None:
        policy = self._policy
        if not state.wait(error, received=received):
            raise StorageError(
                f"{self.where}: cannot be read, {doing} ({state.describe(error)}). Check the "
                f"network and the server, then try again; or fetch the data and pass the folder; "
                f"or allow a slower server: SceneIndex.open(..., retry=RetryPolicy(...)), which "
                f"has least_rate_bytes_s={policy.least_rate_bytes_s:.10g} over "
                f"window_s={policy.window_s:g}, timeout_s={policy.timeout_s:g}, "
                f"longest_read_s={policy.longest_read_s:g} now."
            ) from error
