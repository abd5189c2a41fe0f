"""The one table of spellings under which each quantity of the metadata is looked for.

What the release calls most of its quantities was not seen by the authors of this package, so each
has several names. They are written here in snake_case; ``snake_case``, ``camelCase`` and
``PascalCase`` are all looked for. The first spelling found wins; null counts as not found.

Source: the paper's appendix on the file schema and its loading example (the first names of each
row); the dataset viewer's columns; Unreal Engine's names for the same things.
"""

import itertools
from collections.abc import Iterable
from typing import Any, Final


def _within(parents: Iterable[str], *leaves: str) -> tuple[str, ...]:
    return tuple(f"{parent}.{leaf}" if parent else leaf for parent in parents for leaf in leaves)


_CAMERA = ("camera_intrinsics", "intrinsics", "camera", "")
_ASSET = ("", "assets", "asset_identifiers", "asset_ids")
_POSE = ("", "transform", "pose")

SPELLINGS: Final[dict[str, tuple[str, ...]]] = {
    # baseline.json: the camera
    "focal_mm": _within(
        _CAMERA, "focal_length_mm", "focal_length", "focal_mm", "current_focal_length"
    ),
    "sensor_width_mm": _within(
        _CAMERA,
        *("sensor_width_mm", "sensor_width", "filmback.sensor_width_mm", "filmback.sensor_width"),
        *("filmback.width_mm", "filmback.width", "filmback_width_mm", "filmback_width"),
    ),
    "sensor_height_mm": _within(
        _CAMERA,
        *("sensor_height_mm", "sensor_height", "filmback.sensor_height_mm"),
        *("filmback.sensor_height", "filmback.height_mm", "filmback.height"),
        *("filmback_height_mm", "filmback_height"),
    ),
    "image_width_px": _within(
        ("", "camera_intrinsics", "intrinsics", "camera"),
        *("image_width", "image_width_px", "image_size.width", "resolution.width"),
        *("resolution_x", "width_px", "width"),
    ),
    "image_height_px": _within(
        ("", "camera_intrinsics", "intrinsics", "camera"),
        *("image_height", "image_height_px", "image_size.height", "resolution.height"),
        *("resolution_y", "height_px", "height"),
    ),
    "principal_point_px": _within(
        _CAMERA,
        *("principal_point_px", "principal_point", "principal_point_override_px"),
        *("principal_point_override", "optical_center_px", "optical_center"),
    ),
    "principal_x_px": _within(
        _CAMERA, "principal_point_x_px", "principal_point_x", "cx_px", "cx", "c_x"
    ),
    "principal_y_px": _within(
        _CAMERA, "principal_point_y_px", "principal_point_y", "cy_px", "cy", "c_y"
    ),
    # baseline.json: the pairs
    "primary_pair": ("primary_stereo_pair", "primary_pair", "stereo_pair"),
    "left_camera": ("left_camera", "left_camera_index", "left_camera_name", "left"),
    "right_camera": ("right_camera", "right_camera_index", "right_camera_name", "right"),
    "pairwise_pairs": ("pairwise_pairs", "pairwise_baselines", "all_pairs", "camera_pairs"),
    "adjacent_pairs": ("adjacent_pairs", "adjacent_camera_pairs"),
    "adjacent_cm": ("adjacent_baselines_cm", "baselines_adjacent_cm"),
    "camera_a": ("camera_index_a", "camera_a", "index_a", "camera_name_a", "left_camera"),
    "camera_b": ("camera_index_b", "camera_b", "index_b", "camera_name_b", "right_camera"),
    "baseline_cm": ("baseline_cm", "distance_cm"),
    # both files
    "camera_count": ("camera_count", "num_cameras", "n_cameras", "number_of_cameras"),
    "unit": (
        *("units.length", "units.location", "units.distance", "unit.length"),
        *("unit", "units", "length_unit", "location_unit", "distance_unit", "world_unit"),
    ),
    # labels, in any file
    "scene_label": ("scene_label", "scene_name", "label"),
    "scene_index": ("scene_index", "scene_number", "scene_idx"),
    "map_name": ("map_name", "map", "level_name"),
    "map_path": ("map_path", "level_path"),
    "character": _within(
        _ASSET,
        *("character_mesh", "character_id", "character_name", "character.mesh"),
        *("character.name", "character.id", "character"),
    ),
    "animation": _within(
        _ASSET,
        *("animation_name", "animation_id", "animation_sequence", "animation.name"),
        *("animation.id", "animation"),
    ),
    "aperture_fstop": _within(
        _CAMERA, "aperture_fstop", "fstop", "f_stop", "f_number", "current_aperture", "aperture"
    ),
    # trajectory.json
    "frames": ("frames", "trajectory", "poses"),
    "frame_index": ("frame_index", "frame", "index", "frame_number", "frame_id"),
    "cameras": ("cameras", "camera_poses", "poses"),
    "camera_index": ("camera_index", "camera_id", "index"),
    "camera_name": ("camera_name", "name", "camera"),
    "camera_order": ("camera_order", "camera_names"),
    "location": _within(_POSE, "location", "position", "translation"),
    "representation": (
        *("rotation_representation", "rotation_format", "rotation_type", "rotation_convention"),
        *("orientation_representation", "rotation_repr", "units.rotation"),
    ),
    "rotation": _within(_POSE, "rotation", "orientation"),
    "rotator": _within(_POSE, "rotator", "rotation_euler", "euler", "euler_angles"),
    "quaternion": _within(
        _POSE, "quaternion", "quat", "rotation_quaternion", "rotation_quat", "quaternion_xyzw"
    ),
    "matrix": _within(_POSE, "rotation_matrix", "matrix"),
    # the description
    "short_caption": ("short_caption", "caption_short", "short_description"),
    "detailed_caption": (
        *("detailed_caption", "caption_detailed", "long_caption", "detailed_description"),
        *("caption", "description"),
    ),
    "scene_type": ("scene_type", "environment_type"),
    "setting": ("setting", "location_type"),
    "tags": ("tags", "keywords"),
}

