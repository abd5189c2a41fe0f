"""The fields of a sample, as data: name, shape, dtype, unit, meaning, and what each is made from.

Shapes are of one frame. A clip puts a time axis T in front; a sweep puts an axis of targets in
front of that, in the fields that depend on the target.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import FieldError

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
        shape: The shape of one frame, in words.
        dtype: The numpy dtype, or "str".
        meaning: What it holds, with its unit.
        streams: The videos that it is made from.
        needs_poses: "always", or "unless rectified": only where the rig is not, or "never".
        per_target: Whether a sweep has one for each target.
        per_frame: Whether a clip has one for each frame.
    """

    shape: str
    dtype: str
    meaning: str
    streams: frozenset[Stream] = NOTHING
    needs_poses: Literal["always", "unless rectified", "never"] = "never"
    per_target: bool = False
    per_frame: bool = True


def _map(dtype: str, meaning: str, streams: frozenset[Stream]) -> Field:
    """Return a field of the projection from source to target."""
    return Field("(1,H,W)", dtype, meaning, streams, "unless rectified", per_target=True)


PAIR_FIELDS: Final[dict[str, Field]] = {
    "left": Field("(3,H,W)", "uint8", "RGB of the first view", SOURCE_RGB),
    "right": Field("(3,H,W)", "uint8", "RGB of the second view", TARGET_RGB, per_target=True),
    "disparity": _map(
        "float32", "px at this resolution, x_right = x_left - d; 0 where not valid", SOURCE_DEPTH
    ),
    "valid": Field("(1,H,W)", "bool", "depth was measured there", SOURCE_DEPTH),
    "visible": _map(
        "bool",
        "valid, inside the second view and not hidden there, by the second view's own depth",
        SOURCE_DEPTH | TARGET_DEPTH,
    ),
    "visible_from_left": _map(
        "bool",
        "the same by the first view's depth alone: blind to what only the second view sees",
        SOURCE_DEPTH,
    ),
    "disparity_error": _map(
        "float32", "bound on the error of disparity from the depth's quantum, px", SOURCE_DEPTH
    ),
    "depth": Field(
        "(1,H,W)", "float32", "m along the optical axis; 0 where not valid", SOURCE_DEPTH
    ),
    "depth_right": Field(
        "(1,H,W)", "float32", "depth of the second view", TARGET_DEPTH, per_target=True
    ),
    "disparity_right": _map(
        "float32", "of the second view's pixels, x_left = x_right + d", TARGET_DEPTH
    ),
    "valid_right": Field(
        "(1,H,W)",
        "bool",
        "depth of the second view was measured there",
        TARGET_DEPTH,
        per_target=True,
    ),
    "visible_right": _map(
        "bool", "pixels of the second view that the first one sees", SOURCE_DEPTH | TARGET_DEPTH
    ),
    "warped_right": Field(
        "(3,H,W)",
        "uint8",
        "the first view splatted into the second, nearest wins; 0 in holes",
        SOURCE_RGB | SOURCE_DEPTH,
        "unless rectified",
        per_target=True,
    ),
    "hole": _map("bool", "pixels of warped_right on which nothing landed", SOURCE_DEPTH),
    "intrinsics": Field(
        "(3,3)", "float64", "of every view, px, after resizing and cropping", per_frame=False
    ),
    "baseline_m": Field(
        "()",
        "float64",
        "m; negative if the second view is to the left",
        per_target=True,
        per_frame=False,
    ),
    "right_from_left": Field(
        "(4,4)",
        "float64",
        "first camera's coordinates to the second's, m, x right y down z ahead",
        needs_poses="always",
        per_target=True,
    ),
    "world_from_left": Field(
        "(4,4)", "float64", "first camera's coordinates to the world's, m", needs_poses="always"
    ),
    "frame_index": Field("()", "int64", "number of the frame in its video"),
    "pair": Field("(2,)", "int64", "numbers of the two cameras", per_target=True, per_frame=False),
    "scene": Field("", "str", "key of the scene", per_frame=False),
    "family": Field("", "str", "baseline family", per_frame=False),
    "map": Field("", "str", "map", per_frame=False),
    "split": Field("", "str", "train or eval", per_frame=False),
    "subset": Field("", "str", "seen_map or unseen_map; empty for train", per_frame=False),
    "caption": Field(
        "", "str", "machine-written description; empty where there is none", per_frame=False
    ),
    "__key__": Field("", "str", "scene, cameras and frame", per_frame=False),
    "__url__": Field("", "str", "file or folder that holds the scene", per_frame=False),
}

VIEW_FIELDS: Final[dict[str, Field]] = {
    "image": Field("(3,H,W)", "uint8", "RGB", SOURCE_RGB | TARGET_RGB, per_target=True),
    "depth": Field(
        "(1,H,W)", "float32", "m along the optical axis; 0 where not valid",
        SOURCE_DEPTH | TARGET_DEPTH, per_target=True,
    ),
    "valid": Field(
        "(1,H,W)", "bool", "depth was measured there", SOURCE_DEPTH | TARGET_DEPTH, per_target=True
    ),
    "intrinsics": PAIR_FIELDS["intrinsics"],
    "focal_mm": Field("()", "float64", "focal length, mm", per_frame=False),
    "world_from_cam": Field(
        "(4,4)", "float64", "camera's coordinates to the world's, m", needs_poses="always",
        per_target=True,
    ),
    "first_from_cam": Field(
        "(4,4)", "float64", "camera's coordinates to the first camera's, m", needs_poses="always",
        per_target=True,
    ),
    "camera": Field("()", "int64", "number of the camera", per_target=True, per_frame=False),
    **{
        name: PAIR_FIELDS[name]
        for name in (
            "frame_index", "scene", "family", "map", "split", "subset", "caption", "__key__",
            "__url__",
        )
    },
}  # fmt: skip

DEFAULT_PAIR_FIELDS: Final = (
    "left", "right", "disparity", "valid", "intrinsics", "baseline_m", "frame_index", "pair",
    "scene", "__key__",
)  # fmt: skip
DEFAULT_VIEW_FIELDS: Final = (
    "image", "depth", "valid", "intrinsics", "world_from_cam", "camera", "frame_index", "scene",
    "__key__",
)  # fmt: skip


def require_fields(names: Iterable[str], *, known: dict[str, Field]) -> tuple[str, ...]:
    """Return field names as a tuple, in the order given.

    Raises:
        FieldError: If there is none, one is unknown, or one is named twice.
    """
    asked = (names,) if isinstance(names, str) else tuple(names)
    unknown = [name for name in asked if name not in known]
    if unknown:
        raise FieldError(f"there is no field {unknown[0]!r}; the fields are {', '.join(known)}.")
    if not asked or len(set(asked)) < len(asked):
        raise FieldError(f"fields must be at least one and each only once, got {asked!r}.")
    return asked


def streams_of(names: Iterable[str], *, known: dict[str, Field]) -> frozenset[Stream]:
    """Return the videos that the named fields are made from."""
    return frozenset().union(*(known[name].streams for name in names))
