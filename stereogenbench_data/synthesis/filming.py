"""One camera of one scene: its pictures and depth, drawn and encoded frame by frame."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.render import Scenery, draw_depth, draw_frame, still_light
from stereogenbench_data.synthesis.videos import depth_frame, open_depth, open_rgb, rgb_frame


def film_camera(
    plan: ScenePlan, *, camera: int, folder: Path, after_frame: Callable[[], None]
) -> None:
    """Write a camera's two videos into a folder.

    ``after_frame`` is called after each frame; what it raises ends the work.
    """
    contract = plan.request.contract
    light = still_light(plan.stage)
    first = plan.view(camera=camera, frame=0)
    with ExitStack() as files:
        rgb = files.enter_context(open_rgb(folder, camera=camera, view=first))
        depth = files.enter_context(
            open_depth(folder, camera=camera, view=first, contract=contract)
        )
        for frame in range(plan.request.frames):
            view = plan.view(camera=camera, frame=frame)
            scenery = Scenery(plan.stage, moment_s=plan.moment_s(frame), still_light=light)
            picture, depth_m = draw_frame(scenery, view=view)
            rgb.write(rgb_frame(picture))
            if contract.frame_lag:
                measured = frame - contract.frame_lag
                view = plan.view(camera=camera, frame=measured)
                scenery = Scenery(plan.stage, moment_s=plan.moment_s(measured), still_light=light)
                depth_m = draw_depth(scenery, view=view)
            depth.write(depth_frame(depth_m, view=view, contract=contract))
            after_frame()
