"""Ranges over http and https, with urllib3; every answer is checked to be the part asked for.

Errors do not chain urllib3's own: their messages hold the whole URL, with what is secret in it.
"""

import atexit
import os
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Final
from urllib.parse import unquote, urlsplit, urlunsplit
from urllib.request import getproxies, proxy_bypass

import urllib3
from urllib3.exceptions import HTTPError, LocationParseError, MaxRetryError, ResponseError

from stereogenbench_data.errors import StorageError
from stereogenbench_data.storage.location import shown
from stereogenbench_data.storage.retry import Fault

_REDIRECTS: Final = urllib3.Retry(
    total=None, redirect=5, connect=0, read=0, status=0, other=0, respect_retry_after_header=False
)
_PASSING: Final = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Answers that may be others in a while."""

_FETCH: Final = "or fetch the data and pass the folder"
_CURES: Final = {
    401: f"It asks for a login: use hf:// or s3://, which know yours, {_FETCH}.",
    403: f"It may not be read with what the URL says: check access, {_FETCH}.",
    404: "Check the URL, and that the index and its shards lie in one folder.",
    410: "Check the URL, and that the index and its shards lie in one folder.",
}
_PART: Final = re.compile(r"bytes (?:(\d+)-(\d+)|\*)/(\d+|\*)$")
_CHUNK: Final = 64 * 1024

_pools: Final[dict[tuple[int, str], urllib3.PoolManager]] = {}
"""Connections by process and proxy. Those that came over a fork are left alone: their sockets
belong to the parent."""


class WebTransport:
    """One object of a web server."""

    def __init__(self, url: str, *, timeout_s: float) -> None:
        """Name an object; a user and password in its URL are sent as a login, never shown."""
        parts = urlsplit(url)
        login, _, host = parts.netloc.rpartition("@")
        self._where = shown(url)
        self._url = urlunsplit(parts._replace(netloc=host, fragment=""))
        self._headers = {"Accept-Encoding": "identity"}
        if login:
            self._headers |= urllib3.make_headers(basic_auth=unquote(login))
        self._timeout = urllib3.Timeout(connect=timeout_s, read=timeout_s)

    def size(self) -> int:
        """Return how many bytes the object has, as told with its first byte."""
        response = self._get(0, 1)
        try:
            if response.status == 200:
                told = response.headers.get("Content-Length", "")
            else:
                told = self._content_range(response)[2]
        finally:
            response.close()
        if not told.isdigit():
            raise StorageError(
                f"{self._where}: its server does not tell how large it is: fetch the data and "
                f"pass the folder."
            )
        return int(told)

    def part(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from start to stop, or the first of them."""
        response = self._get(start, stop)
        try:
            self._require_part(response, start, stop)
            while data := response.read1(_CHUNK):
                yield data
        except HTTPError as error:
            raise Fault(_reason(error)) from None
        finally:
            # What was read to its end has gone back to the pool already, and is not closed.
            response.close()

    def _get(self, start: int, stop: int) -> urllib3.BaseHTTPResponse:
        headers = self._headers | {"Range": f"bytes={start}-{stop - 1}"}
        try:
            response = _pool(self._url).request(
                "GET",
                self._url,
                headers=headers,
                timeout=self._timeout,
                retries=_REDIRECTS,
                preload_content=False,
            )
        except LocationParseError:
            raise StorageError(f"{self._where}: is no URL: correct it.") from None
        except MaxRetryError as error:
            if isinstance(error.reason, ResponseError):
                raise StorageError(
                    f"{self._where}: is redirected more than 5 times: check the URL."
                ) from None
            raise Fault(_reason(error.reason or error)) from None
        except HTTPError as error:
            raise Fault(_reason(error)) from None
        if response.status not in (200, 206, 416):
            response.close()
            self._refuse(response)
        return response

    def _refuse(self, response: urllib3.BaseHTTPResponse) -> None:
        answer = f"{response.status} {response.reason or ''}".rstrip()
        if response.status in _PASSING:
            wait_s = _retry_after_s(response.headers.get("Retry-After", ""))
            raise Fault(f"the server answers {answer}", wait_s=wait_s)
        cure = _CURES.get(response.status, f"Check the URL and the server, {_FETCH}.")
        raise StorageError(f"{self._where}: the server answers {answer}. {cure}")

    def _require_part(self, response: urllib3.BaseHTTPResponse, start: int, stop: int) -> None:
        """Refuse an answer that is not the part asked for, or its beginning."""
        if response.status == 200:
            size = response.headers.get("Content-Length")
            if start == 0 and size == str(stop):
                return
            raise StorageError(
                f"{self._where}: the server sends the whole file ({size or 'unknown'} bytes) when "
                f"asked for bytes {start} to {stop}. Members are read in parts: use a server that "
                f"honours ranges, as nginx does, {_FETCH}."
            )
        first, last, size = self._content_range(response)
        if not first:
            raise StorageError(
                f"{self._where}: has {size} bytes, and byte {stop - 1} is asked for. It was cut "
                f"short or replaced: use the index that was made with it."
            )
        if int(first) != start or not start <= int(last) < stop:
            raise StorageError(
                f"{self._where}: the server sends bytes {first} to {last} when asked for {start} "
                f"to {stop - 1}. It does not honour ranges: use another, {_FETCH}."
            )

    def _content_range(self, response: urllib3.BaseHTTPResponse) -> tuple[str, str, str]:
        """Return first and last byte (empty where there are none) and size, as told."""
        told = response.headers.get("Content-Range", "")
        found = _PART.match(told)
        if found is None:
            raise StorageError(
                f"{self._where}: the server answers {response.status} and does not tell which "
                f"part it sends (Content-Range: {told!r}): use another, {_FETCH}."
            )
        first, last, size = found.groups(default="")
        return first, last, size


def _pool(url: str) -> urllib3.PoolManager:
    """Return the connections of this process, through the machine's proxy where it has one."""
    parts = urlsplit(url)
    proxy = "" if proxy_bypass(parts.netloc) else getproxies().get(parts.scheme, "")
    key = (os.getpid(), proxy)
    if key not in _pools:
        pool = urllib3.ProxyManager(proxy) if proxy else urllib3.PoolManager(maxsize=16)
        _pools.setdefault(key, pool)
    return _pools[key]


@atexit.register
def close_connections() -> None:
    """Close the connections that this process keeps open; reading opens new ones."""
    for key in [key for key in _pools if key[0] == os.getpid()]:
        _pools.pop(key).clear()


def _reason(error: BaseException) -> str:
    """Return what happened without the URL, which urllib3 puts into its messages."""
    reason = getattr(error, "reason", None)
    inner = reason if isinstance(reason, BaseException) else error
    cause = inner.__cause__ or inner.__context__
    if isinstance(cause, OSError) and cause.strerror:
        return f"{type(inner).__name__}: {cause.strerror}"
    return type(inner).__name__


def _retry_after_s(told: str) -> float:
    """Return how many seconds a Retry-After header asks to wait, 0 where it does not."""
    if told.isdigit():
        return float(told)
    try:
        until = parsedate_to_datetime(told)
    except ValueError:
        return 0.0
    until = until if until.tzinfo else until.replace(tzinfo=UTC)
    return max(0.0, (until - datetime.now(UTC)).total_seconds())
