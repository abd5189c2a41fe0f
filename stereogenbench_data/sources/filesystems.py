"""Ranges through fsspec's file systems: s3fs for ``s3://``, and others.

Errors do not chain those of the file systems, whose messages may hold signed URLs.
"""

import os
import sys
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Final

from stereogenbench_data.errors import ExtraError, StorageError, missing_extra
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.retry import (
    CHUNK_BYTES,
    MISSING,
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

_REFUSED: Final = frozenset({400, 401, 403, 404, 405, 410, 416, 451})
_CHANGED: Final = 412
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

_CHANGE_MARKS: Final = ("ETag", "etag", "LastModified", "last_modified", "mtime", "size")
"""What file systems report of a file that changes with its content."""

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
        self._expected_size = expected_size
        self._where = shown(url)
        if url.partition("://")[0].lower() in _NOT_READ:
            raise StorageError(
                f"{self._where}: FTP servers are not read. Serve the data by https or S3, or fetch "
                f"them and pass the folder."
            )
        self.server = "/".join(self._where.split("/")[:3])
        self._opened: tuple[int, Any, str] | None = None
        self._first_seen: dict[str, dict[str, str]] = {}
        self._has_expected_size = False

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, which opens its own file system."""
        return self.__dict__ | {"_opened": None}

    def size(self, timeout_s: float) -> int:
        """Return the size of the object in bytes."""
        with self._named_errors():
            files, path = self._open()
            if _is_s3(files):
                size = self._s3_call("head_object", files, path, timeout_s)["ContentLength"]
            else:
                size = files.size(path, **_limit(files, timeout_s))
        if not isinstance(size, int):
            raise StorageError(f"{self._where}: has no size ({size!r}): is it a folder?")
        return size

    def entries(self, timeout_s: float) -> dict[str, int | None]:
        """List a folder: name to size in bytes, None for a folder."""
        with self._named_errors():
            files, path = self._open()
            listed = files.ls(path, detail=True, **_limit(files, timeout_s))
        found: dict[str, int | None] = {}
        for entry in listed:
            name = str(entry["name"]).strip("/")
            if name not in ("", path.strip("/")):
                is_folder = entry["type"] == "directory"
                found[name.rpartition("/")[2]] = None if is_folder else int(entry["size"] or 0)
        return found

    def part(self, start: int, stop: int, timeout_s: float) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        with self._named_errors():
            files, path = self._open()
            if _is_s3(files):
                yield from self._s3_part(start, stop, timeout_s, files, path)
                return
        if self._expected_size is not None and not self._has_expected_size:
            self._require_size(timeout_s)
        for first in range(start, stop, _CALL_BYTES):
            last = min(first + _CALL_BYTES, stop)
            with self._named_errors():
                if files.async_impl:
                    data = files.cat_file(path, start=first, end=last, timeout=timeout_s)
                else:
                    data = self._read_file(first, last, files, path)
            yield bytes(data)
            if len(data) != last - first:
                return

    def _read_file(self, first: int, last: int, files: Any, path: str) -> bytes:
        # Without a cache, or fsspec would read megabytes ahead.
        with files.open(path, "rb", cache_type="none") as file:
            file.seek(first)
            data: bytes = file.read(last - first)
            self._require_same(getattr(file, "details", None))
        return data

    def _s3_part(
        self, start: int, stop: int, timeout_s: float, files: Any, path: str
    ) -> Generator[bytes, None, None]:
        """Yield a part of an object of S3, which is read only while its ETag stays the same."""
        from fsspec.asyn import sync

        part = {"Range": f"bytes={start}-{stop - 1}"}
        try:
            stated = self._s3_call("get_object", files, path, timeout_s, **part)
        except OSError as error:
            if _status(error) == 416 and self._expected_size is not None:
                self._require_size(timeout_s)  # it may end before the part
            raise
        body = stated["Body"]
        try:
            self._require_same({"ETag": stated["ETag"]} if "ETag" in stated else None)
            whole = str(stated.get("ContentRange", "")).rpartition("/")[2]
            if whole.isdecimal():
                require_expected_size(int(whole), expected=self._expected_size, where=self._where)
            while data := sync(files.loop, body.read, CHUNK_BYTES, timeout=timeout_s):
                yield bytes(data)
        finally:
            files.loop.call_soon_threadsafe(body.close)

    def _s3_call(self, method: str, files: Any, path: str, timeout_s: float, **how: Any) -> Any:
        """Return what S3 answers of the object, if it is the one that was read before."""
        bucket, key, version = files.split_path(path)
        options = {"Bucket": bucket, "Key": key, **how}
        if version is not None:
            options["VersionId"] = version
        first = self._first_seen.get("marks", {})
        if "ETag" in first:
            options["IfMatch"] = first["ETag"]
        return files.call_s3(method, timeout=timeout_s, **options)

    def _require_size(self, timeout_s: float) -> None:
        found = self.size(timeout_s)
        require_expected_size(found, expected=self._expected_size, where=self._where)
        self._has_expected_size = True

    def _require_same(self, details: Any) -> None:
        """Refuse a file that was replaced since the first read, if its file system reports it."""
        if not isinstance(details, Mapping):
            return
        now = {name: str(details[name]) for name in _CHANGE_MARKS if name in details}
        before = self._first_seen.setdefault("marks", now)
        changed = [name for name in before if name in now and before[name] != now[name]]
        if changed:
            changes = [f"its {name} was {before[name]} and is {now[name]}" for name in changed]
            raise replaced(self._where, "in its store", ", ".join(changes))

    def _open(self) -> tuple[Any, str]:
        """Return this process's file system, and the object's path in it."""
        if self._opened is None or self._opened[0] != os.getpid():
            import fsspec.core

            try:
                files, path = fsspec.core.url_to_fs(self._url)
            except TypeError as error:  # a file system that needs more than a URL
                raise ValueError(str(error)) from None
            self._opened = (os.getpid(), files, path)
        return self._opened[1], self._opened[2]

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Raise errors of file systems as a `TransientError`, or an error that names the cure."""
        try:
            yield
        except (ExtraError, StorageError, TransientError):
            raise
        except FileNotFoundError:
            raise MissingObject(
                f"{self._where}: does not exist, or is private. {MISSING}"
            ) from None
        except PermissionError as error:
            raise StorageError(
                f"{self._where}: permission denied ({_reason(error)}). Log in to its store, or ask "
                f"for access."
            ) from None
        except ImportError as error:
            extra = _EXTRAS.get(self._url.partition("://")[0])
            raise _not_installed(self._where, error, extra=extra) from None
        except ValueError:
            raise StorageError(
                f"{self._where}: not a URL that fsspec can open. Correct it, or fetch the data and "
                f"pass the folder."
            ) from None
        except network_errors() as error:
            if _status(error) == _CHANGED:
                raise replaced(self._where, "in its store", "its ETag is another") from None
            if _status(error) in _REFUSED:
                raise StorageError(f"{self._where}: {_reason(error)}. {MISSING}") from None
            raise TransientError(_reason(error), wait_s=_wait_s(error)) from None
        except _loaded(_SETUP_ERRORS) as error:
            raise StorageError(
                f"{self._where}: permission denied ({_reason(error)}). Log in to its store, or set "
                f"up its file system."
            ) from None


@contextmanager
def require_installed(where: str, *, extra: str) -> Iterator[None]:
    """Name the extra that has what the block imports, if it is not installed.

    Raises:
        StorageError: If an import fails.
    """
    try:
        yield
    except ImportError as error:
        raise _not_installed(where, error, extra=extra) from None


def _not_installed(where: str, error: ImportError, *, extra: str | None) -> ExtraError:
    if extra:
        return missing_extra(where, extra, error)
    return ExtraError(f"{where}: needs a package that is not installed ({error}). Install it.")


def _is_s3(files: Any) -> bool:
    """Return whether a file system is s3fs itself, whose objects are read by their ETag."""
    return type(files).__module__.partition(".")[0] == "s3fs"


def _limit(files: Any, timeout_s: float) -> dict[str, float]:
    """Return the option that limits a call of a file system: asynchronous ones have it."""
    return {"timeout": timeout_s} if files.async_impl else {}


def _status(error: BaseException) -> int | None:
    """Return the status of the server's response, if the error or its cause holds one."""
    for each in (error, error.__cause__):
        response = getattr(each, "response", None)
        if isinstance(response, Mapping):  # of boto
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        else:
            status = getattr(response, "status_code", None)
        if isinstance(status, int):
            return status
    return None


def _wait_s(error: BaseException) -> float:
    """Return how many seconds the server asks to wait, 0 if it does not."""
    for each in (error, error.__cause__):
        response = getattr(each, "response", None)
        headers: Any = getattr(response, "headers", None)
        if isinstance(response, Mapping):
            headers = response.get("ResponseMetadata", {}).get("HTTPHeaders")
        with suppress(TypeError, AttributeError, ValueError):
            return retry_after_s(str(headers.get("retry-after") or ""))
    return 0.0


def _reason(error: BaseException) -> str:
    """Return what happened without any URL, which may hold secrets."""
    if _status(error) is not None:
        return f"the server answers {_status(error)}"
    text = error.strerror if isinstance(error, OSError) else None
    return f"{type(error).__name__}: {text}" if text and "://" not in text else type(error).__name__


def network_errors() -> tuple[type[BaseException], ...]:
    """Return the errors of file systems and the Hub's client for an unreachable server."""
    return _loaded(_NETWORK_ERRORS)


def _loaded(kinds: tuple[tuple[str, str], ...]) -> tuple[type[BaseException], ...]:
    found = (getattr(sys.modules.get(module), name, None) for module, name in kinds)
    return tuple(kind for kind in found if kind is not None)
