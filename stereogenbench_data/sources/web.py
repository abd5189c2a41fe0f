"""Ranges over http and https, with urllib3; every response is checked to be the part requested.

Each process has a pool of urllib3 of its own. urllib3 follows redirects, and the address that one
led to is used again until it is refused, as a signed URL is that has expired.

Errors do not chain urllib3's own, whose messages hold the whole URL with its secrets.
"""

import functools
import http.client
import io
import logging
import os
import re
import socket
import time
from collections.abc import Generator, Mapping
from contextlib import nullcontext
from contextvars import ContextVar
from typing import Any, Final, NamedTuple
from urllib.parse import unquote, urljoin, urlunsplit
from urllib.request import getproxies, proxy_bypass

import urllib3
import urllib3.connection
from urllib3.exceptions import HTTPError, MaxRetryError, ResponseError

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.location import Depth, Listing, shown, split_url
from stereogenbench_data.sources.retry import (
    CHUNK_BYTES,
    MISSING,
    PASSING,
    ProcessLock,
    TransientError,
    replaced,
    require_expected_size,
    retry_after_s,
)

_MOST_CONNECTIONS: Final = 64
"""Connections to one server that a process keeps for later requests."""

_MOST_REDIRECTS: Final = 5
_REDIRECTS_ONLY: Final = urllib3.Retry(
    total=None,
    connect=False,
    read=False,
    redirect=_MOST_REDIRECTS,
    respect_retry_after_header=False,
)
"""What is left to urllib3: other failures are counted per read, by `retry.Attempts`."""

_WITH_CONTENT: Final = (200, 206, 416)

_FETCH: Final = "or fetch the data and pass the folder"
_CURES: Final = {
    401: f"It asks for a login: use hf:// or s3://, which know yours, {_FETCH}.",
    403: f"It may not be read with what the URL says: check access, {_FETCH}.",
    404: MISSING,
    410: MISSING,
}
_NUMBER: Final = re.compile(r"[0-9]{1,18}")
_PART: Final = re.compile(r"bytes (?:([0-9]{1,18})-([0-9]{1,18})|\*)/([0-9]{1,18})")
_STRONG_TAG: Final = re.compile(r'"[!#-~]{0,256}"')
_RATE_LIMIT: Final = re.compile(r";r=0;t=([0-9]{1,6})(?:[;,]|$)")

_MOST_ADDRESSES: Final = 50_000
_addresses: Final[dict[tuple[str, str], str]] = {}
"""Where URLs led to, by URL and login, as servers have redirected this process."""


_until_s: Final[ContextVar[float | None]] = ContextVar("_until_s", default=None)
"""Until when, on the monotonic clock, the request that this thread makes may be answered."""


class _LimitedStream(io.RawIOBase):
    """The bytes of a response; all waits for them together have the time of one, as for trickles.

    urllib3 limits each wait alone. A response that takes longer is resumed by another request.
    """

    def __init__(self, stream: io.RawIOBase, connection: socket.socket, until_s: float) -> None:
        super().__init__()
        self._stream, self._connection, self._until_s = stream, connection, until_s

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int | None:
        left_s = self._until_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("the answer is not whole in time")
        self._connection.settimeout(left_s)
        return self._stream.readinto(buffer)

    def close(self) -> None:
        self._stream.close()
        super().close()


class _LimitedResponse(http.client.HTTPResponse):
    def __init__(self, sock: socket.socket, *args: Any, **how: Any) -> None:
        super().__init__(sock, *args, **how)
        until_s = _until_s.get()
        if until_s is not None:
            self.fp = io.BufferedReader(_LimitedStream(self.fp.detach(), sock, until_s))


class _Pool(urllib3.HTTPConnectionPool):
    class ConnectionCls(urllib3.connection.HTTPConnection):
        response_class = _LimitedResponse


class _SecurePool(urllib3.HTTPSConnectionPool):
    class ConnectionCls(urllib3.connection.HTTPSConnection):
        response_class = _LimitedResponse


class _Stated(NamedTuple):
    """The first and last byte of a response, -1 where it has none, and the object's size."""

    first: int
    last: int
    size: int


