"""Intrinsics in pixels wherever a scene's metadata record them, against the paper's equation.

The release's files are known to record millimetres; should any record pixels too, of the rig, a
camera or a frame, they are found by name at any depth: ``fx``, ``fy``, ``cx``, ``cy`` and their
longer spellings, and 3x3 camera matrices.
"""

import re
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from stereogenbench_data.geometry.camera import Intrinsics

_NAMES: Final = {
    "fx_px": re.compile(r"(fx|f_x|focal(_length)?_(x|px)|focal(_length)?_x_px|fx_px)"),
    "fy_px": re.compile(r"(fy|f_y|focal(_length)?_y|focal(_length)?_y_px|fy_px)"),
    "cx_px": re.compile(r"(cx|c_x|principal(_point)?_x|principal(_point)?_x_px|cx_px)"),
    "cy_px": re.compile(r"(cy|c_y|principal(_point)?_y|principal(_point)?_y_px|cy_px)"),
}
_MATRIX: Final = re.compile(r"(k|k_matrix|camera_matrix|intrinsics?(_matrix)?|k_px)")
_PLACES: Final = {"fx_px": (0, 0), "fy_px": (1, 1), "cx_px": (0, 2), "cy_px": (1, 2)}


def deviations_px(documents: list[dict[str, Any]], intrinsics: Intrinsics) -> list[float]:
    """Return how far each recorded number of pixels is from the intrinsics.

    Args:
        documents: Metadata files as parsed from JSON.
        intrinsics: What the paper's equation gives.
    """
    return [
        abs(value - getattr(intrinsics, name))
        for document in documents
        for name, value in recorded_px(document)
    ]


def recorded_px(node: Any) -> Iterator[tuple[str, float]]:
    """Yield the name (of `Intrinsics`) and the value of each number of pixels, at any depth."""
    if isinstance(node, list):
        for each in node:
            if isinstance(each, dict | list):
                yield from recorded_px(each)
        return
    if not isinstance(node, dict):
        return
    for key, value in node.items():
        spelled = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", str(key)).lower()
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield from (
                (name, float(value)) for name, spelling in _NAMES.items()
                if spelling.fullmatch(spelled)
            )  # fmt: skip
        elif _MATRIX.fullmatch(spelled) and (matrix := _matrix(value)) is not None:
            yield from ((name, float(matrix[place])) for name, place in _PLACES.items())
        elif isinstance(value, dict | list):
            yield from recorded_px(value)


def _matrix(value: Any) -> Any:
    """Return a 3x3 array of numbers, None where the value is none."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return matrix if matrix.shape == (3, 3) else None
