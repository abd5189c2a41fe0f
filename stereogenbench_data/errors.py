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
├── PassError      (RuntimeError) a pass over a loader that cannot go on as it is used
│   └── WorkerError               a worker process died in the middle of a pass
├── SynthesisError (ValueError)   a scene that cannot be drawn as asked
├── DescriptorError (ValueError)  a Croissant descriptor or dataset card that does not fit its data
├── EvaluationError (ValueError)  predictions, metrics or a protocol that cannot be scored
└── ExtraError     (ImportError)  an optional dependency or its weights are not installed

Each takes one message: so a DataLoader worker's error is rebuilt as itself in the main process.
"""


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


class PassError(StereoGenBenchError, RuntimeError):
    """A pass over a loader or a stream that would give wrong batches the way it is used."""


class WorkerError(PassError):
    """A worker process died in the middle of a pass."""


class SynthesisError(StereoGenBenchError, ValueError):
    """A scene that cannot be drawn as asked."""


class DescriptorError(StereoGenBenchError, ValueError):
    """A Croissant descriptor or a dataset card that does not fit its data."""


class EvaluationError(StereoGenBenchError, ValueError):
    """Predictions, metrics or a protocol that cannot be scored as asked."""


class ExtraError(StereoGenBenchError, ImportError):
    """A feature's optional dependency, or the weights it needs, are not installed."""
