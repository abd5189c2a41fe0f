"""What a usable picture is: the limits by which `synthesis` refuses scenes and the audit finds.

So no scene that was drawn here is a finding, and one that would not be drawn is.
"""

from typing import Final

import numpy as np
from jaxtyping import Bool

INVALID_SHARE: Final = 0.6
"""Largest share of a camera's pixels without depth, over all frames."""
DARK_MEAN: Final = 12.0
"""Least mean brightness of a frame, of 255."""
FLAT_SD: Final = 4.0
"""Least standard deviation of the brightness of a frame."""
NEAR_SHARE: Final = 0.3
"""An occluder is nearer than this share of the subject's distance."""
BORDER_SHARE: Final = 0.25
"""Largest share of a picture's border that occluders cover."""

_BORDER_PART: Final = 0.02


def borders(near: Bool[np.ndarray, "h w"]) -> dict[str, Bool[np.ndarray, "_ _"]]:
    """Return the four borders of a map, each 2 % of the shorter side wide, by their names."""
    rim = max(1, round(_BORDER_PART * min(near.shape)))
    return {
        "top": near[:rim], "bottom": near[-rim:], "left": near[:, :rim], "right": near[:, -rim:],
    }  # fmt: skip


def border_share(near: Bool[np.ndarray, "h w"]) -> float:
    """Return the share of a picture's border where a map is true."""
    return float(np.concatenate([each.ravel() for each in borders(near).values()]).mean())
