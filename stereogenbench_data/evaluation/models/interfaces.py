"""The interfaces of the matchers that metrics use; any object with these members will do.

Pictures are uint8 RGB, channel first.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Int64, UInt8

Picture = UInt8[np.ndarray, "3 h w"]
Pictures = UInt8[np.ndarray, "n 3 h w"]
Clips = UInt8[np.ndarray, "n t 3 h w"]
Settings = Mapping[str, str | int | float | bool | None]


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Keypoints of one picture.

    Attributes:
        xy_px: Column and row; the centre of the top-left pixel is (0.5, 0.5).
        descriptors: One row a keypoint.
    """

    xy_px: Float32[np.ndarray, "n 2"]
    descriptors: Float32[np.ndarray, "n d"]


class Model(Protocol):
    """What every matcher has."""

    @property
    def name(self) -> str:
        """What tables call it, with its version."""

    @property
    def settings(self) -> Settings:
        """Every choice that its answers depend on, so that scores of other choices differ."""


class KeypointMatcher(Model, Protocol):
    """Finds keypoints in one picture, and the same keypoints in another."""

    def detect(self, picture: Picture) -> Keypoints:
        """Return a picture's keypoints: of the same picture, always the same in the same order."""

    def match(self, left: Keypoints, right: Keypoints) -> Int64[np.ndarray, "m 2"]:
        """Return indices of matched keypoints (left, right), each left keypoint at most once."""


class StereoMatcher(Model, Protocol):
    """Estimates the disparity of a rectified pair."""

    def __call__(self, left: Picture, right: Picture) -> Float32[np.ndarray, "h w"]:
        """Return the left picture's disparity in pixels; nan where it has no answer.

        x_right = x_left - disparity: positive in front of the cameras.
        """
