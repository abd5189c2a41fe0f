"""Ranges over http and https, with urllib3; every response is checked to be the part requested.

Errors do not chain urllib3's own, whose messages hold the whole URL with its secrets.
"""

import base64
import json
import re
import time
from collections.abc import Generator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, Final
from urllib.parse import parse_qs, unquote, urljoin, urlunsplit

import urllib3
from urllib3.exceptions import HTTPError, LocationValueError

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.connections import failure_reason, request
from stereogenbench_data.sources.location import WEB_SCHEMES, shown, split_url
from stereogenbench_data.sources.retry import Attempt, ProcessLock, TooSlow, TransientError
from stereogenbench_data.sources.transport import (
    MISSING,
    busy,
    replaced,
    require_expected_size,
    require_no_pause,
    retry_after_s,
)

_REDIRECTS: Final = frozenset({301, 302, 303, 307, 308})
_MOST_REDIRECTS: Final = 5
_PASSING: Final = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Status codes of failures that may pass."""

_NO_LONGER_VALID: Final = frozenset({400, 401, 403, 404, 410})
"""Status codes of a signed URL that has expired or was withdrawn."""

_FETCH: Final = "or fetch the data and pass the folder"
_CURES: Final = {
    401: f"It asks for a login: use hf:// or s3://, which know yours, {_FETCH}.",
    403: f"It may not be read with what the URL says: check access, {_FETCH}.",
    404: MISSING,
    410: MISSING,
}
_NUMBER: Final = re.compile(r"[0-9]{1,18}")
_PART: Final = re.compile(r"bytes (?:([0-9]{1,18})-([0-9]{1,18})|\*)/([0-9]{1,18}|\*)")
_STRONG_TAG: Final = re.compile(r'"[!#-~]{0,256}"')
_DATE: Final = re.compile(r"[A-Za-z0-9,: +-]{1,64}")
_RATE_LIMIT: Final = re.compile(r";r=0;t=([0-9]{1,6})(?:[;,]|$)")
_CHUNK: Final = 64 * 1024
_MARGIN_S: Final = 60.0
"""Seconds before a signed URL expires from which on it is not used; at most a tenth of its time."""

_LONGEST_KEPT_S: Final = 86_400.0


@dataclass(frozen=True, slots=True)
class _Version:
    """What a server states of an object that changes with its content; "" if it sends none."""

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


@dataclass(frozen=True, slots=True, repr=False)
class _Signed:
    """A signed URL that a server redirected to. Whoever has it may read: it is never shown.

    Attributes:
        url: The URL.
        until_s: Until when it is used, on the monotonic clock.
        linked_etag: The ETag of the object to which it leads, as the redirect stated it.
    """

    url: str
    until_s: float
    linked_etag: str


class WebTransport:
    """One object of a web server. Where it redirects to a signed URL, that is kept for a while."""

    longest_whole_bytes = 0
    """The size up to which a whole object is accepted where a part was requested."""

    def __init__(
        self,
        url: str,
        *,
        expected_size: int | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        """Name an object; user and password of its URL are sent as a login, and never shown.

        Args:
            url: Where it is.
            expected_size: The size in bytes that the index records; None if it is not known.
            headers: Further headers. "authorization" goes to the URL's own server alone.

        Raises:
            StorageError: If it is not a URL.
        """
        parts = split_url(url)
        login, _, host = parts.netloc.rpartition("@")
        self._where = shown(url)
        self._url = urlunsplit(parts._replace(netloc=host, fragment=""))
        self._expected_size = expected_size
        self._headers = {"Accept-Encoding": "identity", **(headers or {})}
        if login:
            self._headers |= urllib3.make_headers(basic_auth=unquote(login))
        self._seen: dict[str, _Version] = {}
        self._tags: dict[tuple[str, str], _Version] = {}
        self._signed: _Signed | None = None
        self._was_signed = False
        self._resolving = ProcessLock()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, without signed URLs."""
        return self.__dict__ | {"_signed": None}

    def size(self, attempt: Attempt) -> int:
        """Return how many bytes the object has, as the response for its first byte states."""
        response = self._get(0, 1, attempt)
        response.close()
        return self._require_stated(self._stated_size(response))

    def entries(self, attempt: Attempt) -> dict[str, int | None]:
        """Refuse to list a folder: plain web servers have no listings."""
        raise StorageError(
            f"{self._where}: a web server does not list its folders. Pass a folder with an "
            f"index.parquet, or an index that names this URL as its root."
        )

    def part(self, start: int, stop: int, attempt: Attempt) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        response = self._get(start, stop, attempt)
        try:
            skipped = self._require_part(response, start, stop)
            wanted = stop - start
            attempt.begin_body()
            while data := response.read1(_CHUNK):
                if skipped:
                    skipped, data = max(0, skipped - len(data)), data[skipped:]
                if response.status == 200 and len(data) >= wanted:
                    if wanted:
                        yield data[:wanted]
                    return
                wanted -= len(data)
                if data:
                    yield data
        except HTTPError as error:
            raise TransientError(failure_reason(error)) from None
        finally:
            # A response that was read to its end is back in the pool, and is not closed.
            response.close()

    def _get(self, start: int, stop: int, attempt: Attempt) -> urllib3.BaseHTTPResponse:
        """Return the response for a part of the object, from where it is now."""
        headers = {"Range": f"bytes={start}-{stop - 1}"}
        signed = self._valid_signed()
        if signed is not None:
            try:
                response = self._ask(signed.url, headers, attempt)
            except TransientError:
                self._drop(signed)  # its server may be gone; another one may not
                raise
            if response.status not in _NO_LONGER_VALID | _REDIRECTS:
                return self._accepted(response, signed.url, signed.linked_etag, attempt)
            self._drop(signed)
            _use_up(response)
        return self._resolved(headers, attempt)

    def _resolved(self, headers: Mapping[str, str], attempt: Attempt) -> urllib3.BaseHTTPResponse:
        """Return the response for a part of the object, having followed redirects to it."""
        url, linked_etag = self._url, ""
        with ExitStack() as turn:
            if self._was_signed:
                # One thread resolves, and the others use what it found.
                turn.enter_context(self._resolving.held(attempt))
                if (signed := self._valid_signed()) is not None:
                    turn.close()
                    url, linked_etag = signed.url, signed.linked_etag
            login = dict(self._headers)
            for _ in range(_MOST_REDIRECTS + 1):
                if _origin(url) != _origin(self._url):
                    login.pop("authorization", None)
                response = self._ask(url, {**login, **headers}, attempt)
                if response.status not in _REDIRECTS:
                    break
                url = self._redirected(url, response)
                linked_etag = response.headers.get("X-Linked-ETag", "").strip() or linked_etag
                if self._keep(url, response, linked_etag):
                    turn.close()
            else:
                raise StorageError(
                    f"{self._where}: is redirected more than {_MOST_REDIRECTS} times: check the "
                    f"URL."
                )
        return self._accepted(response, url, linked_etag, attempt)

    def _accepted(
        self, response: urllib3.BaseHTTPResponse, url: str, linked_etag: str, attempt: Attempt
    ) -> urllib3.BaseHTTPResponse:
        """Return a response that has content of the object that was read before."""
        if response.status not in (200, 206, 416):
            _use_up(response)
            raise self._refusal(response, server=server_of(url), attempt=attempt)
        try:
            size = self._stated_size(response)
            if response.status != 416:
                self._require_same(response, size, url, linked_etag)
            if self._expected_size is not None:
                found = self._require_stated(size)
                require_expected_size(found, expected=self._expected_size, where=self._where)
        except StorageError:
            response.close()
            raise
        return response

    def _valid_signed(self) -> _Signed | None:
        signed = self._signed
        return signed if signed is not None and time.monotonic() < signed.until_s else None

    def _keep(self, url: str, response: urllib3.BaseHTTPResponse, linked_etag: str) -> bool:
        """Keep a URL that a response redirects to if it says when it expires; return whether so."""
        left_s = signed_for_s(url, response.headers.get("Date", ""))
        if left_s <= 0:
            return False
        usable_s = min(left_s - min(_MARGIN_S, left_s / 10), _LONGEST_KEPT_S)
        self._signed = _Signed(url, time.monotonic() + usable_s, linked_etag)
        self._was_signed = True
        return True

    def _drop(self, signed: _Signed) -> None:
        if self._signed is signed:
            self._signed = None

    def _ask(
        self, url: str, headers: Mapping[str, str], attempt: Attempt
    ) -> urllib3.BaseHTTPResponse:
        """Return a server's response, which may be a redirect."""
        require_no_pause(server_of(url), attempt)
        try:
            return request(url, headers={**headers, **self._condition(url)}, attempt=attempt)
        except TooSlow as error:
            raise TransientError(str(error)) from None
        except (LocationValueError, UnicodeError):
            sent = "" if url == self._url else f"is redirected to {shown(url)[:200]}, which "
            raise StorageError(f"{self._where}: {sent}is not a valid URL: correct it.") from None
        except HTTPError as error:
            raise TransientError(failure_reason(error)) from None

    def _redirected(self, url: str, response: urllib3.BaseHTTPResponse) -> str:
        """Return where a response redirects to, if that may be followed."""
        stated = response.headers.get("Location", "").strip()
        _use_up(response)
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
        if reason:
            raise StorageError(
                f"{self._where}: the server answers {response.status} and {reason}. Check the URL "
                f"and the server, {_FETCH}."
            )
        host = parts.netloc.rpartition("@")[2]
        return urlunsplit(parts._replace(netloc=host, fragment=""))

    def _condition(self, url: str) -> dict[str, str]:
        """Return the header that asks a server for a part only if the object is unchanged there."""
        seen = self._tags.get(_origin(url))
        if seen is not None and _STRONG_TAG.fullmatch(seen.etag):
            return {"If-Range": seen.etag}
        if seen is not None and not seen.etag and _DATE.fullmatch(seen.modified):
            return {"If-Range": seen.modified}
        return {}

    def _require_same(
        self, response: urllib3.BaseHTTPResponse, size: str, url: str, linked_etag: str
    ) -> None:
        """Refuse a response of an object that was replaced since the first read."""
        now = _Version(
            etag=response.headers.get("ETag", "").strip(),
            modified=response.headers.get("Last-Modified", "").strip(),
            size=size if _NUMBER.fullmatch(size) else "",
        )
        self._tags.setdefault(_origin(url), now)
        if linked_etag:  # a content network's own ETags and dates may differ between its servers
            now = _Version(etag=linked_etag, modified="", size=now.size)
        changes = self._seen.setdefault("first", now).changes(now)
        if changes:
            raise replaced(self._where, "on its server", changes)

    def _refusal(
        self, response: urllib3.BaseHTTPResponse, *, server: str, attempt: Attempt
    ) -> Exception:
        """Return the error of a response without content."""
        reason = re.sub(r"[^ -~]", "?", response.reason or "")[:60]
        answer = f"{response.status} {reason}".rstrip()
        if response.status in _PASSING:
            return busy(
                f"the server answers {answer}",
                server=server, wait_s=_asked_wait_s(response), attempt=attempt,
            )  # fmt: skip
        cure = _CURES.get(response.status, f"Check the URL and the server, {_FETCH}.")
        return StorageError(f"{self._where}: the server answers {answer}. {cure}")

    def _require_part(self, response: urllib3.BaseHTTPResponse, start: int, stop: int) -> int:
        """Refuse a response that is neither the requested part nor its beginning.

        Returns:
            The number of bytes to skip, which precede the part in a whole object.
        """
        if response.status == 200:
            size = response.headers.get("Content-Length", "")[:20]
            if start == 0 and size == str(stop):
                return 0
            if _NUMBER.fullmatch(size) and stop <= int(size) <= self.longest_whole_bytes:
                return start
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
        return 0

    def _require_stated(self, size: str) -> int:
        if not _NUMBER.fullmatch(size):
            raise StorageError(
                f"{self._where}: its server does not state its size ({size[:80]!r}): fetch the "
                f"data and pass the folder."
            )
        return int(size)

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


