"""Every error this package raises on purpose.

StereoGenBenchError
├── SchemaError    (ValueError)   a metadata file does not follow the format
├── GeometryError  (ValueError)   a camera, pose or map that geometry cannot handle
├── MediaError     (ValueError)   a video or a depth map does not decode to what its metadata says
├── StorageError   (OSError)      a folder, a file or an index is missing, unreadable or altered
│   └── ShardError                a shard is missing, cut short or altered
├── SelectionError (LookupError)  a filter, a pair or a window that no sample can satisfy
├── FieldError     (ValueError)   fields or transforms that cannot be combined
├── StateError     (ValueError)   a saved position of other samples or of another order
├── PassError      (RuntimeError) a pass over a loader that cannot continue
│   └── WorkerError               a worker process died in the middle of a pass
├── SynthesisError (ValueError)   a scene that cannot be drawn as asked
├── DescriptorError (ValueError)  a Croissant descriptor or dataset card that does not fit its data
├── EvaluationError (ValueError)  predictions, metrics or a protocol that cannot be scored
│   └── PredictionError           a predicted right view is missing or invalid
└── ExtraError     (ImportError)  an optional dependency or its weights are not installed

Warnings, each a `UserWarning`, stand beside the code that gives them:

StaleIndexWarning        index.table          a folder differs from its index
IncompleteSceneWarning   index.table          some scenes of the data cannot be used
AssumptionWarning        index.table          files are not as the paper prints them
OddSceneWarning          samples.fields       selected scenes differ from what the release promises
SwappedSizeWarning       samples.fields       a size looks like (width, height)
OpenVideosWarning        datasets.division    more videos are needed than may be open
RepeatedDecodingWarning  datasets.division    several processes decode the same videos
IdleWorkersWarning       datasets.division    a loader has more workers than open scenes
FewerPairsWarning        selection.filters    the data hold some cameras alone
MixedSplitsWarning       datasets.mapped      train and eval scenes come together
UnsharedRanksWarning     datasets.division    several ranks read all batches each
RepeatedEpochWarning     datasets.shared      a pass repeats the random frames of another

Each error takes one message, so the error of a DataLoader worker is raised again as the same class
in the main process. Messages show URLs without logins and queries.

An `OSError` has one cure, wherever it occurs: `cure_of` looks it up by its number,
`describe_os_error` makes the message, and `explain_os_errors` raises ours instead.
"""

import errno
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_CHAIN: Final = re.compile(
    r"::(?=(?:[\w+.-]++::){0,9}[A-Za-z][\w+.-]*+://|/|data:|[\w+.-]*+$)", re.ASCII
)
"""Where a chain of file systems continues; colons of IPv6 addresses and passwords do not match."""
_IN_TEXT: Final = re.compile(
    r"(?<![\w+.-])(?<![\w+.-]::)(?:[\w+.-]++(?:::(?=[\w+.-]))?)++://[^\s'\"<>]+", re.ASCII
)
"""A URL or a chain of them. Each run of letters is tried once, from its start, so that the time
of a search grows with the text and not with its square."""
_AS_PATH: Final = re.compile(
    r"\b(https?|s3a?|hf|ftps?|sftp|ssh|smb|gs|gcs|az|abfss?|webhdfs):/(?!/)([^\s'\"]+)"
)
"""A URL that was taken for a path, which has one slash."""
_OURS_OR_TORCH: Final = frozenset({__name__.partition(".")[0], "torch"})
_LOGIN_IN_PATH: Final = re.compile(r"(?<=/)[^/@:]*:[^/@]*@")
_AUTHORITY_END: Final = re.compile(r"[/\\?#]")
_PORT: Final = re.compile(r"[^:]*(?::[0-9]*)?|\[.*", re.ASCII)


def url_without_secrets(url: str) -> str:
    """Return a URL, or a chain of them, without logins, queries and fragments; it never fails.

    >>> url_without_secrets("zip://a::https://me:word@host/all.zip?token=1")
    'zip://a::https://host/all.zip'
    """
    return "::".join(map(_link_without_secrets, _CHAIN.split(url)))


def _link_without_secrets(link: str) -> str:
    scheme, separator, rest = link.partition("://")
    if not separator:
        return link if len(link) < 64 or not link.startswith("data:") else "data:..."
    if scheme.lower() == "file":
        return link
    authority = _AUTHORITY_END.split(rest, maxsplit=1)[0]
    login, _, host = authority.rpartition("@")
    if not login and "@" in rest and not _PORT.fullmatch(authority):
        # The password holds a slash, a question mark or a hash.
        return _link_without_secrets(f"{scheme}://{rest.rpartition('@')[2]}")
    if scheme.lower() == "hf" and ":" not in login:
        host = authority  # On the Hub, a revision follows the @.
    path = re.split(r"[?#]", rest[len(authority) :], maxsplit=1)[0]
    return f"{scheme}://{host}{_LOGIN_IN_PATH.sub('', path)}"


def text_without_secrets(text: str) -> str:
    """Return a text in which each URL is without login, query and fragment.

    A colon behind a URL gets a space before it, so that nobody copies it with the URL.

    >>> text_without_secrets("https://me:word@host/a.tar: does not exist")
    'https://host/a.tar : does not exist'
    """
    whole = _IN_TEXT.sub(_shown_in_text, text)
    return _AS_PATH.sub(
        lambda found: url_without_secrets(f"{found[1]}://{found[2]}").replace("://", ":/", 1), whole
    )


