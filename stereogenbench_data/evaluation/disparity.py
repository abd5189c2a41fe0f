"""Score the disparity that a method finds: end-point error, bad pixels, D1, by regions and ranges.

The second scorer beside `evaluate`, which scores right views: the same selection, resumable
results, averages and tables. What is measured is said in `metrics.disparity`.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np
import torch

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import EvaluationError, PredictionError
from stereogenbench_data.evaluation.disparity_maps import Matcher, accept_disparity, open_maps
from stereogenbench_data.evaluation.evaluate import (
    EVALUATION_DEFAULTS,
    EvaluationOptions,
    pair_scores,
    scored_scenes,
    select_pairs,
    source_of,
)
from stereogenbench_data.evaluation.metrics.disparity import (
    COLUMNS_OF_FRAMES,
    D1_PX,
    D1_SHARE,
    MEASURES,
    RANGES_PX,
    REGIONS,
    frame_scores,
)
from stereogenbench_data.evaluation.predictions import CalledMethod, PredictionFolder
from stereogenbench_data.evaluation.protocol import DisparityProtocol
from stereogenbench_data.evaluation.scene_scores import (
    RESIZE,
    PairScores,
    Run,
    SceneScores,
    one_thread,
    open_scene,
    versions,
)
from stereogenbench_data.evaluation.tables import (
    DISPARITY,
    Scores,
    Table,
    TableRow,
    cell,
    forms_of,
    require_comparable,
    rows_of,
    with_score,
)
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.signatures import list_options

_TRUTH: Final = ("disparity", "valid", "visible", "frame_index")
_REGION_ENDINGS: Final = {"all": "", **{region: f"_{region}" for region in REGIONS}}
_SHOWN: Final[tuple[str, ...]] = ("epe", "rms", "bad_1", "bad_2", "bad_3", "d1", "invalid")
"""The columns of tables whose rows are groups of pairs."""
_DENOMINATORS: Final = (
    "EPE, RMS and quantiles (A50 to A99) are over answered pixels; bad, D1 and invalid over scored "
    "pixels, where no answer is bad. Nothing is filled, clipped or pooled over frames."
)


@list_options(EVALUATION_DEFAULTS)
def evaluate_disparity(
    data: Data,
    predictions: str | Path | Matcher,
    *,
    name: str | None = None,
    protocol: DisparityProtocol | None = None,
    conventions: str | Path | Conventions | None = None,
    **options: Unpack[EvaluationOptions],
) -> Scores:
    """Score the disparity of a method and return its scores, for `disparity_tables`.

    Args:
        data: What `StereoPairs` takes: a folder of scenes or shards, its URL, an index.
        predictions: A folder of disparity maps of left views (see `disparity_maps` for its layout);
            or a callable that is given ``left`` and ``right``, uint8 (n, 3, h, w), some frames of
            one pair in order, and returns floats (n, h, w) or (n, 1, h, w), px, nan or inf where it
            has no answer. Disparity is positive: x_right = x_left - disparity.
        name: What tables call the method; else the folder's or the callable's name. A callable
            whose results ``out`` keeps must be given one.
        protocol: At which size, and which pixels; the stored size and all unless given.
        conventions: How the files of a folder are read, as for `StereoPairs`.
        **options: How it is run (`RunOptions`) and what is scored (`Selection`).

    Raises:
        EvaluationError: If a prediction is missing, or is not what it must be, naming it; if
            ``out`` holds results of other settings, predictions or names.
        SelectionError: If nothing matches the selection.
    """
    require_options(evaluate_disparity, options)
    protocol = protocol or DisparityProtocol()
    called = partial(CalledMethod, inputs=("left", "right"), accept=accept_disparity)
    open_pair = partial(open_maps, max_disparity_px=protocol.max_disparity_px)
    written = partial(PredictionFolder, open_pair=open_pair, suffixes=())
    source = source_of(predictions, name, options, called=called, written=written)
    fields = (*_TRUTH, *source.inputs)
    index, scenes = select_pairs(data, fields, protocol, options=options, conventions=conventions)
    settings = _settings_of(protocol)
    run = Run(index, scenes, protocol, (source,), DISPARITY, settings={"settings": settings})
    with scored_scenes(run, score_disparity, options) as out:
        pairs = tuple(means for means, _ in pair_scores(run, out, source.name))
    return Scores(source.name, run.tier, protocol, settings, index, pairs)


def _settings_of(protocol: DisparityProtocol) -> dict[str, Any]:
    """Return every choice that the scores depend on, as plain values."""
    size, most = protocol.size, protocol.max_disparity_px
    return {
        "size": "as stored" if size is None else f"{size[1]}x{size[0]}",
        "resize": "none" if size is None else RESIZE,
        "depth": "as the files state" if protocol.depth is None else repr(protocol.depth),
        "scored": "valid pixels" if most is None else f"valid pixels below {most:g} px",
        "measures": list(MEASURES),
        "d1": f"error above {D1_PX:g} px and above {D1_SHARE:.0%} of the true disparity",
        "denominators": _DENOMINATORS,
        "averages": "pixels first, then frames, then scenes; intervals are Student's over scenes",
        "versions": versions(),
    }


@dataclass(slots=True)
class _PairErrors:
    """Gathers the scores of one method's disparity of one pair."""

    scores: PairScores
    pixels: Any

    def add(self, maps: Sequence[Any], samples: Sequence[Sample], most_px: float | None) -> None:
        for found, sample in zip(maps, samples, strict=True):
            found = np.ascontiguousarray(found, dtype="<f8")
            self.pixels.update(found.data)
            given = (found, *(sample[name][0] for name in _TRUTH[:3]))
            numbers = frame_scores(*map(torch.from_numpy, given), max_disparity_px=most_px)
            for name, number in numbers.items():
                self.scores.columns[name].append(number)