class WebTransport:
    """One object of a web server."""

    longest_whole_bytes = 0
    """The size up to which a whole object is accepted where a part was requested."""
    is_versioned = True
    """Whether another ETag or date means that the object was replaced."""

    def __init__(self, url: str, *, expected_size: int | None = None) -> None:
        """Name an object; user and password of its URL are sent as a login, and never shown.

        Args:
            url: Where it is.
            expected_size: The size in bytes that the index records; None if it is not known.

        Raises:
            StorageError: If it is not a URL.
        """
        parts = split_url(url)
        login, _, self.server = parts.netloc.rpartition("@")
        self._where = shown(url)
        self._url = urlunsplit(parts._replace(netloc=self.server, fragment=""))
        self._expected_size = expected_size
        self._headers = {"Accept-Encoding": "identity"}
        if login:
            self._headers |= urllib3.make_headers(basic_auth=unquote(login))
        self._first_seen: dict[str, dict[str, str]] = {}
        self._is_redirected = False
        self._resolving = ProcessLock()

    def size(self, timeout_s: float) -> int:
        """Return how many bytes the object has, as the response for its first byte states."""
        response, stated = self._get(0, 1, timeout_s)
        response.close()
        return stated.size

    def listed(self, timeout_s: float, depth: Depth) -> Listing:
        """Refuse to list a folder: plain web servers have no listings."""
        raise StorageError(
            f"{self._where}: a web server does not list its folders. Pass a folder with an "
            f"index.parquet, or an index and this URL as its root."
        )

    def part(self, start: int, stop: int, timeout_s: float) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        response, stated = self._get(start, stop, timeout_s)
        try:
            self._require_part(response, stated, start, stop)
            skipped, wanted = start - stated.first, stop - start
            while data := response.read1(CHUNK_BYTES):
                piece = data[skipped:][:wanted]
                skipped -= min(skipped, len(data))
                wanted -= len(piece)
                if piece:
                    yield piece
                if response.status == 200 and not wanted:
                    return
        except HTTPError as error:
            raise TransientError(_reason(error)) from None
        finally:
            # A response that was read to its end is back in the pool, and is not closed.
            response.close()

    def _get(
        self, start: int, stop: int, timeout_s: float
    ) -> tuple[urllib3.BaseHTTPResponse, _Stated]:
        """Return a response that has content of the object that was read before."""
        part = {"Range": f"bytes={start}-{stop - 1}"}
        response = self._ask_address(part, timeout_s)
        if response is None:
            # One thread is redirected, and the others use the address that it found.
            with self._resolving.held(timeout_s) if self._is_redirected else nullcontext():
                response = self._ask_address(part, timeout_s)
                response = response or self._ask(self._url, part, timeout_s)
        try:
            if response.status not in _WITH_CONTENT:
                raise self.refusal(response)
            stated = self._stated(response)
            if response.status != 416:
                self._require_same(response, stated)
            require_expected_size(stated.size, expected=self._expected_size, where=self._where)
        except (StorageError, TransientError):
            response.close()
            raise
        return response, stated

    def _ask_address(
        self, part: Mapping[str, str], timeout_s: float
    ) -> urllib3.BaseHTTPResponse | None:
        """Return a response from where the URL led to; None if that is not known or refuses."""
        key = self._address_key
        address = _addresses.get(key)
        if address is None:
            return None
        try:
            response = self._ask(address, part, timeout_s)
        except TransientError:
            _addresses.pop(key, None)  # its server may be gone; another one may not
            raise
        if response.status in _WITH_CONTENT or response.status in PASSING:
            return response
        response.close()
        if _addresses.get(key) == address:
            _addresses.pop(key, None)
        return None

    @property
    def _address_key(self) -> tuple[str, str]:
        return self._url, self._headers.get("authorization", "")

    def _ask(
        self, url: str, part: Mapping[str, str], timeout_s: float, *, follow: bool = True
    ) -> urllib3.BaseHTTPResponse:
        """Return a server's response, of which nothing but the head is read yet."""
        sent = {**self._headers, **part}
        etag = self._first_seen.get("version", {}).get("ETag", "")
        if _STRONG_TAG.fullmatch(etag):  # a part is sent only if the object is unchanged
            sent["If-Range"] = etag
        if split_url(url)[:2] != split_url(self._url)[:2]:
            sent.pop("authorization", None)
        token = _until_s.set(time.monotonic() + timeout_s)
        try:
            response = _pool(url).request(
                "GET", url,
                headers=sent, timeout=timeout_s, retries=_REDIRECTS_ONLY, redirect=follow,
                preload_content=False,
            )  # fmt: skip
        except (ValueError, UnicodeError):
            raise self._error(
                "not a valid URL: correct it, or the redirect of its server."
            ) from None
        except HTTPError as error:
            if isinstance(error, MaxRetryError) and isinstance(error.reason, ResponseError):
                raise self._error(
                    f"is redirected more than {_MOST_REDIRECTS} times: check the URL."
                ) from None
            raise TransientError(_reason(error)) from None
        finally:
            _until_s.reset(token)
        hops = response.retries.history if response.retries is not None else ()
        for hop in hops:
            url = urljoin(url, hop.redirect_location or "")
        if hops:
            if len(_addresses) >= _MOST_ADDRESSES:
                _addresses.clear()
            _addresses[self._address_key], self._is_redirected = url, True
        return response

    def _require_same(self, response: urllib3.BaseHTTPResponse, stated: _Stated) -> None:
        """Refuse a response of an object that was replaced since the first read."""
        names = ("ETag", "Last-Modified") if self.is_versioned else ()
        now = {name: response.headers.get(name, "").strip() for name in names}
        now["size"] = str(stated.size)
        then = self._first_seen.setdefault("version", now)
        changes = [
            f"its {name} was {then[name][:80]} and is {now[name][:80]}"
            for name in now
            if then[name] and now[name]
            if then[name].removeprefix("W/") != now[name].removeprefix("W/")
            if name != "Last-Modified" or not (then["ETag"] and now["ETag"])
        ]
        if changes:
            raise replaced(self._where, "on its server", ", ".join(changes))

    def refusal(self, response: urllib3.BaseHTTPResponse) -> Exception:
        """Return the error of a response without content."""
        reason = re.sub(r"[^ -~]", "?", response.reason or "")[:60]
        answer = f"the server answers {response.status} {reason}".rstrip()
        if response.status in PASSING:
            limit = _RATE_LIMIT.search(response.headers.get("RateLimit", "")[:200])
            if response.status == 429 and limit is not None:
                return TransientError(answer, wait_s=float(limit[1]) + 1)  # the Hub rounds it
            wait_s = retry_after_s(response.headers.get("Retry-After", ""))
            return TransientError(answer, wait_s=wait_s)
        cure = _CURES.get(response.status, f"Check the URL and the server, {_FETCH}.")
        return self._error(f"{answer}. {cure}")

    def _error(self, what: str) -> StorageError:
        return StorageError(f"{self._where}: {what}")

    def _require_part(
        self, response: urllib3.BaseHTTPResponse, stated: _Stated, start: int, stop: int
    ) -> None:
        """Refuse a response that is neither the requested part, nor its beginning, nor all."""
        first, last, size = stated
        asked = f"asked for bytes {start} to {stop - 1}"
        if response.status == 200:
            if (start, stop) != (0, size) and not stop <= size <= self.longest_whole_bytes:
                raise self._error(
                    f"the server sends the whole file ({size} bytes) "
                    f"when {asked}. Members are read in parts: use a server that honours ranges, "
                    f"as nginx does, {_FETCH}."
                )
        elif first < 0 or response.status == 416:
            raise self._error(
                f"has {size} bytes, and byte {stop - 1} is asked for. It was cut short or "
                f"replaced: use the index that was made with it."
            )
        elif first != start or not start <= last < stop:
            raise self._error(
                f"the server sends bytes {first} to {last} when {asked}. It does not honour "
                f"ranges: use another, {_FETCH}."
            )

    def _stated(self, response: urllib3.BaseHTTPResponse) -> _Stated:
        """Return what a response states of its part and the object.

        Raises:
            StorageError: If it does not say which part it sends, or how large the object is.
        """
        header = "Content-Length" if response.status == 200 else "Content-Range"
        told = response.headers.get(header, "")
        found = (_NUMBER if response.status == 200 else _PART).fullmatch(told)
        if found is None:
            raise self._error(
                f"the server answers {response.status} and does not state which part it sends, or "
                f"the size of the whole ({header}: {told[:80]!r}): use another, {_FETCH}."
            )
        if response.status == 200:
            return _Stated(0, int(told) - 1, int(told))
        return _Stated(*(-1 if each is None else int(each) for each in found.groups()))


