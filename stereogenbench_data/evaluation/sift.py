"""Keypoints without learned weights: OpenCV's SIFT, upright."""

from typing import Any, Final

import numpy as np
from jaxtyping import Int64

from stereogenbench_data.evaluation.matching import KEYPOINTS, RATIO, mutual_matches
from stereogenbench_data.evaluation.pictures import require_opencv, require_pictures
from stereogenbench_data.evaluation.protocols import Keypoints, Picture, Settings

_DESCRIPTOR_DIM: Final = 128


class Sift:
    """SIFT keypoints of the luma, described upright, as rectified views are not turned.

    Of points that SIFT finds in several orientations one is kept, and of all those with the
    strongest response. Descriptors are whole numbers, so matches are the same on every machine.

    Attributes:
        name: What tables call it.
        settings: Every choice that its answers depend on.
    """

    def __init__(self, *, keypoints: int = KEYPOINTS, ratio: float = RATIO) -> None:
        """Make a matcher of up to so many keypoints a picture.

        Raises:
            ExtraError: If OpenCV is not installed.
        """
        self._cv2 = require_opencv()
        self._sift = self._cv2.SIFT_create(enable_precise_upscale=True)
        self._keypoints = keypoints
        self._ratio = ratio
        self.name = f"SIFT (OpenCV {self._cv2.__version__})"
        self.settings: Settings = {
            "keypoints": keypoints,
            "orientation": "upright",
            "upscale": "precise",
            "ratio": ratio,
            "matching": "mutual nearest neighbours, ratio in both directions",
        }

    def detect(self, picture: Picture) -> Keypoints:
        """Return the strongest keypoints of a picture.

        Raises:
            EvaluationError: If it is no picture.
        """
        require_pictures(picture)
        grey = self._cv2.cvtColor(
            np.ascontiguousarray(picture.transpose(1, 2, 0)), self._cv2.COLOR_RGB2GRAY
        )
        points = _strongest(self._sift.detect(grey, None), at_most=self._keypoints)
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
        return mutual_matches(left, right, ratio=self._ratio)


def _strongest(points: Any, *, at_most: int) -> list[Any]:
    """Return one upright keypoint for each place and size, the strongest first."""
    distinct: dict[tuple[float, float, float], Any] = {}
    for point in points:
        point.angle = 0
        distinct.setdefault((*point.pt, point.size), point)
    ordered = sorted(distinct.items(), key=lambda item: (-item[1].response, item[0]))
    return [point for _, point in ordered[:at_most]]
