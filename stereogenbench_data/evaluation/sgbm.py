"""Disparity without learned weights: OpenCV's semi-global matching."""

from typing import Final

import numpy as np
from jaxtyping import Float32

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.pictures import require_opencv, require_pictures
from stereogenbench_data.evaluation.protocols import Picture, Settings

_SUBPIXELS: Final = 16
_LEAST_PX: Final = -16
_BLOCK_PX: Final = 5
_UNIQUENESS_PERCENT: Final = 10
_SPECKLE_PIXELS: Final = 100
_SPECKLE_PX: Final = 2
_LEFT_RIGHT_PX: Final = 1
_GRADIENT_CAP: Final = 63


class Sgbm:
    """Semi-global matching with left-right check, disparities from -16 up to 175 px.

    The few negative ones tell a view that is shifted the wrong way, or not at all, from one that
    is shifted a little. It has no answer in the columns at both sides whose search range leaves
    the picture, and none for larger disparities.

    Attributes:
        name: What tables call it.
        settings: Every choice that its answers depend on.
    """

    def __init__(self, *, disparities: int = 192) -> None:
        """Make a matcher of so many disparities, a multiple of 16.

        Raises:
            ExtraError: If OpenCV is not installed.
        """
        self._cv2 = require_opencv()
        self._disparities = disparities
        small_step, large_step = 8 * 3 * _BLOCK_PX**2, 32 * 3 * _BLOCK_PX**2
        self._matcher = self._cv2.StereoSGBM_create(
            minDisparity=_LEAST_PX,
            numDisparities=disparities,
            blockSize=_BLOCK_PX,
            P1=small_step,
            P2=large_step,
            disp12MaxDiff=_LEFT_RIGHT_PX,
            preFilterCap=_GRADIENT_CAP,
            uniquenessRatio=_UNIQUENESS_PERCENT,
            speckleWindowSize=_SPECKLE_PIXELS,
            speckleRange=_SPECKLE_PX,
            mode=self._cv2.STEREO_SGBM_MODE_SGBM,
        )
        self.name = f"SGBM (OpenCV {self._cv2.__version__})"
        self.settings: Settings = {
            "least_disparity_px": _LEAST_PX,
            "disparities": disparities,
            "block_px": _BLOCK_PX,
            "p1": small_step,
            "p2": large_step,
            "left_right_px": _LEFT_RIGHT_PX,
            "uniqueness_percent": _UNIQUENESS_PERCENT,
            "speckle_pixels": _SPECKLE_PIXELS,
            "speckle_px": _SPECKLE_PX,
            "prefilter_cap": _GRADIENT_CAP,
            "mode": "five directions",
        }

    def __call__(self, left: Picture, right: Picture) -> Float32[np.ndarray, "h w"]:
        """Return the left picture's disparity in pixels; nan where it has no answer.

        Raises:
            EvaluationError: If the two are no pictures of one size, or narrower than the search.
        """
        require_pictures(left, right)
        if left.shape[-1] <= self._disparities:
            raise EvaluationError(
                f"SGBM searches {self._disparities} disparities, and the pictures are "
                f"{left.shape[-1]} px wide: score wider pictures, or leave out SD."
            )
        views = (
            self._cv2.cvtColor(
                np.ascontiguousarray(view.transpose(1, 2, 0)), self._cv2.COLOR_RGB2BGR
            )
            for view in (left, right)
        )
        raw = self._matcher.compute(*views)
        disparity_px: Float32[np.ndarray, "h w"] = raw.astype(np.float32) / _SUBPIXELS
        disparity_px[raw < _LEAST_PX * _SUBPIXELS] = np.nan
        return disparity_px
