"""What a dataset holds, for people: one line, and a table of the pairs that are selected."""

from collections.abc import Mapping
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

_FACTS: Final = ("key", "split", "subset", "family", "map_name", "focal_mm", "caption")


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
    every = len(CAMERA_PAIRS) * int(plan.frame_counts.sum())
    if "pairs" in chosen and not plan.windows.is_clip and every > len(plan):
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


def pairs_table(index: SceneIndex, plan: Plan) -> "pandas.DataFrame":
    """Return the selected pairs, a row each: its scene, cameras, baseline and samples.

    Raises:
        ExtraError: If pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        raise ExtraError("a table needs pandas: pip install pandas.") from error
    pairs, counts = plan.pairs, np.diff(plan.first_pair)
    targets, baselines = pairs.targets, baselines_cm(index, pairs)
    is_single = targets.shape[1] == 1
    columns: dict[str, Any] = {name: index.column(name)[pairs.row] for name in _FACTS}
    columns |= {"left": pairs.source, "right": targets[:, 0] if is_single else targets.tolist()}
    columns["samples"] = np.repeat(np.diff(plan.first_sample) // counts, counts)
    columns["baseline_cm"] = baselines[:, 0] if is_single else [*baselines]
    return pandas.DataFrame(columns)
