"""Ranges through fsspec's file systems: the Hub's own for ``hf://``, s3fs for ``s3://``, others.

Errors do not chain those of the file systems, whose messages may hold signed URLs.
"""

import os
import re
import sys
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from threading import Thread
from typing import Any, Final, TypeVar

from stereogenbench_data.errors import ExtraError, ShardError, StorageError, missing_extra
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.retry import Attempt, TransientError

_T = TypeVar("_T")

_EXTRAS: Final = {"hf": "hub", "s3": "s3", "s3a": "s3"}
_CHUNK: Final = 8 * 1024 * 1024
_MISSING: Final = "Check the URL, and that the index and its shards lie in one folder."
_REFUSED: Final = frozenset({400, 401, 403, 404, 405, 410, 416, 451})
_NETWORK_ERRORS: Final = (
    ("builtins", "OSError"),
    ("aiohttp", "ClientError"),
    ("botocore.exceptions", "HTTPClientError"),
    ("httpx2", "TransportError"),
    ("httpx", "TransportError"),
    ("huggingface_hub.errors", "HfHubHTTPError"),
)
"""What file systems raise where a server cannot be reached; only imported modules count."""

_CHANGE_MARKS: Final = ("ETag", "etag", "LastModified", "last_modified", "mtime", "size")
"""What file systems report of a file that changes with its content."""

_COMMIT: Final = re.compile(r"[0-9a-f]{40}")

_SETUP_ERRORS: Final = (("botocore.exceptions", "BotoCoreError"),)
"""What file systems raise where they are not set up, for example without a login."""


class MissingObject(StorageError):
    """The object that a URL names does not exist."""


class FilesystemTransport:
    """One object that fsspec opens. Its file system handles logins and time limits of silence."""

    def __init__(self, url: str) -> None:
        """Name an object; nothing is requested yet."""
        self._url = url
        self._where = shown(url)
        self._opened: tuple[int, Any, str] | None = None
        self._file: Any = None
        self._seen: dict[str, dict[str, str]] = {}

    def size(self, attempt: Attempt) -> int:
        """Return the size of the object in bytes."""
        size = self._call(
            attempt,
            lambda files, path: (
                int(self._conditional(files, path).size) if _is_s3(files) else files.size(path)
            ),
        )
        if not isinstance(size, int):
            raise StorageError(f"{self._where}: has no size ({size!r}): is it a folder?")
        return size

    def entries(self, attempt: Attempt) -> dict[str, int | None]:
        """List a folder: name to size in bytes, None for a folder."""
        folder, listed = self._call(
            attempt, lambda files, path: (path.strip("/"), files.ls(path, detail=True))
        )
        found: dict[str, int | None] = {}
        for entry in listed:
            path = str(entry["name"]).strip("/")
            if path != folder and path:
                is_folder = entry["type"] == "directory"
                found[path.rpartition("/")[2]] = None if is_folder else int(entry["size"] or 0)
        return found

    def part(self, start: int, stop: int, attempt: Attempt) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop."""
        for first in range(start, stop, _CHUNK):
            last = min(first + _CHUNK, stop)
            data, details = self._call(attempt, partial(self._read, first, last))
            self._require_same(details)
            yield data
            if len(data) != last - first:
                return

    def _read(self, first: int, last: int, files: Any, path: str) -> tuple[bytes, Any]:
        """Return the bytes from first to last, and what the file system reports of the file."""
        if _is_s3(files):
            return bytes(self._conditional(files, path)._fetch_range(first, last)), None
        if files.async_impl:
            return bytes(files.cat_file(path, start=first, end=last)), None
        # Without a cache, or fsspec would read megabytes ahead.
        with files.open(path, "rb", cache_type="none") as file:
            file.seek(first)
            return file.read(last - first), getattr(file, "details", None)

    def _conditional(self, files: Any, path: str) -> Any:
        """Return an object of S3, opened once: it is read only while its ETag stays the same."""
        if self._file is None:
            # What was listed before may be of an older object.
            files.invalidate_cache(path)
            self._file = files.open(path, "rb", cache_type="none")
        return self._file

    def _require_same(self, details: Any) -> None:
        """Refuse a file that was replaced since the first read, if its file system reports it."""
        if not isinstance(details, Mapping):
            return
        now = {name: str(details[name]) for name in _CHANGE_MARKS if name in details}
        before = self._seen.setdefault("first", now)
        changed = [name for name in before if name in now and before[name] != now[name]]
        if changed:
            changes = [f"its {name} was {before[name]} and is {now[name]}" for name in changed]
            raise self._replaced(", ".join(changes))

    def _replaced(self, changes: str) -> ShardError:
        return ShardError(
            f"{self._where}: was replaced in its store while it was read: {changes}. What was read "
            f"before is of the old file: open the data again, with the index that was made with "
            f"the new one."
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, which opens its own file system."""
        return self.__dict__ | {"_opened": None, "_file": None}

    def _call(self, attempt: Attempt, operation: Callable[[Any, str], _T]) -> _T:
        """Return an operation's result, given this process's file system and the object's path."""
        with self._named_errors():
            if self._opened is None or self._opened[0] != os.getpid():
                import fsspec.core

                files, path = fsspec.core.url_to_fs(self._url)
                if self._url.partition("://")[0] == "hf":
                    path = _within(attempt, lambda: _pinned(files, path))
                self._opened, self._file = (os.getpid(), files, path), None
            _, opened, place = self._opened
            return _within(attempt, lambda: operation(opened, place))

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Raise errors of file systems as a `TransientError`, or an error that names the cure."""
        try:
            yield
        except (ExtraError, StorageError):
            raise
        except FileNotFoundError:
            raise MissingObject(
                f"{self._where}: does not exist, or is private. {_MISSING}"
            ) from None
        except PermissionError as error:
            raise StorageError(
                f"{self._where}: permission denied ({_reason(error)}). Log in to its store, or ask "
                f"for access."
            ) from None
        except ImportError as error:
            extra = _EXTRAS.get(self._url.partition("://")[0])
            what = f"{self._where}: needs a package that is not installed ({error}). Install it."
            raise (
                missing_extra(self._where, extra, error) if extra else ExtraError(what)
            ) from None
        except ValueError:
            raise StorageError(
                f"{self._where}: not a URL that fsspec can open. Correct it, or fetch the data and "
                f"pass the folder."
            ) from None
        except network_errors() as error:
            if type(error).__name__ == "FileExpired":  # s3fs: the ETag has changed
                raise self._replaced(f"{error.args[-1]!s:.120}") from None
            if _status(error) in _REFUSED:
                raise StorageError(f"{self._where}: {_reason(error)}. {_MISSING}") from None
            raise TransientError(_reason(error)) from None
        except _loaded(_SETUP_ERRORS) as error:
            raise StorageError(
                f"{self._where}: permission denied ({_reason(error)}). Log in to its store, or set "
                f"up its file system."
            ) from None


def _is_s3(files: Any) -> bool:
    """Return whether a file system is s3fs itself, whose open files are read by their ETag."""
    return type(files).__module__.partition(".")[0] == "s3fs"


_commits: Final[dict[tuple[int, str, str, str, str], str | None]] = {}
"""Commits of the Hub's branches, as this process has resolved them."""