def _shown_in_text(found: re.Match[str]) -> str:
    url = url_without_secrets(found[0])
    is_before_text = found.string.startswith(" ", found.end())
    return f"{url[:-1]} :" if url.endswith(":") and is_before_text else url


_CURES: Final = {
    errno.ENOSPC: "Make room, or choose another place.",
    errno.EDQUOT: "Make room, or choose another place.",
    errno.ENAMETOOLONG: "Choose a shorter name.",
    errno.EFBIG: "Choose a place that takes files of this size.",
    errno.EROFS: "Choose a place that can be written.",
    errno.EMFILE: "Raise the limit of open files (`ulimit -n`), or use fewer workers.",
    errno.ENFILE: "All processes of this machine have too many files open: end some of them, or "
    "raise `fs.file-max`.",
    errno.ENOMEM: "Memory is short: use fewer workers.",
    errno.EACCES: "Give permission, or choose another place.",
    errno.EPERM: "Give permission, or choose another place.",
    errno.EIO: "Check the disk or the network drive: the system cannot read or write there.",
    errno.ESTALE: "The network drive was mounted anew or the file replaced: run it again.",
    errno.ELOOP: "Links lead in a circle: remove them.",
}

DISK_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Numbers of errors that mean a full disk or quota."""

NOT_WRITABLE: Final = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
"""Numbers of errors that mean a read-only place."""


def describe_os_error(what: str, error: OSError, otherwise: str = "") -> str:
    """Return one message: what failed, the system's reason, and the cure as `cure_of` gives it.

    >>> full = OSError(errno.ENOSPC, "No space left on device")
    >>> describe_os_error("a.tar: cannot be written", full, "Choose another folder.")
    'a.tar: cannot be written (No space left on device). Make room, or choose another place.'
    """
    return f"{what} ({error.strerror or error}). {cure_of(error, otherwise)}".rstrip()


def cure_of(error: OSError, otherwise: str = "") -> str:
    """Return what to do about an error of the operating system.

    Its number decides where it tells the cause (a full disk, too many open files, no permission);
    else the caller does.

    >>> cure_of(OSError(errno.ENOENT, "No such file or directory"), "Fetch it again.")
    'Fetch it again.'
    """
    return _CURES.get(error.errno or 0, otherwise)


class StereoGenBenchError(Exception):
    """The base of every error that this package raises on purpose."""

    def __init__(self, message: str = "") -> None:
        """Take a message; secrets are removed from the URLs in it."""
        super().__init__(text_without_secrets(str(message)))


class SchemaError(StereoGenBenchError, ValueError):
    """A metadata file does not follow the release's format."""


class GeometryError(StereoGenBenchError, ValueError):
    """A camera, pose or map that geometry cannot handle."""


class MediaError(StereoGenBenchError, ValueError):
    """A video or a depth map does not decode to what its metadata says."""


class StorageError(StereoGenBenchError, OSError):
    """A folder, a file or an index is missing, unreadable or altered."""


class ShardError(StorageError):
    """A shard is missing, cut short or altered, or cannot be packed."""


class SelectionError(StereoGenBenchError, LookupError):
    """A filter, a pair or a window that no sample can satisfy."""


class FieldError(StereoGenBenchError, ValueError):
    """Fields or transforms that cannot be combined."""


class StateError(StereoGenBenchError, ValueError):
    """A saved position that belongs to other samples, or to another order of them."""


class PassError(StereoGenBenchError, RuntimeError):
    """A pass over a loader or a stream that cannot continue without giving wrong batches."""


class WorkerError(PassError):
    """A worker process died in the middle of a pass."""


class SynthesisError(StereoGenBenchError, ValueError):
    """A scene that cannot be drawn as asked."""


class DescriptorError(StereoGenBenchError, ValueError):
    """A Croissant descriptor or a dataset card that does not fit its data."""


class EvaluationError(StereoGenBenchError, ValueError):
    """Predictions, metrics or a protocol that cannot be scored as asked."""


class PredictionError(EvaluationError):
    """A predicted right view is missing or invalid."""


class ExtraError(StereoGenBenchError, ImportError):
    """A feature's optional dependency, or the weights it needs, are not installed."""


def missing_extra(what: str, extra: str, error: ImportError | str) -> ExtraError:
    """Return the error of a feature whose extra is not installed.

    Args:
        what: The feature, such as "plots".
        extra: The extra of this package that has what the feature needs.
        error: What cannot be imported.
    """
    return ExtraError(
        f"{what}: the extra {extra!r} is not installed ({error}). Run "
        f"`pip install 'stereogenbench-data[{extra}]'`."
    )


@contextmanager
def needs_extra(what: str, extra: str) -> Iterator[None]:
    """Raise an `ImportError` of the block as `missing_extra` of a feature."""
    try:
        yield
    except ImportError as error:
        raise missing_extra(what, extra, error) from error


@contextmanager
def explain_os_errors(
    what: str, otherwise: str = "", *, kind: type[StereoGenBenchError] = StorageError
) -> Iterator[None]:
    """Raise an `OSError` of the block as ours, in the words of `describe_os_error`."""
    try:
        yield
    except StereoGenBenchError:
        raise
    except OSError as error:
        raise kind(describe_os_error(what, error, otherwise)) from error


def users_level() -> int:
    """Return the stack level of a caller's warning that is neither this package's nor torch's."""
    frame, level = sys._getframe(1), 1
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _OURS_OR_TORCH:
        frame, level = frame.f_back, level + 1
    return level
