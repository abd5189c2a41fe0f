"""Decoded views, and the geometry of a pair: each map is computed once, when first needed.

`Views` are what is decoded for one sample, before anything is derived from it. Transforms map one
`Views` to another: they move pictures, stored depth and cameras together, so what is derived fits.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt16

from stereogenbench_data.errors import FieldError
from stereogenbench_data.geometry.arrays import (
    array_namespace,
    as_float64,
    pixel_centres,
    take_flat,
)
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import (
    disparity_error_px,
    disparity_from_depth,
    write_disparity,
)
from stereogenbench_data.geometry.projection import (
    Projection,
    homography,
    landing_pixels,
    project_by_homography,
    project_rectified,
    splat,
    visible_from_source,
    visible_in_target,
)
from stereogenbench_data.geometry.rig import RECTIFIED_PX
from stereogenbench_data.media.depth import depth_m_from_units
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import rgb_name
from stereogenbench_data.selection.plan import Address

MIRROR_X: Final = np.diag([-1.0, 1.0, 1.0, 1.0])

MapF32 = Float32[np.ndarray, "t h w"]
MapBool = Bool[np.ndarray, "t h w"]
Motions = Float64[np.ndarray, "t 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class StoredDepth:
    """Depth as it is stored, of one frame or over the frames of a sample.

    Attributes:
        units: (t, h, w) or (h, w) uint16, stored numbers.
        measured: (t, h, w) or (h, w) bool, where they mean a depth.
        derived: Maps computed from these numbers, kept for other pairs, by what they are.
    """

    units: UInt16[np.ndarray, "*t h w"]
    measured: Bool[np.ndarray, "*t h w"]
    derived: dict[object, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The pictures and stored depths of a sample's cameras, with their common intrinsics.

    Attributes:
        source: The camera whose pixels have the disparity.
        targets: The cameras that it is paired with.
        frames: The frame numbers, one for each place of the time axis.
        pictures: (t, 3, h, w) uint8 for each camera whose picture is wanted.
        depths: Stored depth for each camera whose depth is wanted.
        intrinsics: Of every camera, after what was done to the pictures.
        world: "as recorded", or "mirrored" (x negated) after a horizontal flip.
        padded: (h, w) bool, pixels of every view that are padding or were averaged with padding.
            They are never `measured`. None where no pixel is padding.
        erased: (h, w) bool for each camera whose picture was painted over: where.

    Raises:
        FieldError: If ``padded`` or ``erased`` is not of the pictures' size.
    """

    source: int
    targets: tuple[int, ...]
    frames: tuple[int, ...]
    pictures: dict[int, Any]
    depths: dict[int, StoredDepth]
    intrinsics: Intrinsics
    world: Literal["as recorded", "mirrored"] = "as recorded"
    padded: Bool[np.ndarray, "h w"] | None = None
    erased: dict[int, Bool[np.ndarray, "h w"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Require that `padded` and `erased` have the size of the pictures."""
        height_px, width_px = self.intrinsics.height_px, self.intrinsics.width_px
        for name, maps in (("padded", [self.padded]), ("erased", self.erased.values())):
            for pixels in maps:
                if pixels is not None and pixels.shape != (height_px, width_px):
                    raise FieldError(
                        f"`{name}` of the views has shape {pixels.shape}, their pictures are "
                        f"{height_px} pixels high and {width_px} wide: a transform that moves "
                        f"pictures must move `{name}` with them."
                    )

    def unseen(self, camera: int) -> Bool[np.ndarray, "h w"] | None:
        """Return where a picture does not show what its camera saw, None for nowhere."""
        maps = [pixels for pixels in (self.padded, self.erased.get(camera)) if pixels is not None]
        return np.logical_or.reduce(maps) if maps else None


@dataclass(slots=True, eq=False)
class SceneFacts:
    """What is known of a scene, for all of its samples.

    Attributes:
        scene: The row of the index.
        intrinsics: Of its pictures as they are decoded, before a transform.
        encodings: The depth encoding of each camera.
        url: Returns what holds one of its files: a shard, or the scene's folder.
        videos: The videos that were opened for it, where it is behind a URL without an index.
        poses: Its `CameraPoses`; None until they were read, or where nothing needs them.
    """

    scene: Scene
    intrinsics: Intrinsics
    encodings: dict[int, DepthEncoding]
    url: Callable[[str], str]
    videos: frozenset[str] = frozenset()
    poses: Any = None

    @property
    def is_rectified(self) -> bool:
        """Whether the closed form of disparity holds for this rig."""
        return self.scene.rig_residual_px <= RECTIFIED_PX


T = TypeVar("T")


def once(make: Callable[[Any], T]) -> T:
    """Return a property whose value is kept in its holder's dictionary ``made``.

    It is typed as what it gives. torch.compile cannot trace functools' one before 3.12.
    """
    name = make.__name__

    def get(holder: Any) -> T:
        if name not in holder.made:
            holder.made[name] = make(holder)
        return cast("T", holder.made[name])

    return cast("T", property(get, doc=make.__doc__))


class ViewPairMaps:
    """What follows from the depth of source views for one target view each.

    Maps are (..., h, w): numpy arrays of one pair, or tensors of many. Disparity is
    u_source - u_target in pixels.

    Attributes:
        is_rectified: Whether disparity is the closed form; else points go through the poses.
        is_inverse: Whether a stored number is proportional to the inverse of depth.
        measured: Where the source's depth was measured.
        depth_m: The source's depth along the optical axis, 0 where it was not measured.
        disparity: Disparity in pixels, 0 where it is not `known`.
        unit_m: Metres in a stored unit of the source: of one pair or of each.
        shift_px_m: Focal length in pixels times signed baseline, likewise.
        homography: What `project_by_homography` takes, of a rig that is not rectified.
        coarser: Returns the larger of two units, of one pair or of each.
        made: What was made once.
    """

    is_rectified: bool
    is_inverse: bool
    measured: Any
    depth_m: Any
    disparity: Any
    unit_m: Any
    shift_px_m: Any
    homography: tuple[Any, Any]
    coarser: Callable[[Any, Any], Any] = staticmethod(max)

    def __init__(self) -> None:
        """Compute nothing yet."""
        self.made: dict[str, Any] = {}

    def broadcast_to_maps(self, numbers: Any, *, like: Any) -> Any:
        """Return numbers of one pair or of each as they are broadcast to maps like these."""
        del like
        return numbers

    @once
    def known(self) -> Any:
        """Where disparity is known: depth was measured, and the target's plane is behind the point.

        Only on a rig that is not rectified can a point lie on or behind that plane, or at infinity.
        """
        if self.is_rectified:
            return self.measured
        return array_namespace(self.measured).isfinite(self.projection.u_px) & self.measured

    @once
    def projection(self) -> Projection:
        """Where each source pixel lands in the target."""
        if self.is_rectified:
            return project_rectified(self.depth_m, self.disparity)
        return project_by_homography(as_float64(self.depth_m), *self.homography)

    @property
    def moved_px(self) -> Any:
        """Disparity by the projection, in float64."""
        xp = array_namespace(self.depth_m)
        u_px, _ = pixel_centres(self.depth_m, dtype=xp.float64)
        return xp.where(self.known, u_px - self.projection.u_px, 0.0)

    def quantum_m(self, target: "ViewPairMaps") -> Any:
        """Return the coarser step between depths that the two cameras can store."""
        if self.is_inverse:
            return self.depth_m**2 / self.broadcast_to_maps(self.unit_m, like=self.depth_m)
        return self.broadcast_to_maps(
            self.coarser(self.unit_m, target.unit_m), like=self.projection.depth_m
        )

    @once
    def disparity_error(self) -> Any:
        """How far quantised depth can put disparity off, in pixels; 0 where it is not known."""
        shift_px_m = abs(self.shift_px_m)
        if self.is_inverse:
            known = array_namespace(self.known).astype(self.known, self.depth_m.dtype)
            return known * self.broadcast_to_maps(shift_px_m / self.unit_m / 2, like=self.depth_m)
        bound_px = disparity_error_px(
            self.depth_m,
            shift_px_m=self.broadcast_to_maps(shift_px_m, like=self.depth_m),
            half_step_m=self.broadcast_to_maps(self.unit_m / 2, like=self.depth_m),
        )
        return bound_px if self.is_rectified else bound_px * self.known

    @once
    def visible_from_source(self) -> Any:
        """What is visible in the target, decided by the source's own depth alone."""
        return visible_from_source(
            self.projection, measured=self.measured, quantum_m=self.quantum_m(self)
        )

    def visible(self, target: "ViewPairMaps") -> Any:
        """Return what is visible in the target, by the depth of the way back."""
        return visible_in_target(
            self.projection,
            measured=self.measured,
            target_depth_m=target.depth_m,
            target_measured=target.measured,
            quantum_m=self.quantum_m(target),
        )


class PairGeometry(ViewPairMaps):
    """Geometry from a source camera's depth to a target camera. Maps are (t, h, w).

    Attributes:
        encoding: The depth encoding of the source.
    """

    def __init__(self, views: Views, facts: SceneFacts, *, source: int, target: int) -> None:
        """Take the views of both cameras; nothing is computed yet."""
        super().__init__()
        self._views = views
        self._facts = facts
        self._source = source
        self._target = target
        self.encoding = facts.encodings[source]
        self.is_rectified = facts.is_rectified
        self.is_inverse = self.encoding.form == "inverse"

    @property
    def stored(self) -> StoredDepth:
        """The source camera's depth as it is stored."""
        return self._views.depths[self._source]

    @property
    def no_depth(self) -> int:
        """The number that stands for "not measured" in `stored_numbers`; -1 where there is none."""
        numbers = self.encoding.no_depth
        # No pixel format has a measured 65535 where its largest number means "not measured".
        known = [number for number in numbers if number != "max" and 0 <= number < 2**16]
        if 0 in known:
            return 0
        return 2**16 - 1 if "max" in numbers else min(known, default=-1)

    @property
    def stored_numbers(self) -> UInt16[np.ndarray, "t h w"]:
        """The source's depth as it is stored, with one number for all that was not measured.

        Raises:
            FieldError: If a transform padded or painted over the pictures, which these numbers
                cannot say; or if pixels were not measured and the contract has no number for it.
        """
        camera = self.stored
        if self._views.padded is not None or self._views.erased:
            raise FieldError(
                f"{self._facts.scene.id.key}: stored_depth does not tell which pixels are padding "
                "or were erased: leave out Letterbox and Eraser, or ask StereoPairs for fields."
            )
        if camera.measured.all():
            return camera.units
        if self.no_depth < 0:
            raise FieldError(
                f"{self._facts.scene.id.key}: depth of camera {self._source} is not measured "
                f"everywhere, and the contract has no number for that, no_depth="
                f"{self.encoding.no_depth!r}: name one that is not in use."
            )
        return np.where(camera.measured, camera.units, np.uint16(self.no_depth))

    @once
    def baseline_m(self) -> float:
        """The recorded baseline, negative where the target stands to the left; 0 for itself."""
        if self._target == self._source:
            return 0.0
        lateral_m = self._facts.scene.lateral_m
        to_the_right = lateral_m[self._target] > lateral_m[self._source]
        if self._views.world == "mirrored":
            to_the_right = not to_the_right
        recorded_m = self._facts.scene.rig.baseline_cm(self._source, self._target) / 100
        return recorded_m if to_the_right else -recorded_m

    @once
    def unit_m(self) -> float:
        """Metres in a stored unit."""
        return self.encoding.known_unit_m

    @once
    def shift_px_m(self) -> float:
        """Focal length in pixels times signed baseline."""
        return self._views.intrinsics.fx_px * self.baseline_m

    @once
    def measured(self) -> MapBool:
        """Where depth was measured."""
        return self.stored.measured

    @once
    def depth_m(self) -> MapF32:
        """Depth along the optical axis, 0 where not measured; computed once for all pairs."""
        derived, key = self.stored.derived, ("depth_m", self._views.intrinsics)
        if key not in derived:
            derived[key] = depth_m_from_units(
                self.stored.units,
                measured=self.stored.measured,
                encoding=self.encoding,
                intrinsics=self._views.intrinsics,
            )
        depth_m: MapF32 = derived[key]
        return depth_m

    @once
    def disparity(self) -> MapF32:
        """Disparity in pixels, 0 where it is not known."""
        disparity = np.empty(self.stored.units.shape, dtype=np.float32)
        self.write_disparity(disparity)
        return disparity

    def write_disparity(self, out: MapF32, *, sign: Literal[1, -1] = 1) -> None:
        """Write disparity, times a sign, into an array."""
        if "disparity" in self.made:
            np.multiply(self.disparity, np.float32(sign), out=out)
        elif not self.is_rectified:
            np.multiply(self.moved_px, sign, out=out, casting="same_kind")
        elif self.encoding.kind == "ray" or self.encoding.offset_m:
            rig = {"focal_px": self._views.intrinsics.fx_px, "baseline_m": self.baseline_m}
            np.multiply(disparity_from_depth(self.depth_m, **rig), np.float32(sign), out=out)
        else:
            measured = self.stored.measured
            if 0 not in self.encoding.no_depth and self.encoding.form == "depth":
                # By this contract a stored 0 was measured; its disparity is 0.
                measured = measured & (self.stored.units != 0)
            write_disparity(
                out,
                self.stored.units,
                measured=measured,
                shift_units=sign * self.shift_px_m / self.unit_m,
                form=self.encoding.form,
            )

    @once
    def homography(self) -> tuple[Any, Any]:
        """(t, 3, 3) and (t, 3): what takes pixels and depth to the target, at each frame."""
        camera = self._views.intrinsics
        moved = [homography(camera, camera, each) for each in self.target_from_source]
        homographies, steps = (np.stack(part) for part in zip(*moved, strict=True))
        return homographies, steps

    @once
    def target_from_source(self) -> Motions:
        """Source camera's coordinates to the target camera's, in metres."""
        poses, views = self._facts.poses, self._views
        way = {"target": self._target, "source": self._source}
        return _as_seen([poses.cam_from_cam(frame, **way) for frame in views.frames], views)

    @property
    def assumed_motion(self) -> Motions:
        """`target_from_source`; of a rectified rig what its closed form assumes, without poses."""
        if not self.is_rectified:
            return self.target_from_source
        motions: Motions = np.tile(np.eye(4), (len(self._views.frames), 1, 1))
        motions[:, 0, 3] = -self.baseline_m
        return motions

    @once
    def visible_from_source(self) -> MapBool:
        """What is visible in the target, decided by the source's own depth alone."""
        return self._shown_in_both(super().visible_from_source)

    def visible(self, target: ViewPairMaps) -> MapBool:
        """Return what is visible in the target, by the depth of the target's own geometry."""
        return self._shown_in_both(super().visible(target))

    def _shown_in_both(self, visible: MapBool) -> MapBool:
        """Return what is visible, where both pictures show what their cameras saw."""
        here, there = self._views.unseen(self._source), self._views.unseen(self._target)
        if there is not None:
            height_px, width_px = there.shape
            _, pixel = landing_pixels(self.projection, height_px=height_px, width_px=width_px)
            visible = visible & ~take_flat(np.broadcast_to(there, visible.shape), pixel)
        return visible if here is None else visible & ~here

    @once
    def splatted(self) -> tuple[Any, MapBool]:
        """The source picture in the target's view, and the holes in it."""
        return self._splat(self._views.pictures[self._source])

    def _splat(self, pictures: Any) -> tuple[Any, MapBool]:
        warped, hole = splat(pictures, self.projection, measured=self.stored.measured)
        padded = self._views.padded
        return (warped, hole) if padded is None else (warped * ~padded, hole | padded)

    @once
    def hole(self) -> MapBool:
        """Target pixels on which no source pixel lands."""
        if self._source in self._views.pictures:
            return self.splatted[1]
        blank = np.zeros((len(self.depth_m), 1, *self.depth_m.shape[-2:]), dtype=np.uint8)
        return self._splat(blank)[1]


def _as_seen(transforms: list[Float64[np.ndarray, "4 4"]], views: Views) -> Motions:
    """Return motions in the world that the views show, which a flip has mirrored."""
    motions: Motions = np.stack(transforms)
    return motions if views.world == "as recorded" else MIRROR_X @ motions @ MIRROR_X


@dataclass(eq=False)
class PairSample:
    """One source and one target of a sample, with the geometry of both directions.

    Attributes:
        views: Some of its frames.
        facts: What is known of its scene.
        address: Its cameras before a transform, and all its frames.
        target: The target camera.
    """

    views: Views
    facts: SceneFacts
    address: Address
    target: int

    @cached_property
    def forward(self) -> PairGeometry:
        """From the source to the target."""
        return PairGeometry(self.views, self.facts, source=self.views.source, target=self.target)

    @cached_property
    def backward(self) -> PairGeometry:
        """From the target to the source."""
        return PairGeometry(self.views, self.facts, source=self.target, target=self.views.source)

    @cached_property
    def valid(self) -> MapBool:
        """Where the source's disparity to each target of the sample is known."""
        known: MapBool = self.forward.known
        others = [target for target in self.views.targets if target != self.target]
        for target in [] if self.facts.is_rectified else others:
            way = PairGeometry(self.views, self.facts, source=self.views.source, target=target)
            known = known & way.known
        return known

    @property
    def to_each_view(self) -> list[PairGeometry]:
        """From the target to every view of the sample, the target itself too."""
        return [
            PairGeometry(self.views, self.facts, source=self.target, target=camera)
            for camera in (self.views.source, *self.views.targets)
        ]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, height and width of the sample's maps."""
        intrinsics = self.views.intrinsics
        return len(self.views.frames), intrinsics.height_px, intrinsics.width_px

    @property
    def frame_rate_hz(self) -> float:
        """Frames of the sample a second: the video's rate, divided by the stride of a clip."""
        frames = self.address.frames
        stride = frames[1] - frames[0] if len(frames) > 1 else 1
        return self.facts.scene.frame_rate_hz / stride

    @property
    def key(self) -> str:
        """Scene, cameras and frames: scene/00-01/017, or scene/00-01/016-031 for a clip."""
        cameras = f"{self.views.source:02d}"
        if self.views.targets:
            cameras += "-" + "+".join(f"{target:02d}" for target in self.views.targets)
        first, last = self.address.frames[0], self.address.frames[-1]
        shown = f"{first:03d}" if first == last else f"{first:03d}-{last:03d}"
        return f"{self.facts.scene.id.key}/{cameras}/{shown}"

    @property
    def url(self) -> str:
        """The shard, or the scene's folder, that holds the source's picture."""
        return self.facts.url(rgb_name(self.address.source))

    def world_from(self, camera: int) -> Motions:
        """Return a camera's poses at the sample's frames."""
        poses, views = self.facts.poses, self.views
        return _as_seen([poses.world_from_cam(frame, camera) for frame in views.frames], views)
