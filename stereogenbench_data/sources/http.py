"""Ranges over http and https, with urllib3; every response is checked to be the part requested.

Errors do not chain urllib3's own, whose messages hold the whole URL with its secrets.
"""

import atexit
import http.client
import io
import os
import re
import socket
from collections.abc import Generator, Mapping
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, Final
from urllib.parse import unquote, urljoin, urlunsplit
from urllib.request import getproxies, proxy_bypass

import urllib3
import urllib3.connection
from urllib3.exceptions import HTTPError, LocationValueError

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.sources.location import WEB_SCHEMES, is_inside, shown, split_url
from stereogenbench_data.sources.retry import Attempt, TooSlow, TransientError

_REDIRECTS: Final = frozenset({301, 302, 303, 307, 308})
_MOST_REDIRECTS: Final = 5
_PASSING: Final = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Status codes of failures that may pass."""

_FETCH: Final = "or fetch the data and pass the folder"
_MISSING: Final = "Check the URL, and that the index and its shards lie in one folder."
_CURES: Final = {
    401: f"It asks for a login: use hf:// or s3://, which know yours, {_FETCH}.",
    403: f"It may not be read with what the URL says: check access, {_FETCH}.",
    404: _MISSING,
    410: _MISSING,
}
_NUMBER: Final = re.compile(r"[0-9]{1,18}")
_PART: Final = re.compile(r"bytes (?:([0-9]{1,18})-([0-9]{1,18})|\*)/([0-9]{1,18}|\*)")
_STRONG_TAG: Final = re.compile(r'"[!#-~]{0,256}"')
_DATE: Final = re.compile(r"[A-Za-z0-9,: +-]{1,64}")
_CHUNK: Final = 64 * 1024

_pools: Final[dict[tuple[int, str], urllib3.PoolManager]] = {}
"""Connections by process and proxy. Those inherited over a fork are not used: their sockets belong
to the parent."""

_current_attempt: Final[ContextVar[Attempt | None]] = ContextVar("_current_attempt", default=None)
"""The attempt that this thread's request belongs to."""


@dataclass(frozen=True, slots=True)
class _Version:
    """What a server states of an object that changes with its content; "" where it is silent."""

    etag: str
    modified: str
    size: str

    def changes(self, now: "_Version") -> str:
        """Return how another response differs, "" if the object is the same."""
        compared = [("ETag", self.etag.removeprefix("W/"), now.etag.removeprefix("W/"))]
        if not (self.etag and now.etag):
            compared.append(("Last-Modified", self.modified, now.modified))
        compared.append(("size", self.size, now.size))
        return ", ".join(
            f"its {name} was {then[:80]} and is {here[:80]}"
            for name, then, here in compared
            if then and here and then != here
        )


