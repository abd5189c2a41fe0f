"""Locations of data, paths or URLs: how they are joined, and how messages show them."""

import os
from pathlib import Path
from typing import Final, Literal
from urllib.parse import SplitResult, quote, unquote, urlsplit, urlunsplit

from stereogenbench_data.errors import StorageError, url_without_secrets
from stereogenbench_data.schema.text import shortened

Depth = Literal["one level", "all levels"]
"""How deep below a folder it is listed."""
Listing = dict[str, tuple[int | None, str]]
"""Path below a folder to size in bytes, None for a folder, and what changes with the content: an
ETag or the Hub's digest, "" if the store has none."""

UNSAFE_PATH: Final = r"^/|\\|:|(?:^|/)\.{0,2}(?:/|$)|[\x00-\x1f]"
"""What a member's path may not hold: a root, a drive, a backslash, an empty part, '.' or '..'."""


def is_remote(location: str | Path) -> bool:
    """Return whether a location is a URL, and not one of a file of this machine."""
    return "://" in str(location) and not _is_file_url(location)


def is_web(location: str) -> bool:
    """Return whether a location is a URL of a web server."""
    return location.lower().startswith(("http://", "https://"))


def local_path(location: str | Path) -> Path:
    """Return a local location as an absolute path; a ``file://`` URL is one too.

    ``~`` and ``~name`` are a home only where no folder or file has that name.

    Raises:
        StorageError: If it is not a path or an empty text, as of a variable that is not set.
    """
    if not isinstance(location, str | os.PathLike):
        raise StorageError(f"{location!r} is not a path: name a folder, a file or a URL.")
    if location == "":
        raise StorageError("the path is empty: name a file or folder, or . for this folder.")
    if _is_file_url(location):
        return Path(unquote(split_url(str(location)).path))
    path = Path(location)
    if not str(location).startswith("~") or Path(path.parts[0]).exists():
        return path.absolute()
    try:
        return path.expanduser().absolute()
    except RuntimeError:
        raise StorageError(f"{path}: there is neither such a folder nor such a user.") from None


def _is_file_url(location: str | Path) -> bool:
    return str(location)[:7].lower() == "file://"


def split_url(url: str) -> SplitResult:
    """Return the parts of a URL.

    Raises:
        StorageError: If it is not a URL, as with half an IPv6 address or, for a web server, a
            port that is not a number.
    """
    try:
        parts = urlsplit(url)
        if is_web(url):
            _ = parts.port
    except ValueError:
        raise StorageError(f"{shown(url)}: not a valid URL: correct it.") from None
    return parts


def joined(root: str, path: str) -> str:
    """Return the URL of a path below a root.

    What follows the root's path stays at the end: the query of a signed URL, or the archive that a
    chain of file systems opens (``zip://folder::s3://bucket/all.zip``).

    Raises:
        StorageError: If the root is not a URL, or the path would make it a chain of file systems.
    """
    if "::" in path:
        raise StorageError(
            f"{shown(root)}: holds {shortened(path)!r}, and a name with '::' in it would open "
            f"another file system. Rename it."
        )
    if is_web(root):
        parts = split_url(root)
        return urlunsplit(parts._replace(path=f"{parts.path.rstrip('/')}/{quote(path)}"))
    first, chain, rest = root.partition("::")
    return f"{first.rstrip('/')}/{path}{chain}{rest}"


def split_name(url: str) -> tuple[str, str]:
    """Return the URL of the folder that holds a URL's last part, and that part.

    Raises:
        StorageError: If it is not a URL.
    """
    parts = split_url(url)
    folder, _, name = parts.path.rpartition("/")
    return urlunsplit(parts._replace(path=folder)), unquote(name)


def shown(location: str | Path) -> str:
    """Return a location as messages and files may show it: URLs without login, query, fragment."""
    text = str(location)
    return url_without_secrets(text) if is_remote(text) else text