def _pool(url: str) -> urllib3.PoolManager:
    """Return the connections of this process, through the machine's proxy where it has one."""
    parts = split_url(url)
    proxy = "" if proxy_bypass(parts.netloc) else getproxies().get(parts.scheme, "")
    return pool_of(os.getpid(), proxy)


@functools.cache
def pool_of(process: int, proxy: str) -> urllib3.PoolManager:
    """Return the connections of a process through a proxy, "" for none."""
    if proxy:
        pool: urllib3.PoolManager = urllib3.ProxyManager(proxy, maxsize=_MOST_CONNECTIONS)
    else:
        pool = urllib3.PoolManager(maxsize=_MOST_CONNECTIONS)
    pool.pool_classes_by_scheme = {"http": _Pool, "https": _SecurePool}
    return pool


def _reason(error: BaseException) -> str:
    """Return what happened, without the URL that urllib3's messages hold."""
    reason = getattr(error, "reason", None)
    inner = reason if isinstance(reason, BaseException) else error
    cause = inner.__cause__ or inner.__context__
    if isinstance(cause, OSError) and cause.strerror:
        return f"{type(inner).__name__}: {cause.strerror}"
    return type(inner).__name__


def _without_queries(record: logging.LogRecord) -> bool:
    """Take the queries from the URLs that urllib3 logs, which may be signed."""
    if isinstance(record.args, tuple):
        record.args = tuple(
            each.partition("?")[0] if isinstance(each, str) else each for each in record.args
        )
    return True


for _name in ("connectionpool", "poolmanager", "util.retry"):
    logging.getLogger(f"urllib3.{_name}").addFilter(_without_queries)
