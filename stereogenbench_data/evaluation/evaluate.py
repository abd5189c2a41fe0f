"""Score a method by the paper's protocol, from the views it wrote or by calling it."""

from pathlib import Path
from typing import Unpack

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import LOCAL
from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.aggregate import Scores
from stereogenbench_data.evaluation.predictions import (
    CalledMethod,
    Method,
    PredictionFolder,
    PredictionSource,
)
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.evaluation.running import (
    EvaluationOptions,
    Run,
    score_workload,
    select_workload,
)
from stereogenbench_data.evaluation.tiers import require_tier


def evaluate(
    data: Data,
    predictions: str | Path | Method,
    *,
    tier: str,
    name: str | None = None,
    protocol: EvaluationProtocol | None = None,
    **options: Unpack[EvaluationOptions],
) -> Scores:
    """Score a method and return its scores.

    Args:
        data: What `StereoPairs` takes: a folder of scenes or shards, its URL, an index.
        predictions: A folder of right views (see `predictions` for its layout); or a callable
            that is given a dict of tensors, the tier's inputs for some frames of one pair in
            order, and returns their right views, uint8 or floats of 0 to 1, (n, 3, h, w).
        tier: "G0", "G1" or "G2": what the method was given.
        name: What tables call the method; else the folder's or the callable's name.
        protocol: Which metrics and how; the paper's with what needs no weights unless given.
        **options: How it is run (`RunOptions`) and what is scored (`Selection`).

    Raises:
        EvaluationError: If a prediction is missing, or is not what it must be, naming it; if
            ``out`` holds results of other settings or predictions.
        SelectionError: If nothing matches the selection.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    protocol = protocol or EvaluationProtocol()
    known = require_tier(tier)
    source: PredictionSource
    if callable(predictions):
        called = name or str(getattr(predictions, "__name__", type(predictions).__name__))
        source = CalledMethod(called, predictions, known)
        options["workers"], options["engine"] = 1, LOCAL
    else:
        root = Path(predictions)
        if not root.is_dir():
            raise EvaluationError(f"{root}: not a predictions folder.")
        source = PredictionFolder(name or root.resolve().name, root.resolve())
    workload = select_workload(data, protocol, inputs=source.inputs, options=options)
    (scores,) = score_workload(workload, Run(protocol, (source,), known.name), options)
    return scores