def score_disparity(work: Run[DisparityProtocol], after_frames: Advance) -> tuple[str, SceneScores]:
    """Return a scene's key, and the scores of each method and pair of it.

    Args:
        work: What to score of one scene.
        after_frames: Called with how many frames of pairs were scored since; it may raise to
            stop the work.

    Raises:
        StorageError: If a file of the data is missing or altered.
        MediaError: If a video of the data does not decode.
    """
    protocol = work.protocol
    gathered = {
        (source.name, wanted.pair): _PairErrors(
            PairScores({name: [] for name in COLUMNS_OF_FRAMES}), hashlib.sha256()
        )
        for source in work.sources
        for wanted in work.pairs
    }
    size, frames = protocol.batch_frames, work.pairs[0].frames
    with one_thread(), open_scene(work, _TRUTH) as (load, reads):
        # Some frames of every pair, which share cameras, and then those after them.
        for start, wanted in product(range(0, len(frames), size), work.pairs):
            samples = [load(wanted.pair, frame) for frame in frames[start : start + size]]
            for name, read in reads.items():
                found = gathered[name, wanted.pair]
                if found.scores.problem:
                    continue
                try:
                    found.add(read(wanted, samples), samples, protocol.max_disparity_px)
                except PredictionError as problem:
                    found.scores = PairScores(problem=str(problem))
                except EvaluationError as problem:
                    found.scores = PairScores(problem=f"{wanted.label}: {name}: {problem}")
            after_frames(len(samples))
    for found in gathered.values():
        found.scores.views_sha256 = "" if found.scores.problem else found.pixels.hexdigest()
    return work.pairs[0].scene, {place: found.scores for place, found in gathered.items()}


def disparity_tables(
    results: Sequence[Scores], *, by: Sequence[str] = ("map_name",)
) -> list[Table]:
    """Return the tables of scored disparity: by groups of pairs, regions and true disparity.

    Args:
        results: Each method's scores (`evaluate_disparity`).
        by: Columns of the index to stratify by, besides branches and baselines.

    Raises:
        EvaluationError: If the methods were scored in different ways, or on other data, or if the
            index has no such column with one value a scene.
    """
    require_comparable(results)
    protocol: Any = results[0].protocol
    tables = []
    for name, form in forms_of(results, by).items():
        title, rows = f"{form.title} (disparity)", rows_of(results, form)
        tables.append(Table(name, title, form.keys, protocol, _SHOWN, rows))
    for name, title, key, endings in (
        ("regions", "What the right camera sees", "region", _REGION_ENDINGS),
        ("ranges", "True disparity in px", "disparity", {part: f"_{part}" for part in RANGES_PX}),
    ):
        title, rows = f"{title}, all pairs (disparity)", _parts(results, endings)
        tables.append(Table(name, title, (key,), protocol, MEASURES, rows))
    # What holds for all stands at the first.
    columns, notes = _SHOWN, [_DENOMINATORS]
    if protocol.max_disparity_px is not None:
        columns = (*columns, "beyond")
        notes.append(f"Left out are valid pixels from {protocol.max_disparity_px:g} px on.")
    return [replace(tables[0], columns=columns, notes=tuple(notes)), *tables[1:]]


def _parts(results: Sequence[Scores], endings: Mapping[str, str]) -> tuple[TableRow, ...]:
    """Return a row for each part of the pixels of all pairs, of every method; none of no pixel."""
    return tuple(
        TableRow(
            method=one.name,
            labels=(part,),
            scenes=len({pair.scene for pair in there}),
            frames=sum(pair.tallies[f"invalid{ending}"].finite for pair in there),
            missing=sum(bool(pair.problem) for pair in one.pairs),
            values={name: cell(there, f"{name}{ending}") for name in MEASURES},
        )
        for part, ending in endings.items()
        for one in results
        if (there := with_score(one.pairs, f"invalid{ending}"))
    )
