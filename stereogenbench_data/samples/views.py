"""What was decoded for one sample, before anything is derived from it.

Transforms map one `Views` to another: they move pictures, stored depth and cameras together and
never see a disparity, so that all that is derived afterwards fits by construction.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, UInt8, UInt16

from stereogenbench_data.geometry.camera import Intrinsics

Pictures = UInt8[np.ndarray, "t 3 h w"]


@dataclass(frozen=True, slots=True, eq=False)
class StoredDepth:
    """Depth as it is stored, of one frame or over the frames of a sample.

    Attributes:
        units: (t, h, w) or (h, w) uint16, stored numbers.
        measured: (t, h, w) or (h, w) bool, where they mean a depth.
        derived: What was worked out of these numbers and will be wanted again, by what it is.
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
        world: "as filmed", or "mirrored" (x negated) after a horizontal flip.
    """

    source: int
    targets: tuple[int, ...]
    frames: tuple[int, ...]
    pictures: dict[int, Any]
    depths: dict[int, StoredDepth]
    intrinsics: Intrinsics
    world: Literal["as filmed", "mirrored"] = "as filmed"
