"""A declaration: where each quantity stands in a scene's files, its unit and its form.

`BUILT_IN` is the release's, as the paper prints it; a file of conventions replaces tables of it
(`schema.conventions`), and what the paper leaves to prose is settled on some scenes
(`geometry.pose_evidence`). Whatever reads a file goes by a declaration: what that does not name is
never read, so it contradicts nothing.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.schema.units import UNITS_M

UNKNOWN: Final = "unknown"
"""The form of poses that nobody understands: rigs are assumed rectified, and poses are not read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NumberAt:
    """Where one number of ``baseline.json`` stands.

    Attributes:
        places: Its places; the first at which something stands counts.
        value: The number itself, for files that do not have it.
        unit: Its unit; "" is the usual one: mm, pixels or degrees.
        is_needed: Whether a file without it is refused.
    """

    places: tuple[str, ...] = ()
    value: float | None = None
    unit: str = ""
    is_needed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class PairsAt:
    """Where the baselines of pairs of cameras stand.

    Attributes:
        rows: The place of the rows, with an axis or several.
        a: Below a row the place of the first camera's number or name; "#0" is the first number in
            the row's key, and "order" the row's own number, so that it is of neighbours. "" finds
            the three by the first row, as files of conventions of an earlier format need.
        b: That of the second camera.
        length: Below a row the place of the baseline; "" is the row itself.
        unit: Its unit; "" is that at the end of the key of a length that was found, or cm.
        first: The number of the first camera.
        is_needed: Whether a file without the rows is refused.
    """

    rows: str
    a: str = ""
    b: str = ""
    length: str = ""
    unit: str = "cm"
    first: int = 0
    is_needed: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class PrimaryPairAt:
    """Where the names or numbers of the primary pair's cameras stand.

    Attributes:
        left: The places of the left one; the first at which something stands counts.
        right: Those of the right one.
        is_needed: Whether a file without it is refused; if not, cameras 0 and 1 are taken.
    """

    left: tuple[str, ...]
    right: tuple[str, ...]
    is_needed: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class PosesAt:
    """Where poses stand in ``trajectory.json``, and their form, as `geometry.pose_forms` names it.

    Each place has two axes, frames and cameras, or one of rows that name both. In a file of
    conventions any part may be missing: then it is settled by what the rig must be. Keys on the
    way, without a ``$``, are those of conventions and index rows of an earlier format.

    Attributes:
        location: Where locations stand; None where matrices hold them.
        rotation: Where rotations or matrices stand.
        form: The form of the rotations; "unknown" if nobody understands the poses.
        axes: The axes of the cameras.
        unit: The unit of locations; None takes the one that the file states.
        frame: Where the numbers of frames stand; None where frames are in order.
        camera: Where the numbers or names of cameras stand; None where cameras are in order.
        outer: Which axis comes first: "frames" or "cameras".
        first: The number of the first frame.
        step: By how much the numbers of frames grow.
    """

    location: str | None = None
    rotation: str | None = None
    form: str | None = None
    axes: str | None = None
    unit: str | None = None
    frame: str | None = None
    camera: str | None = None
    outer: str | None = None
    first: int | None = None
    step: int | None = None

    @classmethod
    def of_reading(cls, name: str) -> "PosesAt":
        """Return what the name of a reading says, with its metres in a unit or without.

        Raises:
            SchemaError: If it is the name of none.
        """
        places, _, rest = name.partition(": ")
        location, _, rotation = places.rpartition(" and ")
        rest, _, unit_m = rest.partition(" @ ")
        try:
            form, axes = rest.split(", ")[:2]
            known = {unit: metres for unit, metres in UNITS_M.items()
                     if unit_m and math.isclose(metres, float(unit_m))}  # fmt: skip
        except ValueError as error:
            raise SchemaError(f"{shortened(name)!r} names no reading of poses.") from error
        unit, axes = next(iter(known), None), axes.removesuffix(" axes")
        return cls(location=location or None, rotation=rotation, form=form, axes=axes, unit=unit)

    def fits(self, name: str) -> bool:
        """Return whether the reading of a name is one of these."""
        found = self.of_reading(name)
        return all(
            getattr(self, part) in (None, getattr(found, part))
            for part in ("location", "rotation", "form", "axes")
        )

    @property
    def is_settled(self) -> bool:
        """Whether all that a reader needs is stated."""
        return bool(self.rotation and self.rotation[0] == "$" and self.form and self.axes)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthAs:
    """The depth encoding.

    Attributes:
        encoding: The contract; its unit is None where files state theirs.
        instead_of_tag_m: The unit that tags state and that is wrong, which ``unit_m`` replaces.
    """

    encoding: DepthEncoding
    instead_of_tag_m: float | None = None

    def require(self, unit_m: float, *, where: str) -> None:
        """Refuse the unit that files state, if it is neither the contract's nor what that replaces.

        Raises:
            SchemaError: With both figures.
        """
        known_m = self.instead_of_tag_m or self.encoding.unit_m
        if known_m is not None and abs(unit_m - known_m) > 1e-9 * known_m:
            raise SchemaError(
                f"{where}: states {unit_m:g} m in a stored unit of depth, and the conventions "
                f"expect {known_m:g} m. Correct unit_m in [depth]; or, if the files are known to "
                f"be wrong, add instead_of_tag_m = {unit_m:g}."
            )


