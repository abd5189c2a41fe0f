"""What is decoded for one sample, before anything is derived from it.

Transforms map one `Views` to another: they move pictures, stored depth and cameras together.
Disparity and the like are derived afterwards, so they fit.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, UInt8, UInt16

from stereogenbench_data.errors import FieldError
from stereogenbench_data.geometry.camera import Intrinsics

Pictures = UInt8[np.ndarray, "t 3 h w"]


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
