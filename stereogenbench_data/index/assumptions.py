"""What opening a tree takes for granted, in one line: where files are not as the paper prints them.

Scenes as the paper prints them, and those that conventions state, have nothing to say. What fields
of samples need and files lack (poses, a principal point, units of depth) is told where samples are
made.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Final

from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.text import counted, shortened

_PHRASES: Final = {
    "size": "the videos' picture size counts, where baseline.json has another",
    "baselines": "baselines that are not recorded are sums of their neighbours",
    "pair": "the primary pair of baseline.json counts, where trajectory.json has another",
    "frames": "the frames that all videos have are used",
    "lens": "a pinhole lens is assumed, where baseline.json states another model",
    "marker": "no scene has _scene_complete.json, so it is not known which were finished",
    "world": "several readings of the poses fit the baselines, and fields that depend on the "
    "reading are refused",
}
_PLAIN: Final = "unreal axes"


class AssumptionWarning(UserWarning):
    """Files of a tree are not as the paper prints them, and something was taken for granted."""


def assumptions(scenes: Iterable[Scene], *, where: str) -> str:
    """Return what was taken for granted about scenes and what was measured; "" if nothing."""
    counts: Counter[str] = Counter()
    for scene in scenes:
        if scene.conventions is not None:
            continue
        counts.update({_PHRASES[each.about] for each in scene.remarks if each.about in _PHRASES})
        pixels = scene.remark("pixels").partition(": ")[2]
        counts.update([f"{pixels}; disparity follows from the sensor's width"] if pixels else [])
        form = (scene.pose_form or "").split("|")[0].partition(" @ ")[0]
        if form and _PLAIN not in form and not scene.remark("world"):
            counts[f"poses are read as {shortened(form, 200)}: measured, the cameras' distances "
                   "are the baselines"] += 1  # fmt: skip
    if not counts:
        return ""
    told = "; ".join(f"{phrase} ({counted(count, 'scene')})" for phrase, count in counts.items())
    return (
        f"{where}: {told}. `stereogenbench conventions {where} -o conventions.toml` writes down "
        f"how its files are read, for conventions=."
    )
