"""The renderer ``blender``: users' own assets, by the interface of all renderers."""

import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float64
from PIL import Image

from stereogenbench_data.errors import SynthesisError, missing_extra
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.synthesis.blender.assets import (
    Asked,
    Assets,
    MapAsset,
    Shot,
    read_assets,
)
from stereogenbench_data.synthesis.blender.process import blender
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.renderer import (
    RenderedView,
    Renderer,
    ScenePlan,
    Spawn,
    unknown_map,
)
from stereogenbench_data.synthesis.request import SENSOR_MM

_VERSION: Final = 2
"""Goes up when the same assets give other scenes."""


class BlenderAssetWarning(UserWarning):
    """Something of an asset is left out of its pictures."""


@dataclass(frozen=True)
class BlenderRenderer(Renderer):
    """Renders users' own assets by Cycles; all cameras of a frame from one evaluated scene.

    Attributes:
        assets: What there is to render.
    """

    assets: Assets

    @classmethod
    def from_file(cls, path: str | Path) -> "BlenderRenderer":
        """Return the renderer of an ``assets.toml``.

        Raises:
            SynthesisError: If the file does not follow the format.
            ExtraError: If Blender is not installed.
        """
        assets = read_assets(path)
        if find_spec("bpy") is None:
            raise missing_extra("Blender", "blender", "bpy is not installed; it needs Python 3.13")
        return cls(
            name="blender",
            maps=tuple(sorted(assets.maps)),
            characters=tuple(sorted(assets.characters)),
            animations=tuple(sorted(assets.animations)),
            sensors_mm=assets.sensors_mm or (SENSOR_MM,),
            fingerprint=f"blender {_VERSION} {assets.digest[:32]}",
            cameras_per_task=CAMERA_COUNT,
            assets=assets,
        )

    def world(self, proposal: Proposal) -> "BlenderWorld":
        """Return the map of a proposal, with its subject."""
        return BlenderWorld(self, proposal)

    def views(self, plan: ScenePlan, *, cameras: tuple[int, ...]) -> Iterator[RenderedView]:
        """Yield the views of cameras; see `Renderer.views`."""
        proposal, settings = plan.proposal, self.assets.settings
        seed = zlib.crc32(f"{proposal.request.seed}/{proposal.key}".encode()) >> 1
        for frame in range(len(plan.centres_m)):
            seen = [plan.view(camera=camera, frame=frame) for camera in cameras]
            process = blender(self.map_of(proposal).file)
            what = f"{proposal.key}, frame {frame}"
            shot = Shot(frame, plan.spawn, seen, seed, settings, process.folder)
            depths_m = process.call("render", self.asked(proposal), shot, what=what)
            for number, depth_m in enumerate(depths_m):
                path = process.folder / f"view_{number}.png"
                try:
                    with Image.open(path) as picture:
                        shown = np.array(picture.convert("RGB"))
                    path.unlink()
                except OSError as error:
                    raise SynthesisError(
                        f"{what}: Blender wrote no picture {path.name} ({error}). Check that the "
                        f"folder for temporary files has free space."
                    ) from error
                yield RenderedView(picture=shown, depth_m=depth_m)

    def map_of(self, proposal: Proposal) -> MapAsset:
        """Return the map of a proposal.

        Raises:
            SynthesisError: If there is no such map.
        """
        if proposal.map_name not in self.assets.maps:
            raise unknown_map(
                f"{self.assets.path}: maps", proposal.map_name, self.maps,
                choose=f"one of {', '.join(self.maps)}, or all",
            )  # fmt: skip
        return self.assets.maps[proposal.map_name]

    def asked(self, proposal: Proposal) -> Asked:
        """Return the assets of a proposal, as the process of Blender wants them."""
        assets = self.assets
        return Asked(
            str(assets.path.parent),
            self.map_of(proposal),
            assets.characters[proposal.character],
            assets.animations[proposal.animation],
        )

    def description(self, plan: ScenePlan) -> dict[str, object]:
        """Return the document of ``scene_description_qwen_dataset_level.json``."""
        proposal = plan.proposal
        place, motion = (name.replace("_", " ") for name in (proposal.map_name, proposal.animation))
        return {
            "scene_type": "unknown",
            "setting": place,
            "primary_elements": [proposal.character],
            "spatial_layout": "a figure, seen by a rig of six cameras that moves around it",
            "lighting_materials": "rendered by Cycles",
            "short_caption": f"{proposal.character} in {place}.",
            "detailed_caption": f"{proposal.character} moves in {place} ({motion}).",
            "tags": [proposal.map_name, proposal.character, proposal.animation],
        }


class BlenderWorld:
    """The map of one proposal, which Blender holds open."""

    def __init__(self, renderer: BlenderRenderer, proposal: Proposal) -> None:
        """Open the map and the subject.

        Raises:
            SynthesisError: If one of them cannot be opened or used.
        """
        self._asked = renderer.asked(proposal)
        asset = renderer.map_of(proposal)
        facts = _facts(self._asked, proposal.request.frames)
        self.bounds_m, self.spawn_bounds_m, self._points_m = facts
        if asset.bounds_m is not None:
            self.bounds_m = self.spawn_bounds_m = np.array(asset.bounds_m, np.float64)
        if asset.spawn_bounds_m is not None:
            self.spawn_bounds_m = np.array(asset.spawn_bounds_m, np.float64)

    def cast(
        self, origins_m: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, " n"]:
        """Return how many metres each ray goes until it meets the map, see `World.cast`.

        The insides of solids are not known: the filter of visibility refuses what is in them.
        """
        asset = self._asked.map
        found_m: Float64[np.ndarray, " n"] = blender(asset.file).call(
            "cast", self._asked, origins_m, directions, what=f"{asset.where}: rays"
        )
        return found_m

    def subject_points_m(self, spawn: Spawn, *, frame: int) -> Float64[np.ndarray, "p 3"]:
        """Return points of the subject's body at a frame, from the soles to the crown."""
        turn = rotation_from_rotator_deg(np.array([0.0, spawn.yaw_deg, 0.0]))
        points_m: Float64[np.ndarray, "p 3"] = self._points_m[frame] @ turn.T + spawn.place_m
        return points_m


@lru_cache(maxsize=64)
def _facts(asked: Asked, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bounds of a map, those of spawns, and a subject's points for a spawn at 0.

    Bounds are two corners, and points are (frames, p, 3).
    """
    place = asked.map
    *found, notes = blender(place.file).call("facts", asked, frames, what=place.where)
    if notes:
        warnings.warn(
            f"{place.where}: left out or not run: {'; '.join(notes)}.",
            BlenderAssetWarning,
            stacklevel=2,
        )
    bounds_m, spawn_bounds_m, points_m = found
    return bounds_m, spawn_bounds_m, points_m
