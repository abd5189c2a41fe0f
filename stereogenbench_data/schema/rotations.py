"""Which rotation a pose's numbers are: the representation that a file names, and its data's form.

Nothing is guessed: three numbers without names have no order (Unreal's C++ writes pitch, yaw,
roll; its Python writes roll, pitch, yaw), so they are refused unless the representation has one.
"""

import re
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.schema.nodes import Node, axes_of
from stereogenbench_data.schema.problems import brief
from stereogenbench_data.schema.spellings import AXES

Form = Literal["rotator", "quaternion", "matrix"]

TOLERANCE: Final = 1e-3
"""How far a quaternion's norm may be from 1, and a matrix from orthonormal."""

COMPONENTS: Final[dict[Form, int]] = {"rotator": 3, "quaternion": 4, "matrix": 9}
_NAMED: Final[tuple[Form, ...]] = ("rotator", "quaternion")
_ANGLES: Final = ("pitch", "yaw", "roll")
_QUATERNION: Final = re.compile(r"quat")
_MATRIX: Final = re.compile(r"matri|mat_?3|3x3")
_ROTATOR: Final = re.compile(r"rotator|euler|deg|rad|pitch|yaw|roll")
_RADIANS: Final = re.compile(r"rad(?:ian)?s?(?![a-z])")
_BY_COLUMNS: Final = re.compile(r"row_?vec|transposed|column_?major|col_?major")
_REAL_FIRST: Final = re.compile(r"wxyz|(?:w|scalar|real)_?first")
_CURE: Final = (
    "name one of: 'unreal_rotator_degrees', 'unreal_rotator_radians', 'quaternion_xyzw', "
    "'quaternion_wxyz', 'rotation_matrix', 'rotation_matrix_row_vectors'"
)


@dataclass(frozen=True, slots=True)
class Representation:
    """What a file says of its rotations.

    ``order`` holds, for each component kept, its place in a list: pitch, yaw, roll; x, y, z, w;
    or the nine elements by rows. It is None for angles whose order the file does not name.
    """

    form: Form | None = None
    degrees_in_unit: float = 1.0
    order: tuple[int, ...] | None = None
    name: str = ""


def representation_of(root: Node) -> Representation:
    """Return the rotation representation that a trajectory names, the empty one if none."""
    named = root.find("representation")
    if named is None:
        return Representation()
    name = re.sub(r"[\s,/-]+", "_", named.text().lower())
    order: tuple[int, ...] | None
    if _QUATERNION.search(name):
        order = (1, 2, 3, 0) if _REAL_FIRST.search(name.replace("w_x_y_z", "wxyz")) else None
        return Representation("quaternion", 1.0, order, name)
    if _MATRIX.search(name):
        order = (0, 3, 6, 1, 4, 7, 2, 5, 8) if _BY_COLUMNS.search(name) else None
        return Representation("matrix", 1.0, order, name)
    radians = _RADIANS.search(name) is not None
    if _ROTATOR.search(name) and not (radians and "deg" in name):
        unit = float(np.degrees(1.0)) if radians else 1.0
        return Representation("rotator", unit, _angle_order(name), name)
    if name not in ("", "unreal", "ue4", "ue5", "ue"):
        named.complain(f"is no rotation representation that is known: {brief(name)}; {_CURE}")
    return Representation()


def _angle_order(name: str) -> tuple[int, ...] | None:
    name = name.replace("rpy", "roll_pitch_yaw").replace("ypr", "yaw_pitch_roll")
    places = [name.find(angle) for angle in _ANGLES]
    if min(places) < 0:
        return None
    return tuple(sorted(places).index(place) for place in places)


def find_rotation(pose: Node, representation: Representation) -> "Node | None":
    """Return a pose's rotation; of several, the one whose name is that of the representation."""
    forms = list(COMPONENTS)
    own = [representation.form] if representation.form else []
    for quantity in dict.fromkeys([*own, "rotation", *forms]):
        found = pose.find(quantity)
        if found is not None:
            return found
    pose.require("rotation")
    return None


def components_of(value: object, representation: Representation) -> tuple[Form, list[Any]] | None:
    """Return a rotation's form and components in the order kept; None where none is told.

    Kept are pitch, yaw, roll; x, y, z, w; or nine elements by rows.
    """
    if isinstance(value, dict):
        for form in _NAMED:
            named = axes_of(value, AXES[form])
            if named is not None:
                return form, named
        return None
    if not isinstance(value, list):
        return None
    if len(value) == 3 and all(isinstance(row, list) and len(row) == 3 for row in value):
        value = [element for row in value for element in row]
    for form, count in COMPONENTS.items():
        if count == len(value):
            order = representation.order if representation.form == form else None
            if order is not None:
                return form, [value[place] for place in order]
            return None if form == "rotator" else (form, value)
    return None


def complain_of(rotation: Node, representation: Representation) -> None:
    """Note why a rotation has no components that could be read."""
    if isinstance(rotation.value, list) and len(rotation.value) == 3:
        rotation.complain(
            "three angles without names have no order; write {pitch, yaw, roll}, or name the "
            "order in rotation_representation, as in 'rotator_pitch_yaw_roll_degrees'"
        )
        return
    expected = f" (rotation_representation is {brief(representation.name)})"
    rotation.complain(
        f"must be {{pitch, yaw, roll}}, a quaternion {{x, y, z, w}} or a 3 x 3 matrix"
        f"{expected if representation.form else ''}, found {brief(rotation.value)}"
    )


def unit_quaternions(
    values: Float64[np.ndarray, "n 4"],
) -> tuple[Float64[np.ndarray, "n 4"], dict[int, str]]:
    """Return normalised quaternions, and a complaint for each row that is not nearly unit."""
    norms = np.sqrt(np.sum(np.square(values), axis=1))
    bad = {
        int(row): f"a rotation's quaternion has length 1 within {TOLERANCE}, found {norms[row]:.6g}"
        for row in np.flatnonzero(np.abs(norms - 1) > TOLERANCE)
    }
    return values / np.where(norms > 0, norms, 1.0)[:, None], bad


def rotation_matrices(
    values: Float64[np.ndarray, "n 9"],
) -> tuple[Float64[np.ndarray, "n 3 3"], dict[int, str]]:
    """Return 3 x 3 matrices, and a complaint for each row that is not nearly a rotation."""
    matrices = values.reshape(-1, 3, 3)
    products = matrices @ matrices.transpose(0, 2, 1)
    skews = np.max(np.abs(products - np.eye(3)), axis=(1, 2))
    bad = {
        int(row): f"a rotation's matrix is orthonormal within {TOLERANCE}, "
        f"this one is off by {skews[row]:.3g}"
        for row in np.flatnonzero(skews > TOLERANCE)
    }
    mirrored = np.linalg.det(matrices) < 0
    return matrices, bad | {
        int(row): "the matrix mirrors (its determinant is negative); camera axes are x forward, "
        "y right, z up as the world's are"
        for row in np.flatnonzero(mirrored)
        if int(row) not in bad
    }
