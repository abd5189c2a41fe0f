"""Score a method by the paper's protocol, from the views it wrote or by calling it.

Scenes are scored in parallel processes. Each is kept on disk as soon as it is scored, so that a
stopped evaluation goes on:

    OUT/evaluation.json     all that scores depend on (`jobs`); other settings are refused
    OUT/scenes/<digest>.pt  a scene's scores, with what identified its right views
"""

import hashlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from io import BytesIO
from itertools import product
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Final, Unpack

import torch

from stereogenbench_data.datasets.mapped import Data, StereoPairs, opened
from stereogenbench_data.engine import LOCAL, Advance, ProcessPool
from stereogenbench_data.errors import (
    EvaluationError,
    PredictionError,
    StorageError,
    explain_os_errors,
)
from stereogenbench_data.evaluation.columns import MATCHERS
from stereogenbench_data.evaluation.metrics.frechet import (
    FeatureStatistics,
    FrechetDistance,
    frechet_distance,
)
from stereogenbench_data.evaluation.models.loading import place_of
from stereogenbench_data.evaluation.predictions import (
    CalledMethod,
    Method,
    Pair,
    PairFrames,
    PredictionFolder,
    PredictionSource,
    Size,
)
from stereogenbench_data.evaluation.protocol import (
    DisparityProtocol,
    EvaluationProtocol,
    require_tier,
)
from stereogenbench_data.evaluation.scene_scores import (
    PairScores,
    Run,
    SceneScores,
    ScoredPairs,
    fields_of,
    model_of,
    score_scene,
    settings_of,
)
from stereogenbench_data.evaluation.tables import Labels, PairMeans, Scores, tallies
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import WORK_DEFAULTS, JobKind, WorkOptions, do_items, job_folder
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.filters import may_pass
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import SELECTION_DEFAULTS, Random, Selection
from stereogenbench_data.selection.signatures import list_options
from stereogenbench_data.sources.files import write_atomic

EVALUATION: Final = JobKind("scores", "evaluation.json", ".evaluation.lock", EvaluationError)
FORMAT: Final = 6
"""Of the files of scenes; other formats are refused."""
_PROBLEMS_SHOWN: Final = 2


class RunOptions(WorkOptions, total=False):
    """How an evaluation is run; none of it changes a score.

    Progress is in frames. A callable is called, and its right views scored, in this process. Where
    a protocol's device is not the CPU, this machine works in one process unless ``workers`` says
    otherwise: each process has its own copy of the models there.

    Attributes:
        out: A folder that keeps partial results, so that a stopped evaluation goes on; without
            it they are lost. What a callable computes cannot be seen: ``name`` tells its results
            from those of another, as of another class, parameter or checkpoint.
        allow_missing: How many right views of pairs may be missing or unusable; they are counted
            in the tables. 0 makes the first an error.
    """

    out: str | Path | None
    allow_missing: int


class EvaluationOptions(RunOptions, Selection, total=False):
    """How an evaluation is run, and which scenes, pairs and frames it is of.

    ``pairs`` is "primary" unless given, ``frames`` "all".
    """


EVALUATION_DEFAULTS: Final = {
    **SELECTION_DEFAULTS, **WORK_DEFAULTS, "frames": "all", "out": None, "allow_missing": 0,
}  # fmt: skip


