"""Files behind URLs: any range of their bytes, resumed where a connection broke off.

A `Transport` makes the requests: that of `http` for http and https, that of `hub` for
repositories of the Hub, that of `filesystems` for everything else.
"""

from collections.abc import Callable, Iterator
from typing import TypeVar

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.filesystems import FilesystemTransport
from stereogenbench_data.sources.http import WebTransport
from stereogenbench_data.sources.hub import HubTransport, is_hub_file
from stereogenbench_data.sources.location import is_web, shown
from stereogenbench_data.sources.retry import (
    Attempt,
    Cancellation,
    ReadCancelled,
    RetryPolicy,
    RetryState,
    TransientError,
)
from stereogenbench_data.sources.transport import Transport

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
        self._policy = retry or RetryPolicy()
        make: type[WebTransport] | type[HubTransport] | type[FilesystemTransport]
        if is_web(url):
            make = WebTransport
        else:
            make = HubTransport if is_hub_file(url) else FilesystemTransport
        self._transport: Transport = make(url, expected_size=expected_size)

    def __repr__(self) -> str:
        """Return the URL, without login and query."""
        return f"RemoteObject({self.where!r})"

    def size(self) -> int:
        """Return the size of the file in bytes.

        Raises:
            StorageError: If it cannot be fetched.
        """
        return self._retried(self._transport.size, doing="requesting its size")

    def read(self, start: int, stop: int, *, cancellation: Cancellation | None = None) -> bytes:
        """Return the bytes from start to stop.

        Args:
            start: The first byte.
            stop: The byte behind the last one.
            cancellation: Ends the read at once when another thread cancels it.

        Raises:
            ShardError: If the file does not have the expected size, or was replaced meanwhile.
            ReadCancelled: If it was cancelled.
            StorageError: If they cannot be fetched.
        """
        return b"".join(self.chunks(start, stop, cancellation=cancellation))

    def chunks(
        self, start: int, stop: int, *, cancellation: Cancellation | None = None
    ) -> Iterator[bytes]:
        """Yield the bytes from start to stop in pieces; each byte comes once.

        Args:
            start: The first byte.
            stop: The byte behind the last one.
            cancellation: Ends the read at once when another thread cancels it.

        Raises:
            ShardError: If the file does not have the expected size, or was replaced meanwhile.
            ReadCancelled: If it was cancelled.
            StorageError: If they cannot be fetched.
        """
        state = RetryState(self._policy, cancellation=cancellation)
        while start < stop:
            begin = start
            error = TransientError("the answer ended early")
            with state.attempt() as attempt:
                pieces = self._transport.part(start, stop, attempt)
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
                                f"{self.where}: sent more than the {stop - begin} bytes requested "
                                f"from byte {begin} on. Its server does not honour ranges: fetch "
                                f"the data and pass the folder."
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
        return self._retried(self._transport.entries, doing="requesting its entries")

    def _retried(self, request: Callable[[Attempt], _T], *, doing: str) -> _T:
        state = RetryState(self._policy)
        while True:
            try:
                with state.timed(), state.attempt() as attempt:
                    return request(attempt)
            except TransientError as error:
                self._wait(state, error, received=0, doing=doing)

    def _wait(self, state: RetryState, error: TransientError, *, received: int, doing: str) -> None:
        policy = self._policy
        may_go_on = not state.is_cancelled and state.wait(error, received=received)
        if state.is_cancelled:
            raise ReadCancelled(f"{self.where}: reading was cancelled, {doing}.")
        if not may_go_on:
            raise StorageError(
                f"{self.where}: cannot be read, {doing} ({state.describe(error)}). Check the "
                f"network and the server, then try again; or fetch the data and pass the folder; "
                f"or allow a server that is slower than timeout_s={policy.timeout_s:g}: "
                f"SceneIndex.open(..., retry=RetryPolicy(timeout_s={2 * policy.timeout_s:g}))."
            ) from error
