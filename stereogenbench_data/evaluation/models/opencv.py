"""Matching without learned weights, by OpenCV: SIFT for keypoints, SGBM for disparity."""

from types import ModuleType
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from stereogenbench_data.errors import EvaluationError, missing_extra
from stereogenbench_data.evaluation.metrics.keypoint_matches import KEYPOINTS, RATIO, mutual_matches
from stereogenbench_data.evaluation.models.loading import Keypoints, Picture, Settings

_DESCRIPTOR_DIM: Final = 128


def require_opencv() -> ModuleType:
    """Return the module ``cv2``.

    Raises:
        ExtraError: If it is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise missing_extra("SSIM, SIFT and SGBM", "evaluation", error) from error
    return cv2


class Sift:
    """SIFT keypoints of the luma, described upright, as rectified views are not turned.

    Points that SIFT finds in several orientations are kept once, and of all points those with the
    strongest response. Descriptors are whole numbers, so matches are the same on every machine.
    """

    def __init__(self) -> None:
        """Make the matcher.

        Raises:
            ExtraError: If OpenCV is not installed.
        """
        self._cv2 = require_opencv()
        self._sift = self._cv2.SIFT_create(enable_precise_upscale=True)
        self.name = f"SIFT (OpenCV {self._cv2.__version__})"
        self.settings: Settings = {
            "keypoints": KEYPOINTS,
            "orientation": "upright",
            "upscale": "precise",
            "ratio": RATIO,
            "matching": "mutual nearest neighbours, ratio in both directions",
        }

    def detect(self, picture: Picture) -> Keypoints:
        """Return the strongest keypoints of a picture."""
        grey = self._cv2.cvtColor(_channels_last(picture), self._cv2.COLOR_RGB2GRAY)
        points = _strongest(self._sift.detect(grey, None))
        if not points:
            return Keypoints(
                xy_px=np.zeros((0, 2), dtype=np.float32),
                descriptors=np.zeros((0, _DESCRIPTOR_DIM), dtype=np.float32),
            )
        points, descriptors = self._sift.compute(grey, points)
        xy_px = np.array([point.pt for point in points], dtype=np.float32) + np.float32(0.5)
        return Keypoints(xy_px=xy_px, descriptors=descriptors)

    def match(self, left: Keypoints, right: Keypoints) -> Int64[np.ndarray, "m 2"]:
        """Return mutual nearest neighbours."""
        return mutual_matches(left, right)


def _channels_last(picture: Picture) -> UInt8[np.ndarray, "h w 3"]:
    return np.ascontiguousarray(picture.transpose(1, 2, 0))


def _strongest(points: Any) -> list[Any]:
    """Return one upright keypoint for each place and size, the strongest first, not too many."""
    distinct: dict[tuple[float, float, float], Any] = {}
    for point in points:
        point.angle = 0
        distinct.setdefault((*point.pt, point.size), point)
    ordered = sorted(distinct.items(), key=lambda item: (-item[1].response, item[0]))
    return [point for _, point in ordered[:KEYPOINTS]]


_SUBPIXELS: Final = 16
_LEAST_PX: Final = -16
_DISPARITIES: Final = 192
_BLOCK_PX: Final = 5


class Sgbm:
    """Semi-global matching with left-right check, disparities from -16 up to 175 px.

    The negative ones distinguish a view that is shifted the wrong way, or not at all, from one that
    is shifted a little. There is no answer for larger disparities, nor in the columns at both sides
    whose search range leaves the picture.

    Attributes:
        range_px: The least and the largest disparity.
    """

    range_px: Final = (_LEAST_PX, _LEAST_PX + _DISPARITIES - 1)

    def __init__(self) -> None:
        """Make the matcher.

        Raises:
            ExtraError: If OpenCV is not installed.
        """
        self._cv2 = require_opencv()
        chosen = {
            "minDisparity": _LEAST_PX,
            "numDisparities": _DISPARITIES,
            "blockSize": _BLOCK_PX,
            "P1": 8 * 3 * _BLOCK_PX**2,
            "P2": 32 * 3 * _BLOCK_PX**2,
            "disp12MaxDiff": 1,
            "preFilterCap": 63,
            "uniquenessRatio": 10,
            "speckleWindowSize": 100,
            "speckleRange": 2,
        }
        self._matcher = self._cv2.StereoSGBM_create(**chosen, mode=self._cv2.STEREO_SGBM_MODE_SGBM)
        self.name = f"SGBM (OpenCV {self._cv2.__version__})"
        self.settings: Settings = {**chosen, "mode": "five directions"}

    def __call__(self, left: Picture, right: Picture) -> Float32[np.ndarray, "h w"]:
        """Return the left picture's disparity in pixels; nan where it has no answer.

        Raises:
            EvaluationError: If the two are narrower than the search.
        """
        if left.shape[-1] <= _DISPARITIES:
            raise EvaluationError(
                f"SGBM searches {_DISPARITIES} disparities, and the pictures are "
                f"{left.shape[-1]} px wide: score wider pictures, or leave out SD."
            )
        views = (_channels_last(view)[..., ::-1] for view in (left, right))
        raw = self._matcher.compute(*map(np.ascontiguousarray, views))
        disparity_px: Float32[np.ndarray, "h w"] = raw.astype(np.float32) / _SUBPIXELS
        disparity_px[raw < _LEAST_PX * _SUBPIXELS] = np.nan
        return disparity_px
