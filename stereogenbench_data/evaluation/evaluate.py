"""Scoring a method by the paper's protocol: what it wrote, or what it returns when it is called."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypedDict, Unpack

from stereogenbench_data.datasets.mapped import Data, StereoPairs
from stereogenbench_data.engine import LOCAL, Engine
from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.aggregate import Labels, PairMeans, Scores, grouped, tally
from stereogenbench_data.evaluation.columns import IMAGE_DISTANCES, VIDEO_DISTANCES
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance, Spread, frechet_distance
from stereogenbench_data.evaluation.partial import PartialResults
from stereogenbench_data.evaluation.predictions import (
    CalledMethod,
    Candidate,
    Method,
    PredictionFolder,
)
from stereogenbench_data.evaluation.protocol import EvaluationProtocol, tools_of
from stereogenbench_data.evaluation.running import (
    Extent,
    Progress,
    Run,
    extent_of,
    no_progress,
    score_all,
)
from stereogenbench_data.evaluation.tiers import require_tier
from stereogenbench_data.selection.plan import Selection

_BRANCH: Final = ("subset", "family")


class RunOptions(TypedDict, total=False):
    """How an evaluation is run; none of it changes a score.

    Attributes:
        out: A folder that keeps partial results, so that a stopped evaluation goes on; without
            it they are lost.
        workers: How many processes score scenes, None for one a core. A callable is called, and
            its right views scored, in this process.
        engine: Where scenes are scored, `engine.LOCAL` or an `engine.RayCluster`; a callable
            stays in this process.
        allow_missing: How many right views of pairs may be missing or unusable; they are counted
            in the tables. 0 makes the first an error.
        progress: Called with (frames done, frames in all).
    """

    out: str | Path | None
    workers: int | None
    engine: Engine
    allow_missing: int
    progress: Progress


class EvaluationOptions(RunOptions, Selection, total=False):
    """How an evaluation is run, and which scenes, pairs and frames it is of.

    ``pairs`` is "primary" unless given, ``frames`` "all".
    """


def evaluate(
    data: Data,
    predictions: str | Path | Method,
    *,
    tier: str,
    name: str | None = None,
    protocol: EvaluationProtocol | None = None,
    **options: Unpack[EvaluationOptions],
) -> Scores:
    """Return a method's scores.

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
    candidate: Candidate
    workers, engine = options.get("workers"), options.get("engine", LOCAL)
    if callable(predictions):
        called = name or str(getattr(predictions, "__name__", type(predictions).__name__))
        candidate = CalledMethod(called, predictions, known)
        workers, engine = 1, LOCAL
    else:
        root = Path(predictions)
        if not root.is_dir():
            raise EvaluationError(f"{root}: is no folder of predictions.")
        candidate = PredictionFolder(name or root.resolve().name, root.resolve())
    extent = selected(data, protocol, inputs=candidate.inputs, options=options)
    run = Run(
        protocol=protocol,
        candidates=(candidate,),
        allow_missing=options.get("allow_missing", 0),
        workers=workers,
        engine=engine,
    )
    (scores,) = scored(extent, run, options=options, tier=known.name)
    return scores


def selected(
    data: Data,
    protocol: EvaluationProtocol,
    *,
    inputs: Sequence[str],
    options: Mapping[str, Any],
) -> Extent:
    """Return what is to be scored, once it is known that its data can be read.

    Raises:
        SelectionError: If nothing matches.
        MediaError: If depth that a metric needs cannot have been stored whole.
    """
    selection: dict[str, Any] = {
        key: value for key, value in options.items() if key not in RunOptions.__optional_keys__
    }
    selection.setdefault("frames", "all")
    pairs = StereoPairs(
        data,
        fields=tuple(dict.fromkeys((*protocol.fields, *inputs))),
        size=protocol.size,
        depth=protocol.depth,
        **selection,
    )
    return extent_of(pairs, size=protocol.size)


def scored(
    extent: Extent,
    run: Run,
    *,
    options: RunOptions | EvaluationOptions,
    tier: str,
    about: Mapping[str, Any] | None = None,
) -> list[Scores]:
    """Return the scores of every candidate, from partial results where there are.

    Args:
        extent: What is scored.
        run: How, and whose right views.
        options: Where partial results are kept, and who is told of progress.
        tier: What the candidates were given.
        about: What else the scores depend on, as plain values.

    Raises:
        EvaluationError: As `evaluate`.
    """
    try:
        return _scored(extent, run, options=options, tier=tier, about=about or {})
    finally:
        tools_of.cache_clear()