AXES: Final = {
    "location": (("x", "y", "z"), ("X", "Y", "Z")),
    "rotator": (("pitch", "yaw", "roll"), ("Pitch", "Yaw", "Roll")),
    "quaternion": (("x", "y", "z", "w"), ("X", "Y", "Z", "W"), ("qx", "qy", "qz", "qw")),
    "principal_point_px": (("x", "y"), ("X", "Y"), ("cx", "cy"), ("u", "v")),
}
"""How the components of an object are called, in the order in which they are kept."""

UNITS_M: Final = {
    **dict.fromkeys(("cm", "centimeter", "centimetre", "unreal", "uu", "unreal_unit"), 0.01),
    **dict.fromkeys(("m", "meter", "metre"), 1.0),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 0.001),
}
"""Metres in one unit of each accepted name; a plural s is taken off first."""


def _in_each_case(name: str) -> tuple[str, ...]:
    first, *rest = name.split("_")
    tail = "".join(word.capitalize() for word in rest)
    return tuple(dict.fromkeys((name, first + tail, first.capitalize() + tail)))


_PATHS: Final = {
    quantity: tuple(
        keys
        for spelling in spellings
        for keys in itertools.product(*map(_in_each_case, spelling.split(".")))
    )
    for quantity, spellings in SPELLINGS.items()
}
_FIRST_KEYS: Final = {
    quantity: frozenset(first for first, *_ in paths) for quantity, paths in _PATHS.items()
}


def find(document: dict[str, Any], quantity: str) -> tuple[tuple[str, ...], Any] | None:
    """Return the keys that lead to a quantity and its value, None where no spelling is found.

    >>> find({"cameraIntrinsics": {"FocalLength": 50.0}}, "focal_mm")
    (('cameraIntrinsics', 'FocalLength'), 50.0)
    """
    if _FIRST_KEYS[quantity].isdisjoint(document):
        return None
    for keys in _PATHS[quantity]:
        value: Any = document
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
            if value is None:
                break
        else:
            return keys, value
    return None
