"""Train and evaluate on StereoGenBench: every stereo pair of six-camera scenes, right to the pixel.

Names are imported when first used, so that what does not need torch starts without it. Not even
`typing` is imported at first: the command takes care of Ctrl-C only after this module.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from stereogenbench_data.datasets.adapters import to_raft_stereo, to_torchvision
    from stereogenbench_data.datasets.batches import EpochBatches
    from stereogenbench_data.datasets.loader import PairsLoader
    from stereogenbench_data.datasets.mapped import SceneViews, StereoPairs
    from stereogenbench_data.datasets.streamed import StereoPairStream
    from stereogenbench_data.datasets.tensors import collate
    from stereogenbench_data.errors import (
        DescriptorError,
        EvaluationError,
        ExtraError,
        FieldError,
        GeometryError,
        MediaError,
        PassError,
        SchemaError,
        SelectionError,
        StateError,
        StereoGenBenchError,
        StorageError,
        SynthesisError,
        WorkerError,
    )
    from stereogenbench_data.evaluation.controls import score_controls
    from stereogenbench_data.evaluation.evaluate import evaluate
    from stereogenbench_data.evaluation.inputs import export_inputs
    from stereogenbench_data.evaluation.protocol import EvaluationProtocol
    from stereogenbench_data.evaluation.report import write_report
    from stereogenbench_data.evaluation.tables import tables_of
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.samples.fields import PAIR_FIELDS, VIEW_FIELDS
    from stereogenbench_data.samples.transforms import (
        ColorJitter,
        Compose,
        Crop,
        Eraser,
        HorizontalFlip,
        Letterbox,
        RandomCrop,
        RandomScale,
        Resize,
    )
    from stereogenbench_data.schema.records import DepthEncoding
    from stereogenbench_data.selection.order import order_quality
    from stereogenbench_data.sources.cache import ShardCache
    from stereogenbench_data.sources.retry import RetryPolicy

_HOMES = {
    "datasets.adapters": ("to_raft_stereo", "to_torchvision"),
    "datasets.batches": ("EpochBatches",),
    "datasets.loader": ("PairsLoader",),
    "datasets.mapped": ("SceneViews", "StereoPairs"),
    "datasets.streamed": ("StereoPairStream",),
    "datasets.tensors": ("collate",),
    "errors": (
        "DescriptorError",
        "EvaluationError",
        "ExtraError",
        "FieldError",
        "GeometryError",
        "MediaError",
        "PassError",
        "PassError",
        "SchemaError",
        "SelectionError",
        "StateError",
        "StereoGenBenchError",
        "StorageError",
        "SynthesisError",
        "WorkerError",
    ),
    "evaluation.controls": ("score_controls",),
    "evaluation.evaluate": ("evaluate",),
    "evaluation.inputs": ("export_inputs",),
    "evaluation.protocol": ("EvaluationProtocol",),
    "evaluation.report": ("write_report",),
    "evaluation.tables": ("tables_of",),
    "samples.fields": ("PAIR_FIELDS", "VIEW_FIELDS"),
    "samples.transforms": (
        "ColorJitter",
        "Compose",
        "Crop",
        "Eraser",
        "HorizontalFlip",
        "Letterbox",
        "RandomCrop",
        "RandomScale",
        "Resize",
    ),
    "schema.records": ("DepthEncoding",),
    "selection.order": ("order_quality",),
    "sources.cache": ("ShardCache",),
    "index.table": ("SceneIndex",),
    "sources.retry": ("RetryPolicy",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "PAIR_FIELDS",
    "VIEW_FIELDS",
    "ColorJitter",
    "Compose",
    "Crop",
    "DepthEncoding",
    "DescriptorError",
    "EpochBatches",
    "Eraser",
    "EvaluationError",
    "EvaluationProtocol",
    "ExtraError",
    "FieldError",
    "GeometryError",
    "HorizontalFlip",
    "Letterbox",
    "MediaError",
    "PairsLoader",
    "PassError",
    "RandomCrop",
    "RandomScale",
    "Resize",
    "RetryPolicy",
    "SceneIndex",
    "SceneViews",
    "SchemaError",
    "SelectionError",
    "ShardCache",
    "StateError",
    "StereoGenBenchError",
    "StereoPairStream",
    "StereoPairs",
    "StorageError",
    "SynthesisError",
    "WorkerError",
    "collate",
    "evaluate",
    "export_inputs",
    "order_quality",
    "score_controls",
    "tables_of",
    "to_raft_stereo",
    "to_torchvision",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Import a public name from the module that holds it."""
    if name == "__version__":
        from importlib.metadata import version

        return version("stereogenbench-data")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*__all__, "__version__"])
