"""Where data are: a path on this machine or a URL, and how a URL is joined and shown."""

from pathlib import Path
from typing import Final
from urllib.parse import quote, unquote, urlsplit, urlunsplit

WEB_SCHEMES: Final = ("http", "https")


def is_remote(location: str | Path) -> bool:
    """Return whether a location is a URL of something that is not a file of this machine."""
    return "://" in str(location) and not str(location).startswith("file://")


def local_path(location: str | Path) -> Path:
    """Return a local location as an absolute path, ``~`` expanded; a ``file://`` URL is one too."""
    text = str(location)
    if text.startswith("file://"):
        return Path(unquote(urlsplit(text).path))
    return Path(location).expanduser().absolute()


def joined(root: str, path: str) -> str:
    """Return the URL of a path below a root.

    What follows the root's path stays behind the whole: a query, as of a signed URL, or the
    archive that a chain of file systems opens (``zip://folder::s3://bucket/all.zip``).
    """
    if urlsplit(root).scheme in WEB_SCHEMES:
        parts = urlsplit(root)
        return urlunsplit(parts._replace(path=f"{parts.path.rstrip('/')}/{quote(path)}"))
    first, chain, rest = root.partition("::")
    return f"{first.rstrip('/')}/{path}{chain}{rest}"


def split_name(url: str) -> tuple[str, str]:
    """Return the URL of the folder that holds a URL's last part, and this part."""
    parts = urlsplit(url)
    folder, _, name = parts.path.rpartition("/")
    return urlunsplit(parts._replace(path=folder)), unquote(name)


def shown(location: str) -> str:
    """Return a location as messages may show it: a URL without user, password, query, fragment."""
    if not is_remote(location):
        return location
    parts = urlsplit(location)
    host = parts.netloc.rpartition("@")[2] if parts.scheme in WEB_SCHEMES else parts.netloc
    return f"{parts.scheme}://{host}{parts.path}"