def _scored(
    extent: Extent,
    run: Run,
    *,
    options: RunOptions | EvaluationOptions,
    tier: str,
    about: Mapping[str, Any],
) -> list[Scores]:
    settings = tools_of(run.protocol).settings()
    state = {
        "tier": tier,
        "methods": [candidate.name for candidate in run.candidates],
        "data": extent.index.digest,
        "frames": sorted({each.frames for pairs in extent.wanted for each in pairs}),
        "pairs": sorted({each.pair for pairs in extent.wanted for each in pairs}),
        "settings": settings,
        **_places(run.candidates),
        **about,
    }
    with _kept(options.get("out")) as folder:
        partial = PartialResults(folder, settings=state)
        score_all(extent, run, partial=partial, progress=options.get("progress", no_progress))
        results = []
        for candidate in run.candidates:
            pairs = tuple(_means(extent, partial, candidate.name))
            results.append(
                Scores(
                    name=candidate.name,
                    tier=tier,
                    protocol=run.protocol,
                    settings=settings,
                    index=extent.index,
                    pairs=pairs,
                    distances=_distances(extent, partial, candidate.name, pairs, run.protocol),
                )
            )
    return results


def _places(candidates: Sequence[Candidate]) -> dict[str, list[str]]:
    """Return where predictions are, as plain values."""
    folders = [str(each.root) for each in candidates if isinstance(each, PredictionFolder)]
    return {"predictions": folders} if folders else {}


@contextmanager
def _kept(out: str | Path | None) -> Iterator[Path]:
    """Give the folder of partial results, a passing one where none is named."""
    if out is not None:
        yield Path(out)
        return
    with tempfile.TemporaryDirectory(prefix="stereogenbench-") as folder:
        yield Path(folder)


def _means(extent: Extent, partial: PartialResults, name: str) -> Iterator[PairMeans]:
    """Yield the averages of every pair; one scene's frames are in memory at a time."""
    for row, wanted in zip(extent.rows, extent.wanted, strict=True):
        scene = extent.index.scene(row)
        found = partial.read(scene.id.key, [(name, each.pair) for each in wanted])
        for each in wanted:
            scores = found[name, each.pair]
            yield PairMeans(
                row=row,
                scene=each.scene,
                pair=each.pair,
                is_primary=each.pair == scene.rig.primary_pair,
                baseline_cm=scene.rig.baseline_cm(*each.pair),
                frames=len(each.frames),
                tallies={column: tally(numbers) for column, numbers in scores.columns.items()},
                fault=scores.fault,
            )


def _distances(
    extent: Extent,
    partial: PartialResults,
    name: str,
    pairs: Sequence[PairMeans],
    protocol: EvaluationProtocol,
) -> dict[Labels, dict[str, FrechetDistance]]:
    """Return the distances between sets of each branch; features are merged scene by scene."""
    metrics = [each for each in protocol.metrics if each in {**IMAGE_DISTANCES, **VIDEO_DISTANCES}]
    if not metrics:
        return {}
    index = extent.index

    def branch_of(pair: PairMeans) -> Labels:
        return tuple(str(index.column(key)[pair.row] or "") for key in _BRANCH)

    scored_pairs = (pair for pair in pairs if pair.is_primary and not pair.fault)
    return {
        labels: _distances_of(group, partial, name, metrics)
        for labels, group in grouped(scored_pairs, branch_of).items()
    }


def _distances_of(
    pairs: Sequence[PairMeans], partial: PartialResults, name: str, metrics: Sequence[str]
) -> dict[str, FrechetDistance]:
    sides: dict[tuple[str, str], Spread] = {}
    for pair in pairs:
        found = partial.read(pair.scene, [(name, pair.pair)])[name, pair.pair]
        for metric in metrics:
            for side, spreads in (("predicted", found.predicted), ("target", found.target)):
                new = spreads[metric]
                before = sides.get((metric, side))
                sides[metric, side] = new if before is None else before.merged(new)
    return {
        metric: frechet_distance(sides[metric, "predicted"], sides[metric, "target"])
        for metric in metrics
    }
