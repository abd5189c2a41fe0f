"""The fields of a sample: the one table that says what each is, what it needs and how it is made.

Shapes are of one frame. A clip puts a time axis T in front; a sweep puts an axis of targets in
front of that, in the fields that depend on the target. A new field is a new row here.

`Request` is what a dataset asks of every sample, `SampleWriter` writes it. The size of pictures is
(height, width), as arrays have it; texts have WIDTHxHEIGHT.
"""

import re
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from multiprocessing.context import get_spawning_popen
from typing import Any, Final, Literal, Protocol, runtime_checkable

import numpy as np

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.derive import MapF32, PairSample, SceneFacts, Views
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.plan import Address
from stereogenbench_data.selection.spelling import did_you_mean

Sample = dict[str, Any]
"""A flat dict of arrays (tensors, once in torch's hands) and texts, by the names of fields."""

Stream = Literal["source_rgb", "target_rgb", "source_depth", "target_depth"]

SOURCE_RGB: Final = frozenset[Stream]({"source_rgb"})
TARGET_RGB: Final = frozenset[Stream]({"target_rgb"})
SOURCE_DEPTH: Final = frozenset[Stream]({"source_depth"})
TARGET_DEPTH: Final = frozenset[Stream]({"target_depth"})
NOTHING: Final = frozenset[Stream]()


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a sample.

    Attributes:
        name: Its key in the sample.
        dtype: The numpy dtype, or "str".
        shape: The shape of one frame, in words.
        meaning: What it holds, with its unit: one sentence of the documentation.
        make: Returns the field of one target, of the frames at hand: an array, with a time axis in
            front where ``per_frame``, or a text.
        write: Writes it into float32 (t, h, w) instead: for maps too large to be copied.
        streams: The videos that it is made from.
        needs_poses: "always", "unless rectified" (only where the rig is not), or "never".
        held_up_by: What makes the field impossible where it is not understood (`REMARKS`).
        per_target: Whether a sweep has one for each target.
        per_frame: Whether a clip has one for each frame.
        picture_of: Whose picture it is, exactly as decoded, so that the decoder can write the
            field.
    """

    name: str
    dtype: str
    shape: str
    meaning: str
    make: Callable[[PairSample], Any] | None = field(default=None, repr=False)
    write: Callable[[PairSample, MapF32], None] | None = field(default=None, repr=False)
    streams: frozenset[Stream] = NOTHING
    needs_poses: Literal["always", "unless rectified", "never"] = "never"
    held_up_by: tuple[str, ...] = ()
    per_target: bool = False
    per_frame: bool = True
    picture_of: Literal["source", "target"] | None = None

    @property
    def stopped_by(self) -> tuple[str, ...]:
        """All remarks that make it impossible: what needs a rig needs its sides, too."""
        return (*self.held_up_by, *(() if self.needs_poses == "never" else ("left",)))


def _table(*fields: Field) -> dict[str, Field]:
    return {each.name: each for each in fields}


def _text(name: str, meaning: str, make: Callable[[PairSample], str]) -> Field:
    return Field(name, "str", "", meaning, make=make, per_frame=False)


PAIR_FIELDS: Final[dict[str, Field]] = _table(
    Field(
        "left", "uint8", "(3,H,W)", "RGB of the first view",
        make=lambda s: s.views.pictures[s.views.source],
        streams=SOURCE_RGB, picture_of="source",
    ),
    Field(
        "right", "uint8", "(3,H,W)", "RGB of the second view",
        make=lambda s: s.views.pictures[s.target],
        streams=TARGET_RGB, per_target=True, picture_of="target",
    ),
    Field(
        "disparity", "float32", "(1,H,W)",
        "px at this resolution, x_right = x_left - d; 0 where not valid",
        write=lambda s, out: s.forward.write_disparity(out),
        streams=SOURCE_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "valid", "bool", "(1,H,W)",
        "depth was measured there, and no second view has the point behind it",
        make=lambda s: s.valid[:, None],
        streams=SOURCE_DEPTH, needs_poses="unless rectified",
    ),
    Field(
        "visible", "bool", "(1,H,W)",
        "valid, inside the second view and not hidden there, by the second view's own depth",
        make=lambda s: s.forward.visible(s.backward)[:, None],
        streams=SOURCE_DEPTH | TARGET_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "visible_from_left", "bool", "(1,H,W)",
        "the same by the first view's depth alone: misses occluders that only the second view sees",
        make=lambda s: s.forward.visible_from_source[:, None],
        streams=SOURCE_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "disparity_error", "float32", "(1,H,W)",
        "bound on the error of disparity from the depth's quantum, px",
        make=lambda s: s.forward.disparity_error[:, None],
        streams=SOURCE_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "depth", "float32", "(1,H,W)", "m along the optical axis; 0 where not measured",
        make=lambda s: s.forward.depth_m[:, None],
        streams=SOURCE_DEPTH,
    ),
    Field(
        "depth_right", "float32", "(1,H,W)", "depth of the second view",
        make=lambda s: s.backward.depth_m[:, None],
        streams=TARGET_DEPTH, per_target=True,
    ),
    Field(
        "disparity_right", "float32", "(1,H,W)",
        "of the second view's pixels, x_left = x_right + d; 0 where not valid_right",
        write=lambda s, out: s.backward.write_disparity(out, sign=-1),
        streams=TARGET_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "valid_right", "bool", "(1,H,W)",
        "depth of the second view was measured there, and the first has the point ahead of it",
        make=lambda s: s.backward.known[:, None],
        streams=TARGET_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "visible_right", "bool", "(1,H,W)", "pixels of the second view that the first one sees",
        make=lambda s: s.backward.visible(s.forward)[:, None],
        streams=SOURCE_DEPTH | TARGET_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "warped_right", "uint8", "(3,H,W)",
        "the first view splatted into the second, nearest wins; 0 in holes",
        make=lambda s: s.forward.splatted[0],
        streams=SOURCE_RGB | SOURCE_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "hole", "bool", "(1,H,W)", "pixels of warped_right on which nothing landed",
        make=lambda s: s.forward.hole[:, None],
        streams=SOURCE_DEPTH, needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "intrinsics", "float64", "(3,3)", "of every view, px, after resizing and cropping",
        make=lambda s: s.views.intrinsics.matrix(),
        per_frame=False, held_up_by=("principal point",),
    ),
    Field(
        "baseline_m", "float64", "()", "m; negative if the second view is to the left",
        make=lambda s: np.float64(s.forward.baseline_m),
        per_target=True, per_frame=False, held_up_by=("left",),
    ),
    Field(
        "right_from_left", "float64", "(4,4)",
        "first camera's coordinates to the second's, m, x right y down z ahead",
        make=lambda s: s.forward.target_from_source,
        needs_poses="always", per_target=True, held_up_by=("poses",),
    ),
    Field(
        "world_from_left", "float64", "(4,4)", "first camera's coordinates to the world's, m",
        make=lambda s: s.world_from(s.views.source),
        needs_poses="always", held_up_by=("poses", "world"),
    ),
    Field(
        "frame_index", "int64", "()", "number of the frame in its video",
        make=lambda s: np.array(s.views.frames, dtype=np.int64),
    ),
    Field(
        "frame_rate_hz", "float64", "()",
        "frames a second: the video's, of a clip divided by its stride; 0 if the file has none",
        make=lambda s: np.float64(s.frame_rate_hz), per_frame=False,
    ),
    Field(
        "pair", "int64", "(2,)", "numbers of the two cameras",
        make=lambda s: np.array([s.views.source, s.target], dtype=np.int64),
        per_target=True, per_frame=False,
    ),
    _text("scene", "key of the scene", lambda s: s.facts.scene.id.key),
    _text("family", "baseline family", lambda s: s.facts.scene.id.family),
    _text("map", "map", lambda s: s.facts.scene.id.map_name),
    _text("split", "train or eval", lambda s: s.facts.scene.id.split),
    _text(
        "subset", "seen_map or unseen_map; empty for train",
        lambda s: s.facts.scene.id.subset or "",
    ),
    _text(
        "caption", "machine-written description; empty where there is none",
        lambda s: s.facts.scene.caption,
    ),
    _text("__key__", "scene, cameras and frame", lambda s: s.key),
    _text("__url__", "file or folder that holds the scene", lambda s: s.url),
)  # fmt: skip

VIEW_FIELDS: Final[dict[str, Field]] = _table(
    Field(
        "image", "uint8", "(3,H,W)", "RGB",
        make=lambda s: s.views.pictures[s.target],
        streams=SOURCE_RGB | TARGET_RGB, per_target=True, picture_of="target",
    ),
    Field(
        "depth", "float32", "(1,H,W)", "m along the optical axis; 0 where not valid",
        make=lambda s: s.backward.depth_m[:, None],
        streams=SOURCE_DEPTH | TARGET_DEPTH, per_target=True,
    ),
    Field(
        "valid", "bool", "(1,H,W)", "depth was measured there",
        make=lambda s: s.backward.stored.measured[:, None],
        streams=SOURCE_DEPTH | TARGET_DEPTH, per_target=True,
    ),
    PAIR_FIELDS["intrinsics"],
    Field(
        "focal_mm", "float64", "()", "focal length, mm",
        make=lambda s: np.float64(s.facts.scene.rig.focal_mm), per_frame=False,
        held_up_by=("sensor",),
    ),
    Field(
        "world_from_cam", "float64", "(4,4)", "camera's coordinates to the world's, m",
        make=lambda s: s.world_from(s.target),
        needs_poses="always", per_target=True, held_up_by=("poses", "world"),
    ),
    Field(
        "first_from_cam", "float64", "(4,4)", "camera's coordinates to the first camera's, m",
        make=lambda s: s.backward.target_from_source,
        needs_poses="always", per_target=True, held_up_by=("poses",),
    ),
    Field(
        "stored_depth", "uint16", "(1,H,W)",
        "depth as the file stores it, for `derive`; `no_depth` where not valid",
        make=lambda s: s.backward.stored_numbers[:, None],
        streams=SOURCE_DEPTH | TARGET_DEPTH, per_target=True,
    ),
    Field(
        "no_depth", "int64", "()", "the number in stored_depth that means not valid; -1 if none",
        make=lambda s: np.int64(s.backward.no_depth), per_target=True, per_frame=False,
    ),
    Field(
        "depth_unit_m", "float64", "()",
        "m in a stored unit of depth; of inverse depth, the depth of the number 1",
        make=lambda s: np.float64(s.backward.encoding.known_unit_m),
        per_target=True, per_frame=False,
    ),
    Field(
        "depth_offset_m", "float64", "()", "m, the depth of the stored number 0",
        make=lambda s: np.float64(s.backward.encoding.offset_m),
        per_target=True, per_frame=False,
    ),
    _text(
        "depth_kind", "planar or ray: what stored depth measures",
        lambda s: s.forward.encoding.kind,
    ),
    _text(
        "depth_form",
        "depth or inverse: what a stored number is proportional to; ranged if depth has an offset",
        lambda s: "ranged" if s.forward.encoding.offset_m else s.forward.encoding.form,
    ),
    _text(
        "rig", "rectified, or posed where disparity needs the poses",
        lambda s: "rectified" if s.facts.is_rectified else "posed",
    ),
    Field(
        "baselines_m", "float64", "(V,)",
        "m from this camera to each view's; negative if that stands to the left",
        make=lambda s: np.array([way.baseline_m for way in s.to_each_view]),
        per_target=True, per_frame=False, held_up_by=("left",),
    ),
    Field(
        "cams_from_cam", "float64", "(V,4,4)",
        "camera's coordinates to each view's camera's, m; of a rectified rig, a pure shift",
        make=lambda s: np.stack([way.assumed_motion for way in s.to_each_view], axis=1),
        needs_poses="unless rectified", per_target=True,
    ),
    Field(
        "camera", "int64", "()", "number of the camera",
        make=lambda s: np.int64(s.target), per_target=True, per_frame=False,
    ),
    *(
        PAIR_FIELDS[name]
        for name in (
            "frame_index", "frame_rate_hz", "scene", "family", "map", "split", "subset", "caption",
            "__key__", "__url__",
        )
    ),
)  # fmt: skip

DEFAULT_PAIR_FIELDS: Final = (
    "left", "right", "disparity", "valid", "intrinsics", "baseline_m", "frame_index", "pair",
    "scene", "__key__",
)  # fmt: skip
DEFAULT_VIEW_FIELDS: Final = (
    "image", "depth", "valid", "intrinsics", "world_from_cam", "camera", "frame_index", "scene",
    "__key__",
)  # fmt: skip


Clip = Literal["frame", "clip"]
Kind = Literal["pairs", "views"]
Layout = Literal["single", "stacked"]


@runtime_checkable
class Transform(Protocol):
    """A function that changes pictures and cameras together."""

    @property
    def swaps_views(self) -> bool:
        """Whether source and target may change places: what one needs is then read of both."""

    def __call__(self, views: Views, generator: np.random.Generator) -> Views:
        """Return the changed views."""


@dataclass(frozen=True, slots=True)
class Request:
    """What a dataset asks of every sample.

    Attributes:
        kind: "pairs" (fields of `PAIR_FIELDS`) or "views" (of `VIEW_FIELDS`).
        fields: The fields, in order.
        layout: "single": of one target; "stacked": with an axis of targets in front.
        size: (height, width) to which the decoder scales, None for the stored size.
        depth: A depth encoding that overrides what the index says, or None.
        transform: What changes the views before fields are derived, or None.
    """

    kind: Kind
    fields: tuple[str, ...]
    layout: Layout
    size: tuple[int, int] | None = None
    depth: DepthEncoding | None = None
    transform: Transform | None = None

    @property
    def known(self) -> dict[str, Field]:
        """The table of fields of this kind of sample."""
        return PAIR_FIELDS if self.kind == "pairs" else VIEW_FIELDS

    @property
    def streams(self) -> frozenset[Stream]:
        """The videos that the fields are made from, before or after a swap of the views."""
        streams = NOTHING.union(*(self.known[name].streams for name in self.fields))
        if self.transform is not None and self.transform.swaps_views:
            for kind in (SOURCE_RGB | TARGET_RGB, SOURCE_DEPTH | TARGET_DEPTH):
                streams |= kind if streams & kind else NOTHING
        return streams


def parse_request(
    kind: Kind,
    layout: Layout,
    *,
    fields: Iterable[str],
    options: Mapping[str, Any],
) -> Request:
    """Return what a user asks of every sample; of the options, size, depth and transform.

    Raises:
        FieldError: If a field does not exist, is named twice, or none is named; if the size is not
            two whole numbers of 1 to 16384; if depth is not a `DepthEncoding`; or if the transform
            cannot be called, lacks ``swaps_views``, or swaps the views of samples that are not
            pairs.
    """
    known = PAIR_FIELDS if kind == "pairs" else VIEW_FIELDS
    names = (fields,) if isinstance(fields, str) else tuple(fields)
    unknown = [name for name in names if name not in known]
    if unknown:
        hint = did_you_mean(str(unknown[0]), known)
        raise FieldError(
            f"there is no field {unknown[0]!r}{hint} The fields are {', '.join(known)}."
        )
    if not names or len(set(names)) < len(names):
        raise FieldError(f"fields must be at least one and each only once, got {names!r}.")
    size, depth, transform = (options.get(name) for name in ("size", "depth", "transform"))
    if size is not None:
        size = require_size(size)
    if depth is not None and not isinstance(depth, DepthEncoding):
        raise FieldError(f"depth must be a DepthEncoding(...), got {depth!r}.")
    if transform is not None:
        says = isinstance(getattr(transform, "swaps_views", None), bool)
        if not says or not callable(transform) or isinstance(transform, type):
            raise FieldError(
                f"a transform is called with (views, generator) and has an attribute swaps_views, "
                f"True or False; got {transform!r}."
            )
        if kind == "views" and transform.swaps_views:
            raise FieldError(
                f"SceneViews takes no transform that swaps the two views of a pair, got "
                f"{transform!r}: leave it out."
            )
    return Request(kind, names, layout, size, depth, transform)


def require_importable(transform: Any) -> None:
    """Require that a process that is being spawned can import a transform's class.

    Such a process imports the script again, but no notebook and no interactive session.

    Raises:
        FieldError: If the class is of a notebook.
    """
    started = get_spawning_popen()
    if started is None or transform is None or hasattr(sys.modules["__main__"], "__file__"):
        return
    for step in getattr(transform, "steps", lambda: [transform])():
        if step.__module__ == "__main__":
            raise FieldError(
                f"the transform {step!r} is of this notebook, and worker processes of the start "
                f"method {started.method!r} cannot import it: move the class into a module (a .py "
                f"file beside the notebook), or load with num_workers=0."
            )


Allocate = Callable[[str, tuple[int, ...], Any], Any]
"""Returns the array that a field is written into, of a name, a shape and a dtype."""


def new_array(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
    """Return a new array for a field."""
    del name
    return np.empty(shape, dtype=dtype)


class SampleWriter:
    """Writes the fields of one sample, some frames at a time, into arrays that it allocates once.

    Attributes:
        sample: The fields so far.
    """

    def __init__(
        self, request: Request, address: Address, *, clip: Clip, allocate: Allocate
    ) -> None:
        """Begin a sample.

        Args:
            request: Its fields and their layout.
            address: Its cameras and frames.
            clip: "clip" where the fields have a time axis, else "frame".
            allocate: Returns the array of a field; called once for each.
        """
        self.sample: Sample = {}
        self._request, self._address, self._allocate = request, address, allocate
        known = request.known
        self._fields = [known[name] for name in request.fields]
        self._is_clip = clip == "clip"

    def pictures(self, frames: slice, *, size: tuple[int, int]) -> dict[int, Any]:
        """Return by camera where to decode pictures that are a field exactly as decoded.

        Args:
            frames: Which frames of the sample.
            size: Height and width of the pictures.
        """
        shape = (len(self._address.frames[frames]), 3, *size)
        found: dict[int, Any] = {}
        for each in self._fields:
            if each.picture_of is None:
                continue
            shown = self._target_cameras(self._address)
            if each.picture_of == "source":
                shown = (self._address.source,)
            for number, camera in enumerate(shown):
                found[camera] = self._part(each, number, frames, shape=shape, dtype="u1")
        return found

    def write(self, views: Views, facts: SceneFacts, frames: slice) -> None:
        """Write every field for some frames of the sample.

        Args:
            views: These frames.
            facts: What is known of their scene.
            frames: Where they lie on the sample's time axis.
        """
        pairs = [
            PairSample(views, facts, self._address, target)
            for target in self._target_cameras(views)
        ]
        for each in self._fields:
            for number, pair in enumerate(pairs if each.per_target else pairs[:1]):
                if each.write is not None:
                    count, height, width = pair.shape
                    shape = (count, 1, height, width)
                    part = self._part(each, number, frames, shape=shape, dtype="f4")
                    each.write(pair, part[:, 0])
                elif each.make is not None:
                    value = each.make(pair)
                    if each.dtype == "str":
                        self.sample[each.name] = value
                        continue
                    part = self._part(each, number, frames, shape=value.shape, dtype=value.dtype)
                    # A picture may have been decoded here.
                    if not np.may_share_memory(value, part):
                        np.copyto(part, value)

    def _target_cameras(self, of: Address | Views) -> tuple[int, ...]:
        """Return the cameras along the axis of targets: of views the first is the source itself."""
        return (of.source, *of.targets) if self._request.kind == "views" else of.targets

    def _part(
        self, field: Field, number: int, frames: slice, *, shape: tuple[int, ...], dtype: Any
    ) -> Any:
        """Return where a field of one target is written, for some frames.

        Args:
            field: The field, which is allocated if it is not yet.
            number: The place of the target on the axis of targets.
            frames: Which frames of the sample.
            shape: The shape of what is written, with a time axis in front if it is per frame.
            dtype: Its dtype.

        Returns:
            An array of that shape, a view of the whole field.
        """
        is_stacked = field.per_target and self._request.layout == "stacked"
        if field.name not in self.sample:
            whole = shape[1:] if field.per_frame else shape
            if field.per_frame and self._is_clip:
                whole = (len(self._address.frames), *whole)
            if is_stacked:
                whole = (len(self._target_cameras(self._address)), *whole)
            self.sample[field.name] = self._allocate(field.name, whole, np.dtype(dtype))
        own = self.sample[field.name]
        own = own[number, ...] if is_stacked else own
        if not field.per_frame:
            return own
        return own[frames] if self._is_clip else own[None]


LARGEST_SIDE_PX: Final = 16384

_LARGE_STRETCH: Final = 1.5
_TEXT: Final = re.compile(r"(\d+)x(\d+)", re.ASCII | re.IGNORECASE)


class OddSceneWarning(UserWarning):
    """Selected scenes differ from what the release promises: the message says how and which."""


class SwappedSizeWarning(UserWarning):
    """A size looks like (width, height), but (height, width) is expected."""


class EnlargedSizeWarning(UserWarning):
    """A size is larger than training shards store: pictures are enlarged, not sharpened."""


def require_size(size: Any) -> tuple[int, int]:
    """Return a (height, width) in pixels.

    Args:
        size: (height, width), or a text WIDTHxHEIGHT.

    Raises:
        FieldError: If it is not two whole numbers of 1 to 16384, nor such a text.

    >>> require_size("832x480")
    (480, 832)
    """
    sides = size
    if isinstance(size, str):
        match = _TEXT.fullmatch(size.strip())
        sides = (int(match[2]), int(match[1])) if match else ()
    try:
        height, width = (int(side) for side in sides)
        is_whole = (height, width) == tuple(sides)
    except (TypeError, ValueError):
        is_whole = False
    if not is_whole or not (0 < height <= LARGEST_SIDE_PX and 0 < width <= LARGEST_SIDE_PX):
        raise FieldError(
            f"size must be WIDTHxHEIGHT of 1 to {LARGEST_SIDE_PX} pixels, such as 832x480, or in "
            f"Python (height, width), got {size!r}."
        )
    return height, width


def warn_if_swapped(size: tuple[int, int], *, stored: tuple[int, int]) -> None:
    """Warn if a size turns wide pictures into high ones, or high into wide, by stretching them.

    Args:
        size: The requested (height, width) in pixels.
        stored: (height, width) in pixels of the stored pictures.

    A square picture counts as wide: the usual sizes are.
    """
    aspect, stored_aspect = size[1] / size[0], stored[1] / stored[0]
    stretch = max(aspect / stored_aspect, stored_aspect / aspect)
    is_turned = aspect < 1 <= stored_aspect or stored_aspect < 1 < aspect
    if is_turned and stretch >= _LARGE_STRETCH:
        warnings.warn(
            f"size {size!r} is (height, width), {size[1]} wide and {size[0]} high: the stored "
            f"pictures, {stored[1]} wide and {stored[0]} high, are stretched by {stretch:.2g}. "
            f"Did you mean size=({size[1]}, {size[0]}), on the command line "
            f"--size {size[0]}x{size[1]}?",
            SwappedSizeWarning,
            stacklevel=2,
        )