@list_options(EVALUATION_DEFAULTS)
def evaluate(
    data: Data,
    predictions: str | Path | Method,
    *,
    tier: str,
    name: str | None = None,
    protocol: EvaluationProtocol | None = None,
    conventions: str | Path | Conventions | None = None,
    **options: Unpack[EvaluationOptions],
) -> Scores:
    """Score a method and return its scores.

    Args:
        data: What `StereoPairs` takes: a folder of scenes or shards, its URL, an index.
        predictions: A folder of right views (see `predictions` for its layout); or a callable
            that is given a dict of tensors, the tier's inputs for some frames of one pair in
            order, and returns their right views, uint8 or floats of 0 to 1, (n, 3, h, w).
        tier: "G0", "G1" or "G2": what the method was given.
        name: What tables call the method; else the folder's or the callable's name. A callable
            whose results ``out`` keeps must be given one.
        protocol: Which metrics and how; the paper's with what needs no weights unless given.
        conventions: How the files of a folder are read, as for `StereoPairs`.
        **options: How it is run (`RunOptions`) and what is scored (`Selection`).

    Raises:
        EvaluationError: If a prediction is missing, or is not what it must be, naming it; if
            ``out`` holds results of other settings, predictions or names; if ``out`` is to keep
            those of a callable without a name.
        SelectionError: If nothing matches the selection.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    require_options(evaluate, options)
    protocol = protocol or EvaluationProtocol()
    known = require_tier(tier)
    called = partial(CalledMethod, inputs=known.inputs)
    source = source_of(predictions, name, options, called=called, written=PredictionFolder)
    fields = (*fields_of(protocol), *source.inputs)
    index, scenes = select_pairs(data, fields, protocol, options=options, conventions=conventions)
    (scores,) = score_pairs(Run(index, scenes, protocol, (source,), known.name), options)
    return scores


def source_of(
    predictions: str | Path | Method,
    name: str | None,
    options: EvaluationOptions,
    *,
    called: Callable[[str, Method], PredictionSource],
    written: Callable[[str, Path], PredictionSource],
) -> PredictionSource:
    """Return the source of predictions by its name: a callable, which this process calls, or files.

    Args:
        predictions: The callable, or the folder.
        name: What tables call it, if that is stated.
        options: How it is run; of a callable the workers are this process.
        called: Makes the source of a name and a callable.
        written: Makes the source of a name and a folder.

    Raises:
        EvaluationError: If there is no such folder; if the results of a callable are to be kept,
            and nothing tells them from another's.
    """
    if not callable(predictions):
        root = Path(predictions).resolve()
        if not root.is_dir():
            raise EvaluationError(f"{root}: is not a folder. Pass the folder of the predictions.")
        return written(name or root.name, root)
    label = name or str(getattr(predictions, "__name__", type(predictions).__name__))
    if options.get("out") and not name:
        raise EvaluationError(
            f"{options['out']}: is to keep the scores of {label}, and another method may be "
            f"called so, too. Pass name=..., another for each method, parameter and "
            f"checkpoint, so that its scores are found again and no other's."
        )
    options["workers"], options["engine"] = 1, LOCAL
    return called(label, predictions)


def select_pairs(
    data: Data,
    fields: Sequence[str],
    protocol: EvaluationProtocol | DisparityProtocol,
    *,
    options: Mapping[str, Any],
    conventions: str | Path | Conventions | None = None,
) -> tuple[SceneIndex, ScoredPairs]:
    """Return what a selection scores, and its index, after checking that its data can be read.

    Args:
        data: What `StereoPairs` takes.
        fields: The fields of a sample that are needed.
        protocol: At which size they are, and by which depth encoding.
        options: The selection; `RunOptions` among it are ignored.
        conventions: As for `StereoPairs`.

    Raises:
        SelectionError: If nothing matches.
        MediaError: If depth that a metric needs cannot have been stored whole.
        EvaluationError: If the samples are clips, random frames, sweeps or right to left.
        StorageError: If the data were derived for training, whose pictures have an error.
    """
    selection = {name: options[name] for name in options.keys() - RunOptions.__optional_keys__}
    selection.setdefault("frames", "all")
    data = _whole_data(data, selection, conventions)
    # Tables group pairs by their baselines, whatever metrics and inputs need.
    dataset = StereoPairs(
        data,
        fields=tuple(dict.fromkeys((*fields, "baseline_m"))),
        size=protocol.size,
        depth=protocol.depth,
        **selection,
    )
    _require_whole(dataset.index, dataset.left_out, "the warning says why.")
    _require_single_frames(dataset, selection)
    return dataset.index, _pairs_of_scenes(dataset, protocol.size)


def _whole_data(
    data: Data, selection: Mapping[str, Any], conventions: str | Path | Conventions | None
) -> SceneIndex:
    """Return the index of data none of whose selected scenes is lost."""
    wanted = may_pass(selection)
    index = opened(data, selection, conventions, rows="read")
    lost = [] if index.is_from_file else [
        f"{key}: {why}"
        for key, why in index.broken.items()
        if wanted is None or wanted(parse_scene_key(key))
    ]  # fmt: skip
    _require_whole(index, len(lost), *lost[:1])
    index.require_released("The evaluation")
    return index


def _require_single_frames(dataset: StereoPairs, selection: Mapping[str, Any]) -> None:
    """Raise unless samples are single frames, the same for every method, from left to right."""
    chosen, windows = dataset.plan.pairs, dataset.plan.windows
    if windows.is_clip or isinstance(windows, Random):
        raise EvaluationError(
            f"frames must be 'all', 'first', numbers of frames or ('every', k), so that every "
            f"method is scored on the same single frames; got {selection['frames']!r}."
        )
    if chosen.targets.shape[1] != 1 or (chosen.source > chosen.targets[:, 0]).any():
        raise EvaluationError(
            f"pairs are scored from the left view to the right one; got pairs "
            f"{selection.get('pairs', 'primary')!r}, direction "
            f"{selection.get('direction', 'left to right')!r}: choose pairs='primary', 'adjacent', "
            f"'all' or (left, right) numbers."
        )


def _pairs_of_scenes(dataset: StereoPairs, size: Size | None) -> ScoredPairs:
    plan, index = dataset.plan, dataset.index
    chosen, windows = plan.pairs, plan.windows
    scenes: dict[int, list[PairFrames]] = {int(row): [] for row in plan.scene_rows}
    for row, left, right in zip(
        chosen.row.tolist(), chosen.source.tolist(), chosen.targets[:, 0].tolist(), strict=True
    ):
        scene = index.scene(row)
        stored = scene.rig.image_height_px, scene.rig.image_width_px
        scenes[row].append(
            PairFrames(
                scene=scene.id.key,
                pair=(left, right),
                frames=tuple(
                    windows.window(number, frames=scene.frames, draw=(0,))[0]
                    for number in range(windows.count(scene.frames))
                ),
                scene_frames=scene.frames,
                size=size or stored,
                stored_size=stored,
            )
        )
    return scenes


def _require_whole(index: SceneIndex, lost: int, why: str = "") -> None:
    if lost:
        raise StorageError(
            f"{index.where}: {counted(lost, 'selected scene')} cannot be scored: {why} A score is "
            f"not computed on fewer scenes unless you ask for it: mend their files, leave them out "
            f"with filters, such as scenes=..., or by an index of the others (`stereogenbench "
            f"index`)."
        )


def score_pairs(
    run: Run[EvaluationProtocol], options: RunOptions | EvaluationOptions
) -> list[Scores]:
    """Return the scores of every source; scenes that ``out`` holds scores of are not scored again.

    Raises:
        PredictionError: If a right view is missing or is not what it must be, and is not allowed.
        EvaluationError: If more are than are allowed, or if ``out`` holds results of other
            settings.
        StorageError: If data or results cannot be read or written.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    protocol = run.protocol
    try:
        settings = settings_of(protocol)
        matchers = [place_of(getattr(protocol, matcher)) for matcher in MATCHERS.values()]
        known = {"settings": settings, "matchers": matchers, **run.settings}
        if protocol.device != "cpu" and isinstance(options.get("engine", LOCAL), ProcessPool):
            options = {**options, "workers": options.get("workers") or 1}
        with scored_scenes(replace(run, settings=known), score_scene, options) as out:
            return [_scores(run, out, source.name, settings) for source in run.sources]
    finally:
        model_of.cache_clear()


