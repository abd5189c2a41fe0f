"""Ranges through fsspec's file systems: s3fs for ``s3://``, and others.

Errors do not chain those of the file systems, whose messages may hold signed URLs.
"""

import os
import sys
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from stereogenbench_data.errors import ExtraError, StorageError, missing_extra
from stereogenbench_data.sources.location import Depth, Listing, shown
from stereogenbench_data.sources.retry import (
    CHUNK_BYTES,
    MISSING,
    PASSING,
    MissingObject,
    TransientError,
    replaced,
    require_expected_size,
    retry_after_s,
)

_EXTRAS: Final = {"hf": "hub", "s3": "s3", "s3a": "s3"}
_NOT_READ: Final = ("ftp", "ftps")
"""Servers that give no ranges of files to several connections at a time."""

_CALL_BYTES: Final = 2 * 1024 * 1024
"""Bytes of one call of a file system, whose progress is not seen before it returns."""

_CHANGED: Final = 412
_GONE: Final = (401, 404, 410)
_NETWORK_ERRORS: Final = (
    ("builtins", "OSError"),
    ("aiohttp", "ClientError"),
    ("botocore.exceptions", "ConnectionError"),
    ("botocore.exceptions", "HTTPClientError"),
    ("botocore.exceptions", "IncompleteReadError"),
    ("httpx2", "TransportError"),
    ("httpx", "TransportError"),
    ("huggingface_hub.errors", "HfHubHTTPError"),
)
"""What file systems raise where a server cannot be reached; only imported modules count."""

_SETUP_ERRORS: Final = (("botocore.exceptions", "BotoCoreError"),)
"""What file systems raise where they are not set up, for example without a login."""