def _use_up(response: urllib3.BaseHTTPResponse) -> None:
    """Finish a response whose content is not needed; its connection is kept if that is short."""
    length = response.headers.get("Content-Length", "")
    if _NUMBER.fullmatch(length) and int(length) <= _CHUNK:
        response.drain_conn()
    response.close()


def _asked_wait_s(response: urllib3.BaseHTTPResponse) -> float:
    """Return how many seconds a busy server asks to wait, 0 if it does not."""
    limit = _RATE_LIMIT.search(response.headers.get("RateLimit", "")[:200])
    if response.status == 429 and limit is not None:
        return float(limit[1]) + 1  # the end of the Hub's window, rounded
    return retry_after_s(response.headers.get("Retry-After", ""))


def server_of(url: str) -> str:
    """Return the host of a URL with its port, by which pauses are kept."""
    return split_url(url).netloc


def _origin(url: str) -> tuple[str, str]:
    parts = split_url(url)
    return parts.scheme, parts.netloc


def signed_for_s(url: str, date: str) -> float:
    """Return for how many seconds a signed URL is valid, 0 if it does not say.

    Args:
        url: The URL, signed as S3, Google, CloudFront or Azure do.
        date: The time of the server that signed it (Date), as this machine's may be wrong.
    """
    try:
        query = parse_qs(split_url(url).query, max_num_fields=64)
        now_s = parsedate_to_datetime(date).timestamp() if date else time.time()
    except (ValueError, TypeError, IndexError, OverflowError, StorageError):
        return 0.0
    ends_s = []
    with suppress(ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError):
        for signer in ("X-Amz", "X-Goog"):
            if f"{signer}-Date" in query:
                signed = datetime.strptime(query[f"{signer}-Date"][0], "%Y%m%dT%H%M%S%z")
                ends_s.append(signed.timestamp() + float(query[f"{signer}-Expires"][0]))
        if "Expires" in query:
            ends_s.append(float(query["Expires"][0]))
        if "se" in query and "sig" in query:
            until = datetime.fromisoformat(query["se"][0])
            ends_s.append((until if until.tzinfo else until.replace(tzinfo=UTC)).timestamp())
        if "Policy" in query:
            text = query["Policy"][0][:8192].translate(str.maketrans("-_~", "+=/"))
            (statement,) = json.loads(base64.b64decode(text))["Statement"]
            ends_s.append(float(statement["Condition"]["DateLessThan"]["AWS:EpochTime"]))
    left_s = min(ends_s, default=0.0) - now_s
    return left_s if left_s > 0 else 0.0  # nan is not
