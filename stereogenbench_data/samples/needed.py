"""Whether the videos that samples need are there: a download may hold some cameras alone."""

import numpy as np

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.request import Request
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.plan import Plan


def require_videos(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Refuse, before anything is read, samples of videos that the index does not have.

    Raises:
        StorageError: Naming the first scene and the cameras that it lacks.
    """
    partial = index.video_counts()[plan.scene_rows] < 2 * CAMERA_COUNT
    for place in np.flatnonzero(partial).tolist():
        row = int(plan.scene_rows[place])
        pairs = slice(plan.first_pair[place], plan.first_pair[place + 1])
        sources = set(plan.pairs.source[pairs].tolist())
        targets = set(plan.pairs.targets[pairs].ravel().tolist()) - {-1}
        needed = {
            f"cam_{camera:02d}_{stream.partition('_')[2]}"
            for stream in request.streams
            for camera in (sources if stream.startswith("source") else targets)
        }
        scene = index.scene(row)
        missing = sorted(needed - {name.partition(".")[0] for name in scene.members})
        if missing:
            there = sorted({name[4:6] for name in scene.members if name.startswith("cam_")})
            raise StorageError(
                f"{index.where}: {scene.id.key} has no {', '.join(missing)}; videos of cameras "
                f"{', '.join(there) or 'none'} were fetched. Choose pairs of these, or download "
                "the others too."
            )