class FilesystemTransport:
    """One object that fsspec opens; its file system handles logins."""

    def __init__(self, url: str, *, expected_size: int | None = None) -> None:
        """Name an object; nothing is requested yet.

        Args:
            url: Where it is.
            expected_size: The size in bytes that the index records; None if it is not known.

        Raises:
            StorageError: If it is on an FTP server.
        """
        self._url = url
        self._where = shown(url)
        if url.partition("://")[0].lower() in _NOT_READ:
            raise StorageError(
                f"{self._where}: FTP servers are not read. Serve the data by https or S3, or fetch "
                f"them and pass the folder."
            )
        self.server = "/".join(self._where.split("/")[:3])
        self._expected_size = expected_size
        self._seen: dict[str, str] = {}  # the ETag and the size of the first read
        self._opened: tuple[int, Any, str] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, which opens its own file system."""
        return self.__dict__ | {"_opened": None}

    def size(self, timeout_s: float) -> int:
        """Return the size of the object in bytes."""
        with self.named_errors():
            files, path, limit = self._open(timeout_s)
            size = files.size(path, **limit)
        if not isinstance(size, int):
            raise StorageError(f"{self._where}: has no size ({size!r}): is it a folder?")
        return size

    def listed(self, timeout_s: float, depth: Depth) -> Listing:
        """List a folder."""
        with self.named_errors():
            files, path, limit = self._open(timeout_s)
            if depth == "all levels":
                found = files.find(path, detail=True)
            else:
                found = {str(each["name"]): each for each in files.ls(path, detail=True, **limit)}
        listing: Listing = {}
        for place, each in found.items():
            name = place.strip("/").removeprefix(path.strip("/")).strip("/")
            version = each.get("ETag") or each.get("LastModified") or each.get("mtime") or ""
            if name:
                size = None if each["type"] == "directory" else int(each["size"] or 0)
                listing[name] = size, str(version)
        return listing

    def part(self, start: int, stop: int, timeout_s: float) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        with self.named_errors():
            files, path, limit = self._open(timeout_s)
            # s3fs itself, whose objects are read by their ETag.
            if type(files).__module__.partition(".")[0] == "s3fs":
                yield from self._s3_part(start, stop, timeout_s, files, path)
                return
            self._require_size(timeout_s)
            # Without a cache, or fsspec would read megabytes ahead.
            how = limit or {"cache_type": "none"}
            for first in range(start, stop, _CALL_BYTES):
                last = min(first + _CALL_BYTES, stop)
                data = bytes(files.cat_file(path, start=first, end=last, **how))
                yield data
                if len(data) != last - first:
                    return

    def _s3_part(
        self, start: int, stop: int, timeout_s: float, files: Any, path: str
    ) -> Generator[bytes, None, None]:
        """Yield a part of an object of S3, which is read only while its ETag stays the same."""
        from fsspec.asyn import sync

        bucket, key, version = files.split_path(path)
        options = {"Bucket": bucket, "Key": key, "Range": f"bytes={start}-{stop - 1}"}
        if version is not None:
            options["VersionId"] = version
        if "etag" in self._seen:
            options["IfMatch"] = self._seen["etag"]
        try:
            stated = files.call_s3("get_object", timeout=timeout_s, **options)
        except OSError as error:
            if _answer(error)[0] == 416:
                self._require_size(timeout_s)  # it may end before the part
            raise
        body = stated["Body"]
        try:
            etag = str(stated.get("ETag", ""))
            first = self._seen.setdefault("etag", etag)
            if etag != first:
                raise replaced(self._where, "in its store", f"its ETag was {first} and is {etag}")
            whole = str(stated.get("ContentRange", "")).rpartition("/")[2]
            if whole.isdecimal():
                require_expected_size(int(whole), expected=self._expected_size, where=self._where)
            while data := sync(files.loop, body.read, CHUNK_BYTES, timeout=timeout_s):
                yield bytes(data)
        finally:
            files.loop.call_soon_threadsafe(body.close)

    def _require_size(self, timeout_s: float) -> None:
        if self._expected_size is not None and "size" not in self._seen:
            found = self.size(timeout_s)
            require_expected_size(found, expected=self._expected_size, where=self._where)
            self._seen["size"] = str(found)

    def _open(self, timeout_s: float) -> tuple[Any, str, dict[str, Any]]:
        """Return this process's file system, the object's path in it, and its limit of time."""
        if self._opened is None or self._opened[0] != os.getpid():
            import fsspec.core

            try:
                files, path = fsspec.core.url_to_fs(self._url)
            except TypeError as error:  # a file system that needs more than a URL
                raise ValueError(str(error)) from None
            self._opened = (os.getpid(), files, path)
        _, files, path = self._opened
        return files, path, {"timeout": timeout_s} if files.async_impl else {}

    @contextmanager
    def named_errors(self) -> Iterator[None]:
        """Raise errors of file systems as a `TransientError`, or an error that names the cure."""
        try:
            yield
        except (ExtraError, StorageError, TransientError):
            raise
        except FileNotFoundError:
            raise self._missing() from None
        except PermissionError as error:
            raise self._no_permission(error) from None
        except ImportError as error:
            extra = _EXTRAS.get(self._url.partition("://")[0])
            other = ExtraError(
                f"{self._where}: needs a package that is not installed ({error}). Install it."
            )
            raise (missing_extra(self._where, extra, error) if extra else other) from None
        except ValueError:
            raise StorageError(
                f"{self._where}: not a URL that fsspec can open. Correct it, or fetch the data and "
                f"pass the folder."
            ) from None
        except network_errors() as error:
            status, wait_s = _answer(error)
            if status == _CHANGED:
                raise replaced(self._where, "in its store", "its ETag is another") from None
            if 400 <= status < 500 and status not in PASSING:
                refused = StorageError(f"{self._where}: {_reason(error)}. {MISSING}")
                raise (self._missing() if status in _GONE else refused) from None
            raise TransientError(_reason(error), wait_s=wait_s) from None
        except _loaded(_SETUP_ERRORS) as error:
            raise self._no_permission(error) from None

    def _missing(self) -> MissingObject:
        return MissingObject(f"{self._where}: does not exist, or is private. {MISSING}")

    def _no_permission(self, error: BaseException) -> StorageError:
        return StorageError(
            f"{self._where}: permission denied ({_reason(error)}). Log in to its store, or ask for "
            f"access."
        )


def _answer(error: BaseException) -> tuple[int, float]:
    """Return the status and the Retry-After, in seconds, of a server's response; 0 without any."""
    for each in (error, error.__cause__):
        response = getattr(each, "response", None)
        if isinstance(response, Mapping):  # of boto
            stated = response.get("ResponseMetadata", {})
            status, headers = stated.get("HTTPStatusCode"), stated.get("HTTPHeaders")
        else:
            status = getattr(response, "status_code", None)
            headers = getattr(response, "headers", None)
        if isinstance(status, int):
            return status, retry_after_s(str((headers or {}).get("retry-after") or ""))
    return 0, 0.0


def _reason(error: BaseException) -> str:
    """Return what happened without any URL, which may hold secrets."""
    status, _ = _answer(error)
    if status:
        return f"the server answers {status}"
    text = error.strerror if isinstance(error, OSError) else None
    return f"{type(error).__name__}: {text}" if text and "://" not in text else type(error).__name__


def network_errors() -> tuple[type[BaseException], ...]:
    """Return the errors of file systems and the Hub's client for an unreachable server."""
    return _loaded(_NETWORK_ERRORS)


def _loaded(kinds: tuple[tuple[str, str], ...]) -> tuple[type[BaseException], ...]:
    found = (getattr(sys.modules.get(module), name, None) for module, name in kinds)
    return tuple(kind for kind in found if kind is not None)