ScoreScene = Callable[[Run[Any], Advance], tuple[str, SceneScores]]
"""Returns a scene's key and its scores, and tells how many frames of pairs it has scored since."""


@contextmanager
def scored_scenes(
    run: Run[Any], score: ScoreScene, options: RunOptions | EvaluationOptions
) -> Iterator[Path]:
    """Score what is not scored yet, and yield the folder that holds all scenes' scores.

    Args:
        run: What is scored.
        score: How a scene is.
        options: How it is run.
    """
    whole = {
        "format": FORMAT,
        "tier": run.tier,
        "methods": [source.name for source in run.sources],
        "data": run.index.digest,
        "frames": sorted({pair.frames for pair in run.pairs}),
        "pairs": sorted({pair.pair for pair in run.pairs}),
        "predictions": [str(getattr(source, "root", "")) for source in run.sources],
        **run.settings,
    }
    with ExitStack() as stack:
        given = options.get("out") or stack.enter_context(
            tempfile.TemporaryDirectory(prefix="stereogenbench-")
        )
        out = Path(given)
        stack.enter_context(job_folder(out, whole, kind=EVALUATION))
        _score_missing_scenes(run, score, out, options)
        yield out


def _score_missing_scenes(
    run: Run[Any], score: ScoreScene, out: Path, options: RunOptions | EvaluationOptions
) -> None:
    """Score what is not scored yet, and keep each scene's scores as soon as it is done."""
    allowed = options.get("allow_missing", 0)
    stamps: dict[str, dict[tuple[str, Pair], str]] = {}
    works: list[Run[Any]] = []
    missing: list[str] = []
    problems: list[str] = []
    done_frames = 0
    for row, pairs in run.scenes.items():
        scene = pairs[0].scene
        stamps[scene] = {}
        for source, pair in product(run.sources, pairs):
            try:
                stamp = source.stamp(pair)
            except PredictionError as problem:
                stamp = ""
                missing.append(str(problem))
            stamps[scene][source.name, pair.pair] = stamp
        known = _read_scene(out, scene)
        if {place: found.stamp for place, found in known.items()} == stamps[scene]:
            done_frames += sum(len(pair.frames) for pair in pairs)
            problems.extend(found.problem for found in known.values() if found.problem)
        else:
            works.append(run.of_scene(row))
    _require_few(missing, allowed=allowed)
    _require_few(problems, allowed=allowed)

    def keep(result: tuple[str, SceneScores]) -> None:
        scene, scores = result
        problems.extend(found.problem for found in scores.values() if found.problem)
        _require_few(problems, allowed=allowed)
        for place, found in scores.items():
            found.stamp = stamps[scene][place]
        _write_scene(out, scene, scores)

    do_items(
        score,
        works,
        name=lambda work: work.pairs[0].scene,
        keep=keep,
        options=options,
        done=done_frames,
        total=sum(len(pair.frames) for pair in run.pairs),
    )


