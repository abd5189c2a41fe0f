"""Ranges through fsspec's file systems: the Hub's own for ``hf://``, s3fs for ``s3://``, others.

Errors do not chain those of the file systems: their messages may hold signed URLs.
"""

import os
import re
import sys
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from threading import Thread
from typing import Any, Final, TypeVar

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.retry import Attempt, TooSlow, TransientError

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
"""What file systems raise; a module that was not imported raised nothing."""

_CHANGE_MARKS: Final = ("ETag", "etag", "LastModified", "last_modified", "mtime", "size")
"""What file systems state of a file that changes with it."""

_COMMIT: Final = re.compile(r"[0-9a-f]{40}")

_SETUP_ERRORS: Final = (("botocore.exceptions", "BotoCoreError"),)
"""What file systems raise where they are not set up: without a login, for example."""


class MissingObject(StorageError):
    """What a URL names is not there."""


class FilesystemTransport:
    """One object of whatever fsspec opens. Logins are the file system's own business."""

    def __init__(self, url: str) -> None:
        """Name an object; how long silence may last, the file system decides."""
        self._url = url
        self._where = shown(url)
        self._opened: tuple[int, Any, str] | None = None
        self._file: Any = None
        self._seen: dict[str, dict[str, str]] = {}

    def size(self, attempt: Attempt) -> int:
        """Return how many bytes the object has."""
        with self._named_errors():
            files, path = self._filesystem(attempt)
            if _is_s3(files):
                return int(self._conditional(attempt).size)
            size = _within(attempt, lambda: files.size(path))
        if not isinstance(size, int):
            raise StorageError(f"{self._where}: has no size ({size!r}): is it a folder?")
        return size

    def entries(self, attempt: Attempt) -> dict[str, int | None]:
        """Return what a folder holds: names, with the size of a file and None for a folder."""
        with self._named_errors():
            files, path = self._filesystem(attempt)
            listed = _within(attempt, lambda: files.ls(path, detail=True))
        names = [str(entry["name"]).rstrip("/").rpartition("/")[2] for entry in listed]
        sizes = [
            None if entry["type"] == "directory" else int(entry["size"] or 0) for entry in listed
        ]
        own = path.rstrip("/").rpartition("/")[2]
        return {
            name: size
            for name, size, entry in zip(names, sizes, listed, strict=True)
            if name and (name != own or str(entry["name"]).strip("/") != path.strip("/"))
        }

    def part(self, start: int, stop: int, attempt: Attempt) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop."""
        for first in range(start, stop, _CHUNK):
            last = min(first + _CHUNK, stop)
            with self._named_errors():
                data = self._read(first, last, attempt)
            yield data
            if len(data) != last - first:
                return

    def _read(self, first: int, last: int, attempt: Attempt) -> bytes:
        files, path = self._filesystem(attempt)
        if _is_s3(files):
            file = self._conditional(attempt)
            return bytes(_within(attempt, lambda: file._fetch_range(first, last)))
        if files.async_impl:
            return bytes(_within(attempt, lambda: files.cat_file(path, start=first, end=last)))

        def read() -> tuple[bytes, Any]:
            # Without a cache, or fsspec would read megabytes ahead.
            with files.open(path, "rb", cache_type="none") as file:
                file.seek(first)
                return file.read(last - first), getattr(file, "details", None)

        data, details = _within(attempt, read)
        self._require_same(details)
        return data

    def _conditional(self, attempt: Attempt) -> Any:
        """Return an object of S3, opened once: it is read only while its ETag is the same."""
        files, path = self._filesystem(attempt)
        if self._file is None:
            # What was listed before may be of an older object.
            files.invalidate_cache(path)
            self._file = _within(attempt, lambda: files.open(path, "rb", cache_type="none"))
        return self._file

    def _require_same(self, details: Any) -> None:
        """Refuse a file that is not the one that was read from before, as far as it tells."""
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

    def _filesystem(self, attempt: Attempt) -> tuple[Any, str]:
        """Return this process's file system, and the object's path in it."""
        if self._opened is None or self._opened[0] != os.getpid():
            import fsspec.core

            files, path = fsspec.core.url_to_fs(self._url)
            if self._url.partition("://")[0] == "hf":
                path = _within(attempt, lambda: _pinned(files, path))
            self._opened, self._file = (os.getpid(), files, path), None
        return self._opened[1:]

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs; it opens its own file system."""
        return self.__dict__ | {"_opened": None, "_file": None}

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Turn what file systems raise into a `TransientError`, or an error that says the cure."""
        try:
            yield
        except StorageError:
            raise
        except FileNotFoundError:
            raise MissingObject(
                f"{self._where}: does not exist, or is private. {_MISSING}"
            ) from None
        except PermissionError as error:
            raise StorageError(
                f"{self._where}: may not be read ({_reason(error)}). Log in to its store, or ask "
                f"for access."
            ) from None
        except ImportError as error:
            raise StorageError(self._uninstalled(error)) from None
        except ValueError:
            raise StorageError(
                f"{self._where}: is no URL that fsspec can open. Correct it, or fetch the data and "
                f"pass the folder."
            ) from None
        except network_errors() as error:
            raise self._failure(error) from None
        except _loaded(_SETUP_ERRORS) as error:
            raise StorageError(
                f"{self._where}: may not be read ({_reason(error)}). Log in to its store, or set "
                f"up its file system."
            ) from None

    def _failure(self, error: BaseException) -> TransientError | StorageError:
        """Return what is raised where a store was reached, or a network was not."""
        if isinstance(error, TooSlow):
            return TransientError(str(error))
        if type(error).__name__ == "FileExpired":  # s3fs: the ETag is another
            return self._replaced(f"{error.args[-1]!s:.120}")
        if _status(error) in _REFUSED:
            return StorageError(f"{self._where}: {_reason(error)}. {_MISSING}")
        return TransientError(_reason(error))

    def _uninstalled(self, error: ImportError) -> str:
        scheme = self._url.partition("://")[0]
        extra = _EXTRAS.get(scheme)
        cure = f"pip install 'stereogenbench-data[{extra}]'" if extra else "install it"
        return f"{self._where}: needs a package that is not installed ({error}): {cure}."


def _is_s3(files: Any) -> bool:
    """Return whether a file system is s3fs itself, whose open files are read by their ETag."""
    return type(files).__module__.partition(".")[0] == "s3fs"


def _pinned(files: Any, path: str) -> str:
    """Return a path of the Hub at the commit that its branch is at now.

    So what one process reads of a file is of one commit, whatever is pushed meanwhile.
    """
    found = files.resolve_path(path)
    revision = getattr(found, "revision", None)
    if revision is None or _COMMIT.fullmatch(revision):
        return path
    key = (
        os.getpid(),
        str(getattr(files, "endpoint", "")),
        found.repo_type,
        found.repo_id,
        revision,
    )
    if key not in _commits:
        info = files._api.repo_info(found.repo_id, repo_type=found.repo_type, revision=revision)
        _commits[key] = info.sha
    pinned = f"{found.repo_type}s/{found.repo_id}@{_commits[key]}"
    return f"{pinned}/{found.path_in_repo}".rstrip("/") if _commits[key] else path


_commits: Final[dict[tuple[int, str, str, str, str], str | None]] = {}
"""Commits of the Hub's branches, as this process has resolved them."""


def _within(attempt: Attempt, call: Callable[[], _T]) -> _T:
    """Return what a call returns, in the time that a read has left.

    File systems bound single waits at best. A call that takes longer is left to itself, in a thread
    that no process waits for when it ends.

    Raises:
        TooSlow: If it takes longer.
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
        raise attempt.too_slow()
    return returned[0]


def _status(error: BaseException) -> int | None:
    """Return the server's answer, where the error is one."""
    return getattr(getattr(error, "response", None), "status_code", None)


def _reason(error: BaseException) -> str:
    """Return what happened without any URL, which may hold secrets."""
    if _status(error) is not None:
        return f"the server answers {_status(error)}"
    text = error.strerror if isinstance(error, OSError) else None
    return f"{type(error).__name__}: {text}" if text and "://" not in text else type(error).__name__


def network_errors() -> tuple[type[BaseException], ...]:
    """Return what file systems and the Hub's client raise where a server cannot be reached."""
    return _loaded(_NETWORK_ERRORS)


def _loaded(kinds: tuple[tuple[str, str], ...]) -> tuple[type[BaseException], ...]:
    found = (getattr(sys.modules.get(module), name, None) for module, name in kinds)
    return tuple(kind for kind in found if kind is not None)