class WebTransport:
    """One object of a web server."""

    def __init__(self, url: str) -> None:
        """Name an object; user and password of its URL are sent as a login, and never shown.

        Raises:
            StorageError: If it is not a URL.
        """
        parts = split_url(url)
        login, _, host = parts.netloc.rpartition("@")
        self._where = shown(url)
        self._url = urlunsplit(parts._replace(netloc=host, fragment=""))
        self._headers = {"Accept-Encoding": "identity"}
        if login:
            self._headers |= urllib3.make_headers(basic_auth=unquote(login))
        self._seen: dict[str, _Version] = {}

    def size(self, attempt: Attempt) -> int:
        """Return how many bytes the object has, as the response for its first byte states."""
        response = self._get(0, 1, attempt)
        response.close()
        stated = self._stated_size(response)
        if not _NUMBER.fullmatch(stated):
            raise StorageError(
                f"{self._where}: its server does not state its size ({stated[:80]!r}): fetch the "
                f"data and pass the folder."
            )
        return int(stated)

    def part(self, start: int, stop: int, attempt: Attempt) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        response = self._get(start, stop, attempt)
        try:
            self._require_part(response, start, stop)
            attempt.begin_body()
            while data := response.read1(_CHUNK):
                yield data
        except HTTPError as error:
            raise TransientError(_reason(error)) from None
        finally:
            # A response that was read to its end is back in the pool, and is not closed.
            response.close()

    def _get(self, start: int, stop: int, attempt: Attempt) -> urllib3.BaseHTTPResponse:
        headers = self._headers | {"Range": f"bytes={start}-{stop - 1}"} | self._condition()
        url = self._url
        for _ in range(_MOST_REDIRECTS + 1):
            response = self._ask(url, headers, attempt)
            if response.status not in _REDIRECTS:
                break
            there = self._redirected(url, response)
            if split_url(there)[:2] != split_url(url)[:2]:
                headers.pop("authorization", None)
            url = there
        else:
            raise StorageError(
                f"{self._where}: is redirected more than {_MOST_REDIRECTS} times: check the URL."
            )
        if response.status not in (200, 206, 416):
            response.close()
            self._refuse(response)
        if response.status != 416:
            self._require_same(response)
        return response

    def _ask(
        self, url: str, headers: Mapping[str, str], attempt: Attempt
    ) -> urllib3.BaseHTTPResponse:
        """Return a server's response, which may be a redirect."""
        token = _current_attempt.set(attempt)
        try:
            allowed_s = attempt.next_wait_s()
            return _pool(url).request(
                "GET",
                url,
                headers=headers,
                timeout=urllib3.Timeout(connect=allowed_s, read=allowed_s),
                retries=False,
                redirect=False,
                preload_content=False,
            )
        except TooSlow as error:
            raise TransientError(str(error)) from None
        except (LocationValueError, UnicodeError):
            sent = "" if url == self._url else f"is redirected to {shown(url)[:200]}, which "
            raise StorageError(f"{self._where}: {sent}is not a URL: correct it.") from None
        except HTTPError as error:
            raise TransientError(_reason(error)) from None
        finally:
            _current_attempt.reset(token)

    def _redirected(self, url: str, response: urllib3.BaseHTTPResponse) -> str:
        """Return where a response redirects to, if that may be followed."""
        stated = response.headers.get("Location", "").strip()
        length = response.headers.get("Content-Length", "")
        if _NUMBER.fullmatch(length) and int(length) <= _CHUNK:
            response.drain_conn()  # so that the connection can be used again
        response.close()
        there, parts, reason = stated, split_url(""), ""
        with suppress(ValueError, StorageError):
            there = urljoin(url, stated)
            parts = split_url(there)
        if not stated:
            reason = "redirects without a location"
        elif parts.scheme not in WEB_SCHEMES or not parts.hostname:
            reason = f"redirects to {shown(there)[:200]!r}, which is not a URL of a web server"
        elif (split_url(url).scheme, parts.scheme) == ("https", "http"):
            reason = f"redirects from https to {shown(there)[:200]}, which is not encrypted"
        elif parts.hostname != split_url(url).hostname and (
            is_inside(parts.hostname) and not is_inside(split_url(url).hostname or "")
        ):
            reason = f"redirects to {shown(there)[:200]}, inside this machine's own network"
        if reason:
            raise StorageError(
                f"{self._where}: the server answers {response.status} and {reason}. Check the URL "
                f"and the server, {_FETCH}."
            )
        host = parts.netloc.rpartition("@")[2]
        return urlunsplit(parts._replace(netloc=host, fragment=""))

    def _condition(self) -> dict[str, str]:
        """Return the header that asks for a part only if the object is unchanged."""
        seen = self._seen.get("first")
        if seen is not None and _STRONG_TAG.fullmatch(seen.etag):
            return {"If-Range": seen.etag}
        if seen is not None and not seen.etag and _DATE.fullmatch(seen.modified):
            return {"If-Range": seen.modified}
        return {}

    def _require_same(self, response: urllib3.BaseHTTPResponse) -> None:
        """Refuse a response of an object that was replaced since the first read."""
        size = self._stated_size(response)
        now = _Version(
            etag=response.headers.get("ETag", "").strip(),
            modified=response.headers.get("Last-Modified", "").strip(),
            size=size if _NUMBER.fullmatch(size) else "",
        )
        changes = self._seen.setdefault("first", now).changes(now)
        if changes:
            response.close()
            raise ShardError(
                f"{self._where}: was replaced on its server while it was read: {changes}. What was "
                f"read before is of the old file: open the data again, with the index that was "
                f"made with the new one."
            )

    def _refuse(self, response: urllib3.BaseHTTPResponse) -> None:
        reason = re.sub(r"[^ -~]", "?", response.reason or "")[:60]
        answer = f"{response.status} {reason}".rstrip()
        if response.status in _PASSING:
            wait_s = _retry_after_s(response.headers.get("Retry-After", ""))
            raise TransientError(f"the server answers {answer}", wait_s=wait_s)
        cure = _CURES.get(response.status, f"Check the URL and the server, {_FETCH}.")
        raise StorageError(f"{self._where}: the server answers {answer}. {cure}")

    def _require_part(self, response: urllib3.BaseHTTPResponse, start: int, stop: int) -> None:
        """Refuse a response that is neither the requested part nor its beginning."""
        if response.status == 200:
            size = response.headers.get("Content-Length", "")[:20]
            if start == 0 and size == str(stop):
                return
            raise StorageError(
                f"{self._where}: the server sends the whole file ({size or 'unknown'} bytes) when "
                f"asked for bytes {start} to {stop}. Members are read in parts: use a server that "
                f"honours ranges, as nginx does, {_FETCH}."
            )
        first, last, size = self._content_range(response)
        if not first or response.status == 416:
            raise StorageError(
                f"{self._where}: has {size} bytes, and byte {stop - 1} is asked for. It was cut "
                f"short or replaced: use the index that was made with it."
            )
        if int(first) != start or not start <= int(last) < stop:
            raise StorageError(
                f"{self._where}: the server sends bytes {first} to {last} when asked for {start} "
                f"to {stop - 1}. It does not honour ranges: use another, {_FETCH}."
            )

    def _stated_size(self, response: urllib3.BaseHTTPResponse) -> str:
        """Return the whole object's size as a response states it, which may not be a number."""
        if response.status == 200:
            return response.headers.get("Content-Length", "")
        return self._content_range(response)[2]

    def _content_range(self, response: urllib3.BaseHTTPResponse) -> tuple[str, str, str]:
        """Return the stated first and last byte, "" where there are none, and size."""
        stated = response.headers.get("Content-Range", "")
        found = _PART.fullmatch(stated)
        if found is None:
            response.close()
            raise StorageError(
                f"{self._where}: the server answers {response.status} and does not state which "
                f"part it sends (Content-Range: {stated[:80]!r}): use another, {_FETCH}."
            )
        first, last, size = found.groups(default="")
        return first, last, size