def _require_few(problems: Sequence[str], *, allowed: int) -> None:
    if len(problems) > allowed:
        shown = "; ".join(each.rstrip(".") for each in problems[:_PROBLEMS_SHOWN])
        raise PredictionError(
            f"{counted(len(problems), 'prediction')} missing or unusable, and {allowed} allowed "
            f"(--allow-missing), such as: {shown}."
        )


def _scene_path(out: Path, scene: str) -> Path:
    return out / "scenes" / f"{hashlib.sha256(scene.encode()).hexdigest()[:24]}.pt"


def _write_scene(out: Path, scene: str, scores: SceneScores) -> None:
    """Keep the scores of a scene, whole or not at all."""
    packed, path = BytesIO(), _scene_path(out, scene)
    torch.save(scores, packed)
    what = f"{path}: the scores of {scene} cannot be written"
    with explain_os_errors(what, "Choose another folder with --out."):
        path.parent.mkdir(exist_ok=True)
        write_atomic(path, packed.getvalue())


def _read_scene(out: Path, scene: str) -> SceneScores:
    """Return the scores of a scene; none if it was not scored or its file was cut short."""
    try:
        with torch.serialization.safe_globals([PairScores, FeatureStatistics]):
            scores: SceneScores = torch.load(_scene_path(out, scene), weights_only=True)
    except (FileNotFoundError, UnpicklingError, RuntimeError, EOFError, ValueError):
        return {}
    return scores


def _scores(
    run: Run[EvaluationProtocol], out: Path, name: str, settings: Mapping[str, Any]
) -> Scores:
    """Return what a source scored; one scene's frames and features are in memory at a time."""
    means = []
    gathered: dict[tuple[Labels, str], tuple[FeatureStatistics, FeatureStatistics]] = {}
    for pair_means, scores in pair_scores(run, out, name):
        means.append(pair_means)
        subset, family = (run.index.column(each)[pair_means.row] for each in ("subset", "family"))
        branch: Labels = (subset or "", family)
        for metric in scores.predicted if pair_means.is_primary else ():
            sides = scores.predicted[metric], scores.target[metric]
            if (branch, metric) in gathered:
                before = gathered[branch, metric]
                sides = before[0].merged(sides[0]), before[1].merged(sides[1])
            gathered[branch, metric] = sides
    distances: dict[Labels, dict[str, FrechetDistance]] = {}
    for (branch, metric), sides in gathered.items():
        distances.setdefault(branch, {})[metric] = frechet_distance(*sides)
    return Scores(name, run.tier, run.protocol, settings, run.index, tuple(means), distances)


def pair_scores(run: Run[Any], out: Path, name: str) -> Iterator[tuple[PairMeans, PairScores]]:
    """Yield what a source scored of each pair, scene by scene, averaged over frames and in full."""
    for row, pairs in run.scenes.items():
        scene = run.index.scene(row)
        found = _read_scene(out, scene.id.key)
        if not found:
            raise StorageError(
                f"{_scene_path(out, scene.id.key)}: the scores of {scene.id.key} were removed or "
                f"cut while others were computed. Run it again: only this scene is scored anew."
            )
        for each in pairs:
            scores = found[name, each.pair]
            means = PairMeans(
                row=row,
                scene=each.scene,
                pair=each.pair,
                is_primary=each.pair == scene.rig.primary_pair,
                baseline_cm=scene.rig.baseline_cm(*each.pair),
                frames=len(each.frames),
                tallies=tallies(scores.columns),
                problem=scores.problem,
                views_sha256=scores.views_sha256,
            )
            yield means, scores