_CAMERA: Final = "$.camera_intrinsics."
_MATRICES: Final = tuple(f"$.{above}{name}" for above in ("camera_intrinsics.", "")
                         for name in ("K", "camera_matrix"))  # fmt: skip


def _in_pixels(names: Sequence[str], of_point: Sequence[str], row: int, column: int) -> NumberAt:
    """Return where a number in pixels may stand: by itself, in a point, or in a camera matrix."""
    places = [f"$.{above}{name}" for above in ("camera_intrinsics.", "") for name in names]
    points = [f"{_CAMERA}principal_point{end}" for end in ("", "_px", "_override")]
    places += [f"{point}{part}" for point in points for part in of_point]
    elements = f"[{row}][{column}]", f"[{3 * row + column}]", f".{names[0]}"
    places += [f"{matrix}{element}" for matrix in _MATRICES for element in elements]
    return NumberAt(places=tuple(places), unit="px")


_NUMBERS: Final[Mapping[str, NumberAt]] = {
    "focal_length": NumberAt(places=(f"{_CAMERA}focal_length_mm",), unit="mm", is_needed=True),
    "sensor_width": NumberAt(places=(f"{_CAMERA}sensor_width_mm",), unit="mm", is_needed=True),
    "sensor_height": NumberAt(places=(f"{_CAMERA}sensor_height_mm",), unit="mm"),
    "image_width": NumberAt(places=("$.image_width",), unit="px"),
    "image_height": NumberAt(places=("$.image_height",), unit="px"),
    "focal_length_px": _in_pixels(("fx", "fx_px", "focal_length_px"), (), 0, 0),
    "focal_length_y_px": _in_pixels(("fy", "fy_px"), (), 1, 1),
    "principal_x": _in_pixels(("cx", "cx_px", "principal_point_x"), ("[0]", ".x", ".cx"), 0, 2),
    "principal_y": _in_pixels(("cy", "cy_px", "principal_point_y"), ("[1]", ".y", ".cy"), 1, 2),
}
_PAIRS: Final = PairsAt(
    rows="$.pairwise_pairs[]", a="camera_index_a", b="camera_index_b", length="baseline_cm"
)
_GAPS: Final = replace(_PAIRS, rows="$.adjacent_pairs[]", is_needed=False)
_PAIR: Final = "$.primary_stereo_pair"

LABELS: Final = {
    "scene_label": ("$.scene_label",),
    "scene_index": ("$.scene_index",),
    "map_name": ("$.map_name",),
    "map_path": ("$.map_path",),
    "character": ("$.character_mesh", "$.character_id"),
    "animation": ("$.animation",),
    "aperture_fstop": ("$.aperture_fstop",),
}
"""Where identifiers stand in ``baseline.json`` and the completion mark; no sample needs one."""

CAPTIONS: Final = ("$.detailed_caption", "$.short_caption", "$.caption")
"""Where the caption stands in a scene's description."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Declaration:
    """Where the quantities of scenes stand.

    Attributes:
        has: Keys that tell these scenes from others, as `conventions.keys_of` names them; () is
            all scenes.
        numbers: The numbers of ``baseline.json``, by the names of tables.
        pairs: The baselines.
        gaps: Baselines of neighbours that are recorded again, which must be the same; None where
            none are.
        primary_pair: The left and the right camera.
        poses: How poses are read; None where that is settled by some scenes.
        depth: The depth encoding.
        stated: The tables on ``baseline.json`` as a file of conventions states them, from which
            `text` writes them.
    """

    has: tuple[str, ...] = ()
    numbers: Mapping[str, NumberAt] = field(default_factory=lambda: _NUMBERS)
    pairs: PairsAt = _PAIRS
    gaps: PairsAt | None = _GAPS
    primary_pair: PrimaryPairAt = PrimaryPairAt(
        left=(f"{_PAIR}.left_camera", f"{_PAIR}[0]"), right=(f"{_PAIR}.right_camera", f"{_PAIR}[1]")
    )
    poses: PosesAt | None = None
    depth: DepthAs | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)

    def tables(self) -> dict[str, Any]:
        """Return what is stated as a TOML or JSON document has it."""
        tables: dict[str, Any] = {"has": list(self.has)} if self.has else {}
        tables |= self.stated
        if self.poses is not None:
            tables["poses"] = _plain_table(self.poses)
        if self.depth is not None:
            tables["depth"] = _plain_table(self.depth.encoding)
            if self.depth.instead_of_tag_m is not None:
                tables["depth"]["instead_of_tag_m"] = self.depth.instead_of_tag_m
        return tables

    def text(self) -> str:
        """Return what is stated as one line of JSON, as an index keeps it beside each scene."""
        return json.dumps(self.tables(), sort_keys=True)


def _plain_table(record: Any) -> dict[str, Any]:
    """Return the fields of a record that are not as usual, as TOML and JSON have them."""
    usual, table = type(record)(), {}
    for name in (each.name for each in fields(record) if each.name != "source"):
        value = getattr(record, name)
        if value != getattr(usual, name):
            listed = sorted(value, key=str) if isinstance(value, frozenset) else value
            table[name] = list(listed) if isinstance(value, tuple | frozenset) else value
    return table


BUILT_IN: Final = Declaration()
"""The release's: the keys that the paper prints, and of the others those that must agree."""
