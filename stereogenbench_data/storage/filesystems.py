"""Ranges through fsspec's file systems: the Hub's own for ``hf://``, s3fs for ``s3://``, others.

Errors do not chain those of the file systems: their messages may hold signed URLs.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from stereogenbench_data.errors import StorageError
from stereogenbench_data.storage.location import shown
from stereogenbench_data.storage.retry import Fault

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

_SETUP_ERRORS: Final = (("botocore.exceptions", "BotoCoreError"),)
"""What file systems raise where they are not set up: without a login, for example."""


class MissingObject(StorageError):
    """What a URL names is not there."""


class FilesystemTransport:
    """One object of whatever fsspec opens. Logins are the file system's own business."""

    def __init__(self, url: str, *, timeout_s: float) -> None:
        """Name an object; how long silence may last, the file system decides."""
        del timeout_s
        self._url = url
        self._where = shown(url)
        self._opened: tuple[int, Any, str] | None = None

    def size(self) -> int:
        """Return how many bytes the object has."""
        with self._named_errors():
            files, path = self._filesystem()
            size = files.size(path)
        if not isinstance(size, int):
            raise StorageError(f"{self._where}: has no size ({size!r}): is it a folder?")
        return size

    def entries(self) -> dict[str, int | None]:
        """Return what a folder holds: names, with the size of a file and None for a folder."""
        with self._named_errors():
            files, path = self._filesystem()
            listed = files.ls(path, detail=True)
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

    def part(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from start to stop."""
        for first in range(start, stop, _CHUNK):
            last = min(first + _CHUNK, stop)
            with self._named_errors():
                files, path = self._filesystem()
                if files.async_impl:
                    data = files.cat_file(path, start=first, end=last)
                else:
                    # Without a cache, or fsspec would read megabytes ahead.
                    with files.open(path, "rb", cache_type="none") as file:
                        file.seek(first)
                        data = file.read(last - first)
            yield data
            if len(data) != last - first:
                return

    def _filesystem(self) -> tuple[Any, str]:
        """Return this process's file system, and the object's path in it."""
        if self._opened is None or self._opened[0] != os.getpid():
            import fsspec.core

            self._opened = (os.getpid(), *fsspec.core.url_to_fs(self._url))
        return self._opened[1:]

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Turn what file systems raise into a fault to try again, or an error that says why not."""
        try:
            yield
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
            if _status(error) in _REFUSED:
                raise StorageError(f"{self._where}: {_reason(error)}. {_MISSING}") from None
            raise Fault(_reason(error)) from None
        except _loaded(_SETUP_ERRORS) as error:
            raise StorageError(
                f"{self._where}: may not be read ({_reason(error)}). Log in to its store, or set "
                f"up its file system."
            ) from None

    def _uninstalled(self, error: ImportError) -> str:
        scheme = self._url.partition("://")[0]
        extra = _EXTRAS.get(scheme)
        cure = f"pip install 'stereogenbench-data[{extra}]'" if extra else "install it"
        return f"{self._where}: needs a package that is not installed ({error}): {cure}."


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
