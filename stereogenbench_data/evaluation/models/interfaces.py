"""The interfaces of the models that metrics use; any object with these members will do.

Pictures are uint8 RGB, channel first.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from stereogenbench_data.errors import EvaluationError

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
    """What every model has."""

    @property
    def name(self) -> str:
        """What tables call it, with its version."""

    @property
    def settings(self) -> Settings:
        """Every choice that its answers depend on, so that scores of other choices differ."""


@runtime_checkable
class KeypointMatcher(Model, Protocol):
    """Finds keypoints in one picture, and the same keypoints in another."""

    def detect(self, picture: Picture) -> Keypoints:
        """Return a picture's keypoints: of the same picture, always the same in the same order."""

    def match(self, left: Keypoints, right: Keypoints) -> Int64[np.ndarray, "m 2"]:
        """Return indices of matched keypoints (left, right), each left keypoint at most once."""


@runtime_checkable
class StereoMatcher(Model, Protocol):
    """Estimates the disparity of a rectified pair."""

    def __call__(self, left: Picture, right: Picture) -> Float32[np.ndarray, "h w"]:
        """Return the left picture's disparity in pixels; nan where it has no answer.

        x_right = x_left - disparity: positive in front of the cameras.
        """


@runtime_checkable
class PairMetric(Model, Protocol):
    """Scores pictures against their targets."""

    def __call__(self, predicted: Pictures, target: Pictures) -> Float64[np.ndarray, " n"]:
        """Return one number for each picture."""


@runtime_checkable
class ImageFeatures(Model, Protocol):
    """Describes pictures by numbers."""

    def __call__(self, pictures: Pictures) -> Float64[np.ndarray, "n dim"]:
        """Return the features of each picture."""


@runtime_checkable
class VideoFeatures(Model, Protocol):
    """Describes clips by numbers."""

    @property
    def min_frames(self) -> int:
        """How many frames a clip needs."""

    def __call__(self, clips: Clips) -> Float64[np.ndarray, "n dim"]:
        """Return the features of each clip."""


def require_rgb(pixels: Picture | Pictures | Clips, what: str, *, axes: str) -> None:
    """Raise unless these are uint8 pixels with the given axes, three channels before the last two.

    Args:
        pixels: What was given.
        what: What messages call them, with the verb: "a picture".
        axes: Names of the axes, such as "(n, 3, h, w)".

    Raises:
        EvaluationError: Naming the dtype and the shape that were found.
    """
    dims = axes.count(",") + 1
    if pixels.dtype != np.uint8 or pixels.ndim != dims or pixels.shape[-3] != 3:
        raise EvaluationError(
            f"{what} must be uint8 RGB of shape {axes}, got {pixels.dtype} of shape {pixels.shape}."
        )


def require_pictures(*pictures: Picture) -> None:
    """Raise unless all are uint8 pictures (3, h, w) of one size.

    Raises:
        EvaluationError: Naming what was found.
    """
    for picture in pictures:
        require_rgb(picture, "a picture", axes="(3, h, w)")
    if len({picture.shape for picture in pictures}) > 1:
        sizes = " and ".join("x".join(map(str, picture.shape[:0:-1])) for picture in pictures)
        raise EvaluationError(f"the pictures of one score must be of one size, got {sizes}.")


def require_batch(pictures: Pictures) -> None:
    """Raise EvaluationError unless these are uint8 pictures (n, 3, h, w)."""
    require_rgb(pictures, "pictures", axes="(n, 3, h, w)")


def require_clips(clips: Clips, *, frames: int, name: str) -> None:
    """Raise EvaluationError unless these are uint8 clips (n, t, 3, h, w) of enough frames."""
    require_rgb(clips, "clips", axes="(n, t, 3, h, w)")
    if clips.shape[1] < frames:
        raise EvaluationError(
            f"{name} needs clips of at least {frames} frames, got {clips.shape[1]}."
        )