def _pinned(files: Any, path: str) -> str:
    """Return a path of the Hub at the commit that its branch is at now.

    So everything that one process reads is of one commit, whatever is pushed meanwhile.
    """
    found = files.resolve_path(path)
    revision = getattr(found, "revision", None)
    if revision is None or _COMMIT.fullmatch(revision):
        return path
    endpoint = str(getattr(files, "endpoint", ""))
    key = (os.getpid(), endpoint, found.repo_type, found.repo_id, revision)
    if key not in _commits:
        info = files._api.repo_info(found.repo_id, repo_type=found.repo_type, revision=revision)
        _commits[key] = info.sha
    pinned = f"{found.repo_type}s/{found.repo_id}@{_commits[key]}"
    return f"{pinned}/{found.path_in_repo}".rstrip("/") if _commits[key] else path


def _within(attempt: Attempt, call: Callable[[], _T]) -> _T:
    """Return what a call returns, within the time that a read has left.

    File systems limit single waits at best. A call that takes longer is abandoned, in a thread
    that does not keep the process alive.

    Raises:
        TransientError: If it takes longer.
    """
    returned: list[_T] = []
    raised: list[BaseException] = []

    def run() -> None:
        try:
            returned.append(call())
        except BaseException as error:  # noqa: BLE001 - raised again in the thread that waits
            raised.append(error)

    thread = Thread(target=run, daemon=True)
    began_s = attempt.clock()
    thread.start()
    thread.join(attempt.left_s)
    attempt.add(attempt.clock() - began_s, 0)
    if raised:
        raise raised[0]
    if not returned:
        raise TransientError(str(attempt.too_slow()))
    return returned[0]


def _status(error: BaseException) -> int | None:
    """Return the status of the server's response, if the error holds one."""
    return getattr(getattr(error, "response", None), "status_code", None)


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
