"""What a dataset holds, for people: one line, and a table of the pairs that are selected."""

import html
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from stereogenbench_data.errors import ExtraError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Request
from stereogenbench_data.schema.release import CAMERA_PAIRS
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.filters import baselines_cm
from stereogenbench_data.selection.plan import Plan

if TYPE_CHECKING:
    import pandas

_NAMES: Final = ("split", "subset", "family", "map_name")
_SHOWN: Final = 10
"""Rows of a table in a notebook."""


def in_one_line(
    name: str, index: SceneIndex, plan: Plan, request: Request, chosen: Mapping[str, Any]
) -> str:
    """Return what a dataset is of, with how many samples its scenes have in all.

    Args:
        name: The dataset's class.
        index: Its scenes.
        plan: Its samples.
        request: Their fields and size.
        chosen: What its user has chosen, or what is chosen by default.
    """
    samples = counted(len(plan), "sample")
    every = _every_sample(plan) if "pairs" in chosen and not plan.windows.is_clip else 0
    if every > len(plan):
        samples = f'{len(plan):,} of {every:,} samples (all: pairs="all", frames="all")'
    size = request.size
    parts = [
        f"{samples} of {counted(len(plan.scene_rows), 'scene')}",
        *(f"{option}={value!r:.40}" for option, value in chosen.items()),
        "stored size" if size is None else f"size {size[1]}x{size[0]}",
        f"fields {', '.join(request.fields)}",
        index.where,
        *([index.not_opened] if index.unopened is not None else []),
    ]
    return f"<{name}: {'; '.join(parts)}>"


def _every_sample(plan: Plan) -> int:
    """Return how many frames of how many pairs the selected scenes have together."""
    return len(CAMERA_PAIRS) * int(plan.frame_counts.sum())


def pairs_table(index: SceneIndex, plan: Plan) -> "pandas.DataFrame":
    """Return the selected pairs, a row each: its scene, cameras, baseline and samples.

    Raises:
        ExtraError: If pandas is not installed.
    """
    table = _table(index, plan, facts=("key", *_NAMES, "focal_mm", "caption"))
    baselines = baselines_cm(index, plan.pairs)
    is_one = baselines.shape[1] == 1
    table.insert(
        len(table.columns) - 1, "baseline_cm", [*(baselines[:, 0] if is_one else baselines)]
    )
    return table


def _table(index: SceneIndex, plan: Plan, *, facts: tuple[str, ...]) -> "pandas.DataFrame":
    try:
        import pandas
    except ImportError as error:
        raise ExtraError("a table needs pandas: pip install pandas.") from error
    pairs = plan.pairs
    targets = pairs.targets
    scenes = np.repeat(np.arange(len(plan.scene_rows)), np.diff(plan.first_pair))
    samples = np.diff(plan.first_sample) // np.diff(plan.first_pair)
    columns: dict[str, Any] = {name: index.column(name)[pairs.row] for name in facts}
    columns |= {"left": pairs.source, "right": targets[:, 0], "samples": samples[scenes]}
    if targets.shape[1] > 1:
        columns["right"] = targets.tolist()
    return pandas.DataFrame(columns)


def as_html(line: str, index: SceneIndex, plan: Plan) -> str:
    """Return a dataset for a notebook: the line, and some rows of its table, if there is pandas.

    It asks for nothing that opening the data has not read.
    """
    told = f"<p>{html.escape(line)}</p>"
    with suppress(ExtraError):
        table = _table(index, plan, facts=("key", *_NAMES))
        told += table.to_html(max_rows=_SHOWN, index=False, border=0)
    return told