class _TimedStream(io.RawIOBase):
    """The bytes of a connection; waits for them stay within the limits of the attempt."""

    def __init__(self, stream: io.RawIOBase, connection: socket.socket, attempt: Attempt) -> None:
        super().__init__()
        self._stream = stream
        self._connection = connection
        self._attempt = attempt

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int | None:
        self._connection.settimeout(self._attempt.next_wait_s())
        began_s, count = self._attempt.clock(), 0
        try:
            count = self._stream.readinto(buffer) or 0
        except TooSlow:
            raise
        except TimeoutError:
            self._attempt.add(self._attempt.clock() - began_s, 0)
            raise self._attempt.too_slow() from None
        self._attempt.add(self._attempt.clock() - began_s, count)
        return count

    def close(self) -> None:
        self._stream.close()
        super().close()


class _TimedResponse(http.client.HTTPResponse):
    """A response whose head and body arrive within the limits of the attempt."""

    def __init__(self, sock: socket.socket, *args: Any, **how: Any) -> None:
        super().__init__(sock, *args, **how)
        attempt = _current_attempt.get()
        if attempt is not None:
            self.fp = io.BufferedReader(_TimedStream(self.fp.detach(), sock, attempt))


class _Connection(urllib3.connection.HTTPConnection):
    response_class = _TimedResponse


class _SecureConnection(urllib3.connection.HTTPSConnection):
    response_class = _TimedResponse


class _Pool(urllib3.HTTPConnectionPool):
    ConnectionCls = _Connection


class _SecurePool(urllib3.HTTPSConnectionPool):
    ConnectionCls = _SecureConnection


def _pool(url: str) -> urllib3.PoolManager:
    """Return the connections of this process, through the machine's proxy where it has one."""
    parts = split_url(url)
    proxy = "" if proxy_bypass(parts.netloc) else getproxies().get(parts.scheme, "")
    key = (os.getpid(), proxy)
    if key not in _pools:
        pool = urllib3.ProxyManager(proxy) if proxy else urllib3.PoolManager(maxsize=16)
        pool.pool_classes_by_scheme = {"http": _Pool, "https": _SecurePool}
        _pools.setdefault(key, pool)
    return _pools[key]


@atexit.register
def close_connections() -> None:
    """Close the connections of this process; reading opens new ones."""
    for key in [key for key in _pools if key[0] == os.getpid()]:
        _pools.pop(key).clear()


def _reason(error: BaseException) -> str:
    """Return what happened, without the URL that urllib3's messages hold."""
    reason = getattr(error, "reason", None)
    inner = reason if isinstance(reason, BaseException) else error
    cause = inner.__cause__ or inner.__context__
    if isinstance(cause, TooSlow):
        return str(cause)
    if isinstance(cause, OSError) and cause.strerror:
        return f"{type(inner).__name__}: {cause.strerror}"
    return type(inner).__name__


def _retry_after_s(header: str) -> float:
    """Return how many seconds a Retry-After header asks to wait, 0 if it is not valid."""
    if re.fullmatch("[0-9]+", header):
        return float(header)
    try:
        until = parsedate_to_datetime(header)
        until = until if until.tzinfo else until.replace(tzinfo=UTC)
        return max(0.0, (until - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError, IndexError, OverflowError):
        return 0.0
