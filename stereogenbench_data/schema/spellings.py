"""The keys of the metadata files: one table, with the evidence for every key.

- [P] the paper: its loading example, or its appendix on the file schema
- [V] a column of the public dataset viewer (which does not say where in a file the value stands)
- [S] a scene in the released layout that was not rendered by this package
- [X] `synthesis.export`: the paper names the quantity but not its key

The first key found wins; null counts as absent. Where a quantity is optional and a wrong default
would change a camera, a pose or a caption, `LOOKALIKES` says which unknown keys may hold it: such a
file is refused instead of read with the default.
"""

import re
from typing import Final

SPELLINGS: Final[dict[str, tuple[str, ...]]] = {
    # baseline.json: the camera
    "focal_mm": ("camera_intrinsics.focal_length_mm",),  # [P] [S]
    "sensor_width_mm": ("camera_intrinsics.sensor_width_mm",),  # [P] [S]
    "sensor_height_mm": ("camera_intrinsics.sensor_height_mm",),  # [V] [S]
    "image_width_px": ("image_width",),  # [P] [S]
    "image_height_px": ("image_height",),  # [S]
    "principal_point_px": ("camera_intrinsics.principal_point_px",),  # [X]
    "aperture_fstop": ("camera_intrinsics.aperture_fstop", "aperture_fstop"),  # [V]
    # baseline.json: the pairs
    "primary_pair": ("primary_stereo_pair",),  # [P] [S]
    "left_camera": ("left_camera",),  # [P] [S]
    "right_camera": ("right_camera",),  # [P] [S]
    "pairwise_pairs": ("pairwise_pairs",),  # [P] [S]
    "adjacent_pairs": ("adjacent_pairs",),  # [S]
    "adjacent_cm": ("baselines_adjacent_cm",),  # [V]
    "camera_a": ("camera_index_a",),  # [P] [S]
    "camera_b": ("camera_index_b",),  # [P] [S]
    "baseline_cm": ("baseline_cm",),  # [P] [S]
    # baseline.json and trajectory.json
    "camera_count": ("camera_count",),  # [S]
    "unit": ("unit", "units"),  # [S]; [P] in prose: "unit" and "units"
    # identifiers, in baseline.json and _scene_complete.json
    "scene_label": ("scene_label",),  # [V] [S]
    "scene_index": ("scene_index",),  # [S]
    "map_name": ("map_name",),  # [V] [S]
    "map_path": ("map_path",),  # [S]
    "character": ("character_mesh",),  # [V] [S]
    "animation": ("animation",),  # [V] [S]
    # trajectory.json
    "frames": ("frames",),  # [P] [S]
    "frame_index": ("frame_index",),  # [S]
    "cameras": ("cameras",),  # [S]
    "camera_index": ("camera_index",),  # [S]
    "camera_name": ("camera_name",),  # [S]
    "location": ("location",),  # [S]
    "rotation": ("rotation",),  # [S]
    "rotation_representation": ("rotation_representation",),  # [S]
    # scene_description_qwen_dataset_level.json
    "short_caption": ("short_caption",),  # [S]
    "detailed_caption": ("detailed_caption",),  # [S]
    "scene_type": ("scene_type",),  # [S]
    "setting": ("setting",),  # [S]
    "tags": ("tags",),  # [S]
}
"""Where each quantity stands in its object: keys, joined by dots."""

_IMAGE: Final = (
    r"resolution|^(?:image|frame|render)_?size|^(?:(?:image|frame|render)_?)?{side}(?:_px)?$"
)
LOOKALIKES: Final[dict[str, re.Pattern[str]]] = {
    "sensor_height_mm": re.compile(r"^sensor_?(?:h|size)|film"),
    "image_width_px": re.compile(_IMAGE.format(side="width")),
    "image_height_px": re.compile(_IMAGE.format(side="height")),
    "principal_point_px": re.compile(r"principal|optical_?cent|^c_?[xy](?:_px)?$"),
    "unit": re.compile(r"units?$"),
    "frame_index": re.compile(r"frame|index|number"),
    "rotation_representation": re.compile(r"rotation|orientation|euler|quaternion"),
    "short_caption": re.compile(r"caption|description|summary"),
    "detailed_caption": re.compile(r"caption|description|summary"),
}
"""What an unknown key looks like, in snake_case, that may hold an optional quantity."""

KNOWN_KEYS: Final = frozenset(
    key for spellings in SPELLINGS.values() for spelling in spellings for key in spelling.split(".")
)

UNITS_M: Final = {"cm": 0.01, "centimeters": 0.01, "centimetres": 0.01}
"""Metres in a unit. "cm" is [S]; the words are those of the paper's prose. All are one unit."""
