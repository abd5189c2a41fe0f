"""``stereogenbench synth``: draw scenes in the released layout, without Unreal."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stereogenbench_data.cli.errors import resumable
from stereogenbench_data.cli.options import (
    JsonOption,
    WorkOptions,
    complete_from,
    grouped,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.release import (
    FAMILIES,
    FRAME_COUNT,
    IMAGE_SIZE_PX,
    Split,
    Subset,
)
from stereogenbench_data.schema.text import counted

if TYPE_CHECKING:
    from stereogenbench_data.synthesis.renderer import Renderer

RendererName = Literal["ray-casting", "blender"]
RotationForm = Literal["rotator", "quaternion_xyzw", "quaternion_wxyz", "matrix"]
"""The same as in `synthesis.request`, which the help does not import."""


@dataclass(frozen=True, kw_only=True)
class RendererOptions:
    """What draws the scenes of a command."""

    renderer: Annotated[
        RendererName,
        typer.Option(help="ray-casting: built-in maps; blender: your own assets, by Cycles."),
    ] = "ray-casting"
    assets: Annotated[
        Path | None, typer.Option(help="The assets.toml of the renderer blender.")
    ] = None
    blender_python: Annotated[
        str, typer.Option(help="Python that has bpy 5.0, for the renderer blender [this one].")
    ] = ""

    def renderer_of(self) -> "Renderer":
        """Return the renderer that the options name.

        Raises:
            SynthesisError: If the assets are missing, not wanted, or not as they should be.
            ExtraError: If Blender cannot be started.
        """
        from stereogenbench_data.errors import SynthesisError

        if self.renderer == "blender":
            from stereogenbench_data.synthesis.blender.renderer import BlenderRenderer

            if self.assets is None:
                raise SynthesisError(
                    "renderer blender: no assets are named. Name the maps, characters and "
                    "animations in an assets.toml, and give it by --assets."
                )
            return BlenderRenderer.from_file(self.assets, python=self.blender_python)
        if self.assets is not None or self.blender_python:
            raise SynthesisError(
                f"renderer {self.renderer}: it takes no --assets and no --blender-python. Choose "
                f"--renderer blender, or leave them out."
            )
        from stereogenbench_data.synthesis.ray_renderer import RAY_CASTING

        return RAY_CASTING


@grouped
@resumable()
def synth(  # noqa: PLR0913 - one parameter an option
    out: Annotated[Path, typer.Argument(help="Folder to write train/ or eval/ into.")],
    *,
    family: Annotated[
        str,
        typer.Option(
            help=f"Family of baselines: {', '.join(FAMILIES)}.",
            autocompletion=complete_from(FAMILIES),
        ),
    ] = FAMILIES[0],
    scenes: Annotated[int, typer.Option(help="Number of scenes; they are numbered from 0.")] = 1,
    size: Annotated[int, typer.Option(help="Width and height, even.")] = IMAGE_SIZE_PX,
    frames: Annotated[int, typer.Option(help="Frames, at 15 Hz.")] = FRAME_COUNT,
    seed: Annotated[int, typer.Option(help="Seed of all that is random.")] = 0,
    split: Annotated[Split, typer.Option(help="Pairwise_Uniform is only in train.")] = "train",
    subset: Annotated[Subset, typer.Option(help="Kind of maps; used in eval.")] = "seen_map",
    map_name: Annotated[
        str | None,
        typer.Option("--map", help="Folder of the scenes [SynthStage; all maps of the assets]."),
    ] = None,
    focal_mm: Annotated[
        float | None, typer.Option(help="Focal length, mm [random, 18 to 85, for each scene].")
    ] = None,
    depth_unit_m: Annotated[float, typer.Option(help="Metres in a stored unit.")] = 0.001,
    depth_tag: Annotated[
        str, typer.Option(help="Name of the tag that states the unit; '' writes none.")
    ] = "DEPTH_SCALE",
    rotation: Annotated[
        RotationForm, typer.Option(help="How trajectory.json records rotations.")
    ] = "rotator",
    drawn_by: RendererOptions,
    work: WorkOptions,
    as_json: JsonOption = False,
) -> None:
    """Draw scenes with exact depth, poses and intrinsics, in the released layout.

    To continue a stopped run, run it again: it keeps the scenes that the same request wrote. Scene
    i is the same for any number of scenes and workers.
    """
    from stereogenbench_data.synthesis.produce import synthesise
    from stereogenbench_data.synthesis.request import ExportContract, SynthRequest

    renderer = drawn_by.renderer_of()
    default_maps: str | tuple[str, ...] = "SynthStage" if drawn_by.assets is None else renderer.maps
    request = SynthRequest(
        family=family,
        scenes=scenes,
        size_px=size,
        frames=frames,
        seed=seed,
        split=split,
        subset=subset,
        map_name=map_name or default_maps,
        focal_mm=focal_mm,
        contract=ExportContract(
            rotation=rotation, depth_unit_m=depth_unit_m, depth_tag=depth_tag or None
        ),
    )
    with progress_bar("drawing", unit="frames") as progress:
        keys = synthesise(out, request, renderer=renderer, progress=progress, **work.options())
    if as_json:
        typer.echo(json.dumps({"root": str(out), "scenes": keys}, indent=2))
    else:
        folders = sorted({key.rpartition("/")[0] for key in keys})
        typer.echo(f"{out}: {counted(len(keys), 'scene')} in {', '.join(folders)}")
