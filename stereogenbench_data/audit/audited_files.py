"""The files of a scene under audit: what cannot be read is noted once, and not tried again."""

import math
from collections.abc import Callable
from typing import Any, Literal, ParamSpec, TypeVar

import numpy as np

from stereogenbench_data.audit.picture_check import reduced_size
from stereogenbench_data.audit.reprojection import MeasuredDepth
from stereogenbench_data.errors import MediaError, StereoGenBenchError, StorageError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.media.depth import depth_frame_index, depth_m_from_units
from stereogenbench_data.media.video import probe
from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import depth_name, rgb_name
from stereogenbench_data.sources.members import MemberSource

Answer = TypeVar("Answer")
Arguments = ParamSpec("Arguments")


class SceneFiles:
    """A scene's metadata, frame counts and decoded frames.

    Attributes:
        problems: File name to what was wrong with it.
    """

    def __init__(self, source: MemberSource, scene: Scene, *, contract: DepthEncoding) -> None:
        """Prepare to read; nothing is opened yet."""
        self.problems: dict[str, str] = {}
        self.scene = scene
        self.source = source
        self.contract = contract
        self.streams = Streams(source)
        self.intrinsics = rig_intrinsics(scene.rig)

    def close(self) -> None:
        """Close the open videos."""
        self.streams.close()

    def attempt(
        self,
        name: str,
        read: Callable[Arguments, Answer],
        *args: Arguments.args,
        **kwargs: Arguments.kwargs,
    ) -> Answer | None:
        """Return what is read of a file, None once anything about it was wrong."""
        if name in self.problems:
            return None
        try:
            return read(*args, **kwargs)
        except (StereoGenBenchError, OSError) as error:
            self.problems[name] = str(error)
            return None

    def text(self, name: str) -> bytes:
        """Return a metadata file's bytes."""
        self._require_member(name)
        return self.source.read(self.scene, name)

    def _require_member(self, name: str) -> None:
        if self.scene.held_name(name) not in self.scene.members:
            raise StorageError("is missing: the index knows no such file of this scene")

    def counted(self, camera: int) -> tuple[int, int]:
        """Return how many frames a camera's two videos have, -1 where they cannot be opened."""
        rgb, depth = rgb_name(camera), depth_name(camera)
        found = (
            self.attempt(rgb, self._probed, rgb, "later"),
            self.attempt(depth, self._probed, depth, "needed"),
        )
        return -1 if found[0] is None else found[0], -1 if found[1] is None else found[1]

    def _probed(self, name: str, pixel_format: Literal["needed", "later"]) -> int:
        self._require_member(name)
        held = self.scene.held_name(name)
        opened = self.source.open(self.scene, held)
        label = self.source.label(self.scene, held)
        try:
            return probe(opened, name=label, pixel_format=pixel_format).frames
        finally:
            close = getattr(opened, "close", None)
            if close is not None:
                close()

    def picture(self, camera: int, frame: int) -> Any:
        """Return a frame as (3, h, w) uint8, at the size at which light and motion are judged."""
        rig = self.scene.rig
        size = reduced_size(rig.image_height_px, rig.image_width_px)
        return self.streams.rgb(self.scene, rgb_name(camera), frame, size=size)

    def depth(self, camera: int, frame: int) -> tuple[Any, MeasuredDepth] | None:
        """Return stored numbers and depth, None where the contract has no picture for a frame."""
        encoding = self._encoding(camera)
        index = depth_frame_index(frame, encoding=encoding, frames=self.scene.frames)
        if index is None:
            return None
        stored = self.streams.read_stored_depth(
            self.scene, depth_name(camera), index, encoding=encoding
        )
        depth_m = depth_m_from_units(
            stored.units,
            measured=stored.measured,
            encoding=encoding,
            intrinsics=self.intrinsics,
        )
        known = stored.measured & np.isfinite(depth_m)
        return stored.units, MeasuredDepth(
            np.where(known, depth_m, 0).astype(np.float64),
            known,
            step_m=encoding.known_unit_m,
            form=encoding.form,
        )

    def _encoding(self, camera: int) -> DepthEncoding:
        source = self.scene.depth_unit_source[camera]
        if source == "unreadable":
            if self.contract.unit_m is None:
                raise MediaError(
                    "its tags do not tell one positive number of metres in a stored unit of depth"
                )
            return self.contract
        return self.contract.with_file_unit(self.scene.depth_unit_m[camera], source=source)

    def unit_m(self, camera: int) -> float:
        """Return metres in a stored unit of a camera's depth, nan where its tags contradict."""
        if self.scene.depth_unit_source[camera] == "unreadable" and self.contract.unit_m is None:
            return math.nan
        return self._encoding(camera).known_unit_m
