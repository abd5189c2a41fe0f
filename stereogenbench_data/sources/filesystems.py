"""Ranges through fsspec's file systems: s3fs for ``s3://``, and others.

Errors do not chain those of the file systems, whose messages may hold signed URLs.
"""

import asyncio
import os
import sys
from collections.abc import Callable, Coroutine, Generator, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from threading import Event, Thread
from typing import Any, Final, TypeVar

from stereogenbench_data.errors import ExtraError, StorageError, missing_extra
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.retry import Attempt, TransientError
from stereogenbench_data.sources.transport import (
    MISSING,
    MissingObject,
    busy,
    replaced,
    require_expected_size,
    require_no_pause,
    retry_after_s,
)

_T = TypeVar("_T")

_EXTRAS: Final = {"hf": "hub", "s3": "s3", "s3a": "s3"}
_NOT_READ: Final = ("ftp", "ftps")
"""Servers that give no ranges of files to several connections at a time."""

_CALL_BYTES: Final = 2 * 1024 * 1024
"""Bytes of one call of a file system, whose progress is not seen before it returns."""

_CHUNK: Final = 256 * 1024
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
        self._server = "/".join(self._where.split("/")[:3])
        self._opened: tuple[int, Any, str] | None = None
        self._seen: dict[str, dict[str, str]] = {}

    def size(self, attempt: Attempt) -> int:
        """Return the size of the object in bytes."""
        files, path = self._open()
        if _is_s3(files):
            stated = self._s3_call(attempt, files, path, "head_object")
            size = stated["ContentLength"]
        else:
            size = self._call(attempt, lambda: files.size(path))
        if not isinstance(size, int):
            raise StorageError(f"{self._where}: has no size ({size!r}): is it a folder?")
        return size

    def entries(self, attempt: Attempt) -> dict[str, int | None]:
        """List a folder: name to size in bytes, None for a folder."""
        files, path = self._open()
        folder, listed = path.strip("/"), self._call(attempt, lambda: files.ls(path, detail=True))
        found: dict[str, int | None] = {}
        for entry in listed:
            path = str(entry["name"]).strip("/")
            if path != folder and path:
                is_folder = entry["type"] == "directory"
                found[path.rpartition("/")[2]] = None if is_folder else int(entry["size"] or 0)
        return found

    def part(self, start: int, stop: int, attempt: Attempt) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        files, path = self._open()
        if _is_s3(files):
            yield from self._s3_part(start, stop, attempt, files, path)
            return
        if self._expected_size is not None and "size" not in self._seen:
            found = self.size(attempt)
            require_expected_size(found, expected=self._expected_size, where=self._where)
            self._seen["size"] = {}
        for first in range(start, stop, _CALL_BYTES):
            last = min(first + _CALL_BYTES, stop)
            data, details = self._call(attempt, partial(self._read, first, last, files, path))
            self._require_same(details)
            yield data
            if len(data) != last - first:
                return

    def _read(self, first: int, last: int, files: Any, path: str) -> tuple[bytes, Any]:
        """Return the bytes from first to last, and what the file system reports of the file."""
        if files.async_impl:
            return bytes(files.cat_file(path, start=first, end=last)), None
        # Without a cache, or fsspec would read megabytes ahead.
        with files.open(path, "rb", cache_type="none") as file:
            file.seek(first)
            return file.read(last - first), getattr(file, "details", None)

    def _s3_part(
        self, start: int, stop: int, attempt: Attempt, files: Any, path: str
    ) -> Generator[bytes, None, None]:
        """Yield a part of an object of S3, which is read only while its ETag stays the same."""
        part = {"Range": f"bytes={start}-{stop - 1}"}
        try:
            stated = self._s3_call(attempt, files, path, "get_object", **part)
        except StorageError as error:
            if self._expected_size is not None and not isinstance(error, MissingObject):
                # It may end before the part.
                size = self.size(attempt)
                require_expected_size(size, expected=self._expected_size, where=self._where)
            raise
        body = stated["Body"]
        try:
            self._require_same({"ETag": stated["ETag"]} if "ETag" in stated else None)
            whole = str(stated.get("ContentRange", "")).rpartition("/")[2]
            if whole.isdecimal():
                require_expected_size(int(whole), expected=self._expected_size, where=self._where)
            attempt.begin_body()
            while data := self._awaited(attempt, files, lambda: body.read(_CHUNK)):
                yield bytes(data)
        finally:
            files.loop.call_soon_threadsafe(body.close)

    def _s3_call(self, attempt: Attempt, files: Any, path: str, method: str, **how: Any) -> Any:
        """Return what S3 answers of the object, if it is the one that was read before."""
        bucket, key, version = files.split_path(path)
        options = {"Bucket": bucket, "Key": key, **how}
        if version is not None:
            options["VersionId"] = version
        first = self._seen.get("first", {})
        if "ETag" in first:
            options["IfMatch"] = first["ETag"]
        return self._awaited(attempt, files, lambda: files._call_s3(method, **options))

    def _require_same(self, details: Any) -> None:
        """Refuse a file that was replaced since the first read, if its file system reports it."""
        if not isinstance(details, Mapping):
            return
        now = {name: str(details[name]) for name in _CHANGE_MARKS if name in details}
        before = self._seen.setdefault("first", now)
        changed = [name for name in before if name in now and before[name] != now[name]]
        if changed:
            changes = [f"its {name} was {before[name]} and is {now[name]}" for name in changed]
            raise replaced(self._where, "in its store", ", ".join(changes))

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, which opens its own file system."""
        return self.__dict__ | {"_opened": None}

    def _open(self) -> tuple[Any, str]:
        """Return this process's file system, and the object's path in it."""
        if self._opened is None or self._opened[0] != os.getpid():
            with self._named_errors(None):
                import fsspec.core

                try:
                    files, path = fsspec.core.url_to_fs(self._url)
                except TypeError as error:  # a file system that needs more than a URL
                    raise ValueError(str(error)) from None
                self._opened = (os.getpid(), files, path)
        return self._opened[1], self._opened[2]

    def _call(self, attempt: Attempt, operation: Callable[[], _T]) -> _T:
        """Return what an operation of a file system returns, within the time that is left."""
        require_no_pause(self._server, attempt)
        with self._named_errors(attempt):
            return _within(attempt, operation)

    def _awaited(
        self, attempt: Attempt, files: Any, begin: Callable[[], Coroutine[Any, Any, _T]]
    ) -> _T:
        """Return what an asynchronous operation returns, within the limits of the attempt."""
        require_no_pause(self._server, attempt)
        with self._named_errors(attempt):
            try:
                allowed_s = attempt.next_wait_s()
            except TimeoutError as error:
                raise TransientError(str(error)) from None
            began_s, received = attempt.clock(), 0
            running = asyncio.run_coroutine_threadsafe(begin(), files.loop)
            attempt.on_cancel(partial(_cancel, running))
            try:
                result = running.result(allowed_s)
                received = len(result) if isinstance(result, bytes) else 0
            except (TimeoutError, CancelledError) as error:
                if isinstance(error, TimeoutError) and running.done() and not running.cancelled():
                    raise  # the store's own
                attempt.add(attempt.clock() - began_s, 0)
                began_s = attempt.clock()
                raise TransientError(str(attempt.too_slow())) from None
            else:
                return result
            finally:
                running.cancel()
                attempt.add(attempt.clock() - began_s, received)

    @contextmanager
    def _named_errors(self, attempt: Attempt | None) -> Iterator[None]:
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
            raise self._network_failure(error, attempt) from None
        except _loaded(_SETUP_ERRORS) as error:
            raise StorageError(
                f"{self._where}: permission denied ({_reason(error)}). Log in to its store, or set "
                f"up its file system."
            ) from None

    def _network_failure(self, error: BaseException, attempt: Attempt | None) -> Exception:
        """Return our error for one of a network or a server."""
        status, wait_s = _status(error), _wait_s(error)
        if status == _CHANGED:
            return replaced(self._where, "in its store", "its ETag is another")
        if status in _REFUSED:
            return StorageError(f"{self._where}: {_reason(error)}. {MISSING}")
        if wait_s > 0 and attempt is not None:
            return busy(_reason(error), server=self._server, wait_s=wait_s, attempt=attempt)
        return TransientError(_reason(error))


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


def _cancel(running: Any) -> None:
    running.cancel()


def _within(attempt: Attempt, call: Callable[[], _T]) -> _T:
    """Return what a call returns, within the time that a read has left.

    File systems limit single waits at best. A call that takes longer, or whose read is cancelled,
    is abandoned, in a thread that does not keep the process alive.

    Raises:
        TransientError: If it takes longer.
    """
    returned: list[_T] = []
    raised: list[BaseException] = []
    ended = Event()

    def run() -> None:
        try:
            returned.append(call())
        except BaseException as error:  # noqa: BLE001 - raised again in the thread that waits
            raised.append(error)
        ended.set()

    attempt.on_cancel(ended.set)
    thread = Thread(target=run, daemon=True)
    began_s = attempt.clock()
    thread.start()
    ended.wait(max(0.0, min(attempt.left_s, attempt.outage_left_s)))
    attempt.add(attempt.clock() - began_s, 0)
    if raised:
        raise raised[0]
    if not returned:
        raise TransientError(str(attempt.too_slow()))
    attempt.outage_left_s = attempt.policy.longest_outage_s
    return returned[0]


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
