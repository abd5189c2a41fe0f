"""Files behind URLs: any range of their bytes, resumed where a connection broke off.

A transport makes the requests for one object, each in one attempt: that of `web` for http and
https, that of `hub` for repositories of the Hub, that of `filesystems` for everything else. It
raises `TransientError` where another attempt may help, else `StorageError`. No wait of it for the
server takes longer than its ``timeout_s``, and threads may make requests at the same time.
"""

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.location import Depth, Listing, is_web, joined, shown
from stereogenbench_data.sources.retry import Attempts, RetryPolicy, TransientError

if TYPE_CHECKING:
    from stereogenbench_data.sources.filesystems import FilesystemTransport
    from stereogenbench_data.sources.web import WebTransport

_T = TypeVar("_T")


def _transport(url: str, *, expected_size: int | None) -> "WebTransport | FilesystemTransport":
    """Return what makes the requests; only its library is imported."""
    if is_web(url):
        from stereogenbench_data.sources.web import WebTransport

        return WebTransport(url, expected_size=expected_size)
    from stereogenbench_data.sources.hub import HubFile, HubTransport

    if HubFile.of_url(url) is not None:
        return HubTransport(url, expected_size=expected_size)
    from stereogenbench_data.sources.filesystems import FilesystemTransport

    return FilesystemTransport(url, expected_size=expected_size)


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
            retry: How long reading waits; None for the defaults.

        Raises:
            StorageError: If it is not a URL.
        """
        self.where = shown(url)
        self._url = url
        self._policy = retry or RetryPolicy()
        self._transport = _transport(url, expected_size=expected_size)

    def below(self, path: str, *, expected_size: int | None = None) -> "RemoteObject":
        """Return a file or folder below this folder; reading it waits as long."""
        url = joined(self._url, path)
        return RemoteObject(url, expected_size=expected_size, retry=self._policy)

    def size(self) -> int:
        """Return the size of the file in bytes.

        Raises:
            StorageError: If it cannot be fetched.
        """
        return self._retried(self._transport.size, doing="requesting its size")

    def listed(self, depth: Depth = "one level") -> Listing:
        """List a folder, in few requests.

        Raises:
            StorageError: If it cannot be listed; plain web servers have no listings.
        """
        return self._retried(partial(self._transport.listed, depth=depth), doing="listing it")

    def pinned(self) -> str:
        """Return the URL of a folder that keeps its content: of the Hub, with its commit; else "".

        Raises:
            StorageError: If the Hub cannot be asked.
        """
        from stereogenbench_data.sources.hub import HubTransport

        if not isinstance(self._transport, HubTransport):
            return ""
        return self._retried(self._transport.pinned, doing="requesting its commit")

    def read(self, start: int, stop: int) -> bytes:
        """Return the bytes from start to stop; `chunks` describes errors."""
        return b"".join(self.chunks(start, stop))

    def chunks(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from start to stop in pieces; each byte comes once.

        Raises:
            ShardError: If the file does not have the expected size, or was replaced meanwhile.
            StorageError: If they cannot be fetched.
        """
        attempts = self._attempts()
        while start < stop:
            timeout_s = attempts.begin(f"at byte {start} of {stop}")
            error = TransientError("the answer ended early")
            with closing(self._transport.part(start, stop, timeout_s)) as pieces:
                try:
                    for data in pieces:
                        attempts.add(len(data))
                        start += len(data)
                        if start > stop:
                            raise StorageError(
                                f"{self.where}: sent {start - stop} bytes more than requested, up "
                                f"to byte {stop}. Its server does not honour ranges: fetch the "
                                f"data and pass the folder."
                            )
                        with attempts.waiting():  # for the reader
                            yield data
                except TransientError as found:
                    error = found
            if start < stop:
                attempts.failed(error)

    def _attempts(self) -> Attempts:
        return Attempts(self.where, server=self._transport.server, policy=self._policy)

    def _retried(self, request: Callable[[float], _T], *, doing: str) -> _T:
        attempts = self._attempts()
        while True:
            timeout_s = attempts.begin(doing)
            try:
                return request(timeout_s)
            except TransientError as error:
                attempts.failed(error)
