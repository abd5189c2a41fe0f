"""The renderer ``blender``: users' own assets, by the interface of all renderers."""

import json
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float64
from PIL import Image

from stereogenbench_data.errors import SynthesisError, missing_extra
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.synthesis.blender.assets import Assets, read_assets
from stereogenbench_data.synthesis.blender.process import blender
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.renderer import (
    Bounds,
    RenderedView,
    ScenePlan,
    Spawn,
    unknown_map,
)
from stereogenbench_data.synthesis.request import SENSOR_MM

_VERSION: Final = 1
"""Goes up when the same assets give other scenes."""
_LEAST_BLENDER: Final = (5, 2)


def _require_blender() -> None:
    try:
        found = version("bpy")
    except PackageNotFoundError:
        found = "none"
    if found == "none" or tuple(map(int, found.split(".")[:2])) < _LEAST_BLENDER:
        why = f"bpy is {found}; at least 5.2 is needed, which needs Python 3.13"
        raise missing_extra("the renderer blender", "blender", why)


class BlenderAssetWarning(UserWarning):
    """Something of an asset is left out of its pictures."""


@dataclass(frozen=True, slots=True)
class BlenderRenderer:
    """Renders users' own assets by Cycles.

    Attributes:
        assets: What there is to render.
    """

    assets: Assets

    @classmethod
    def from_file(cls, path: str | Path) -> "BlenderRenderer":
        """Return the renderer of an ``assets.toml``.

        Raises:
            SynthesisError: If the file does not follow the format.
            ExtraError: If Blender is not installed, or too old.
        """
        renderer = cls(read_assets(path))
        _require_blender()
        return renderer

    @property
    def name(self) -> str:
        """What the command calls it."""
        return "blender"

    @property
    def maps(self) -> tuple[str, ...]:
        """Names of the maps."""
        return tuple(sorted(self.assets.maps))

    @property
    def characters(self) -> tuple[str, ...]:
        """Names of the subjects."""
        return tuple(sorted(self.assets.characters))

    @property
    def animations(self) -> tuple[str, ...]:
        """Names of the subjects' motions."""
        return tuple(sorted(self.assets.animations))

    @property
    def sensors_mm(self) -> tuple[tuple[float, float], ...]:
        """Sensors to draw from."""
        return self.assets.sensors_mm or (SENSOR_MM,)

    @property
    def fingerprint(self) -> str:
        """A digest of the assets, and the version of this code."""
        return f"blender {_VERSION} {self.assets.digest[:32]}"

    @property
    def cameras_per_task(self) -> int:
        """All cameras of a frame are rendered from one evaluated scene."""
        return CAMERA_COUNT

    def world(self, proposal: Proposal) -> "BlenderWorld":
        """Return the map of a proposal, with its subject."""
        return BlenderWorld(self, proposal)

    def views(self, plan: ScenePlan, *, cameras: tuple[int, ...]) -> Iterator[RenderedView]:
        """Yield the views of cameras; see `Renderer.views`."""
        settings = self.assets.settings
        for frame in range(len(plan.centres_m)):
            views = [plan.view(camera=camera, frame=frame) for camera in cameras]
            process = blender(self.assets.maps[plan.proposal.map_name].file)
            what = f"{plan.key}, frame {frame}"
            request = self.request(plan.proposal) | {
                "call": "render",
                "view": {
                    "frame": frame,
                    "place_m": plan.spawn.place_m.tolist(),
                    "yaw_deg": plan.spawn.yaw_deg,
                    "size_px": views[0].size_px,
                    "focal_px": views[0].focal_px,
                    "folder": str(process.folder),
                    "seed": zlib.crc32(f"{plan.request.seed}/{plan.key}".encode()) >> 1,
                    "samples_per_pixel": settings.samples_per_pixel,
                    "device": settings.device,
                    "denoise": settings.denoise,
                    "threads": settings.threads,
                },
            }
            eyes_m, axes = (
                np.stack([np.asarray(getattr(view, name), np.float64) for view in views])
                for name in ("eye", "axes")
            )
            _, (depths_m,) = process.call(request, [eyes_m, axes], what=what)
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

    def request(self, proposal: Proposal) -> dict[str, Any]:
        """Return the map and the subject of a proposal, as the worker wants them.

        Raises:
            SynthesisError: If there is no such map.
        """
        assets = self.assets
        if proposal.map_name not in assets.maps:
            raise unknown_map(
                f"{assets.path}: maps", proposal.map_name, self.maps,
                choose=f"one of {', '.join(self.maps)}, or all",
            )  # fmt: skip
        the_map = assets.maps[proposal.map_name]
        character = assets.characters[proposal.character]
        animation = assets.animations[proposal.animation]
        return {
            "map": {
                "root": str(assets.root),
                "where": f"{assets.path}: maps.{proposal.map_name}: {the_map.file}",
                "path": the_map.file,
                "scale": the_map.scale,
                "light": the_map.light,
                "is_bounded": the_map.bounds_m is not None,
            },
            "subject": {
                "character": asdict(character),
                "character_where": f"{assets.path}: characters.{proposal.character}: "
                f"{character.file}",
                "animation": asdict(animation),
                "animation_where": f"{assets.path}: animations.{proposal.animation}: "
                f"{animation.file}",
            },
        }

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
        self._request = renderer.request(proposal)
        self._what = f"{proposal.map_name}, {proposal.character}, {proposal.animation}"
        asset = renderer.assets.maps[proposal.map_name]
        bounds_m, spawn_bounds_m, self._points_m = _facts(
            json.dumps(self._request), proposal.request.frames
        )
        if asset.bounds_m is not None:
            bounds_m = spawn_bounds_m = np.array(asset.bounds_m)
        if asset.spawn_bounds_m is not None:
            spawn_bounds_m = np.array(asset.spawn_bounds_m)
        self._bounds_m, self._spawn_bounds_m = bounds_m, spawn_bounds_m

    @property
    def bounds_m(self) -> Bounds:
        """The part of the map in which cameras may be."""
        return Bounds(*self._bounds_m)

    @property
    def spawn_bounds_m(self) -> Bounds:
        """The part in which subjects are spawned."""
        return Bounds(*self._spawn_bounds_m)

    def cast(
        self, origins_m: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, " n"]:
        """Return how many metres each ray goes until it meets the map, see `World.cast`.

        A ray starts inside a solid if backs of faces are around it, along one axis less than 2 m
        apart; so a room whose faces look outwards is not taken for a solid.
        """
        arrays = [np.asarray(each, np.float64) for each in (origins_m, directions)]
        process = blender(self._request["map"]["path"])
        _, (found_m,) = process.call(
            self._request | {"call": "cast"}, arrays, what=f"{self._what}: rays"
        )
        return found_m

    def subject_points_m(self, spawn: Spawn, *, frame: int) -> Float64[np.ndarray, "p 3"]:
        """Return points of the subject's body at a frame, from the soles to the crown."""
        turn = rotation_from_rotator_deg(np.array([0.0, spawn.yaw_deg, 0.0]))
        points_m: Float64[np.ndarray, "p 3"] = self._points_m[frame] @ turn.T + spawn.place_m
        return points_m


@lru_cache(maxsize=64)
def _facts(request_json: str, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bounds of a map, those of spawns, and a subject's points for a spawn at 0.

    Bounds are two corners, and points are (frames, p, 3).
    """
    request = json.loads(request_json)
    process = blender(request["map"]["path"])
    answer, (bounds_m, spawn_bounds_m, points_m) = process.call(
        request | {"call": "facts", "frames": frames}, what=request["map"]["where"]
    )
    if answer["notes"]:
        warnings.warn(
            f"{request['map']['where']}: left out or not run: {'; '.join(answer['notes'])}.",
            BlenderAssetWarning,
            stacklevel=2,
        )
    return bounds_m, spawn_bounds_m, points_m
