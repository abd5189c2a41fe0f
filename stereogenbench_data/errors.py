"""Every error this package raises on purpose.

StereoGenBenchError
├── SchemaError    (ValueError)   a metadata file does not follow the format
├── GeometryError  (ValueError)   a camera, a pose or a map that no formula holds for
├── MediaError     (ValueError)   a video or a depth map does not decode to what its metadata says
├── StorageError   (OSError)      a folder, a file or an index is missing, unreadable or altered
│   └── ShardError                a shard is missing, cut short or altered
├── SelectionError (LookupError)  a filter, a pair or a window that no sample can satisfy
├── FieldError     (ValueError)   fields or transforms that cannot be had together
├── StateError     (ValueError)   a saved position of other samples or of another order
├── SynthesisError (ValueError)   a scene that cannot be drawn as asked
├── DescriptorError (ValueError)  a Croissant descriptor or dataset card that does not fit its data
├── EvaluationError (ValueError)  predictions, metrics or a protocol that cannot be scored
└── ExtraError     (ImportError)  an optional dependency or its weights are not installed

Each takes one message: so a DataLoader worker's error is rebuilt as itself in the main process.

What to do about an error of the operating system follows from its number, wherever it is met: see
`cure_of`.
"""

import errno
from typing import Final

_CURES: Final = {
    errno.ENOSPC: "Make room, or choose another place.",
    errno.EDQUOT: "Make room, or choose another place.",
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


def cure_of(error: OSError, otherwise: str = "") -> str:
    """Return what to do about an error of the operating system.

    Where its number tells the cause (a full disk, too many open files, no permission), the cure
    belongs to that; for any other number it is what the caller says.

    >>> cure_of(OSError(errno.ENOENT, "No such file or directory"), "Fetch it again.")
    'Fetch it again.'
    """
    return _CURES.get(error.errno or 0, otherwise)


class StereoGenBenchError(Exception):
    """The base of every error that this package raises on purpose."""


class SchemaError(StereoGenBenchError, ValueError):
    """A metadata file does not follow the release's format."""


class GeometryError(StereoGenBenchError, ValueError):
    """A camera, a pose or a map that no formula holds for."""


class MediaError(StereoGenBenchError, ValueError):
    """A video or a depth map does not decode to what its metadata says."""


class StorageError(StereoGenBenchError, OSError):
    """A folder, a file or an index is missing, unreadable or altered."""


class ShardError(StorageError):
    """A shard is missing, cut short or altered, or cannot be packed."""


class SelectionError(StereoGenBenchError, LookupError):
    """A filter, a pair or a window that no sample can satisfy."""


class FieldError(StereoGenBenchError, ValueError):
    """Fields or transforms that cannot be had together."""


class StateError(StereoGenBenchError, ValueError):
    """A saved position that belongs to other samples, or to another order of them."""


class SynthesisError(StereoGenBenchError, ValueError):
    """A scene that cannot be drawn as asked."""


class DescriptorError(StereoGenBenchError, ValueError):
    """A Croissant descriptor or a dataset card that does not fit its data."""


class EvaluationError(StereoGenBenchError, ValueError):
    """Predictions, metrics or a protocol that cannot be scored as asked."""


class ExtraError(StereoGenBenchError, ImportError):
    """A feature's optional dependency, or the weights it needs, are not installed."""
