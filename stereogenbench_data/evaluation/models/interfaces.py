"""The interfaces of the models that metrics use; any object with these members will do.

Pictures are uint8 RGB, channel first. Each model states in ``settings`` every choice that its
answers depend on, so that scores measured in different ways can be distinguished.
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


class Measured(Protocol):
    """What every model has.

    Attributes:
        name: What tables call it, with its version.
        settings: Every choice that its answers depend on.
    """

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def settings(self) -> Settings:
        """Every choice that its answers depend on."""
        ...


@runtime_checkable
class KeypointMatcher(Measured, Protocol):
    """Finds keypoints in one picture, and the same keypoints in another."""

    def detect(self, picture: Picture) -> Keypoints:
        """Return a picture's keypoints: of the same picture, always the same in the same order."""
        ...

    def match(self, left: Keypoints, right: Keypoints) -> Int64[np.ndarray, "m 2"]:
        """Return indices of matched keypoints (left, right), each left keypoint at most once."""
        ...


@runtime_checkable
class StereoMatcher(Measured, Protocol):
    """Estimates the disparity of a rectified pair."""

    def __call__(self, left: Picture, right: Picture) -> Float32[np.ndarray, "h w"]:
        """Return the left picture's disparity in pixels; nan where it has no answer.

        x_right = x_left - disparity: positive in front of the cameras.
        """
        ...


@runtime_checkable
class PairMetric(Measured, Protocol):
    """Scores pictures against their targets, one number each."""

    @property
    def higher_is_better(self) -> bool:
        """Which way is better."""
        ...

    def __call__(self, predicted: Pictures, target: Pictures) -> Float64[np.ndarray, " n"]:
        """Return the score of each picture."""
        ...


class Features(Measured, Protocol):
    """What a feature extractor for a Fréchet distance has."""

    @property
    def distance(self) -> str:
        """What the Fréchet distance of these features is called: "FID" of Inception's alone."""
        ...

    @property
    def dim(self) -> int:
        """How many features there are."""
        ...


@runtime_checkable
class ImageFeatures(Features, Protocol):
    """Describes pictures by numbers."""

    def __call__(self, pictures: Pictures) -> Float64[np.ndarray, "n dim"]:
        """Return the features of each picture."""
        ...


@runtime_checkable
class VideoFeatures(Features, Protocol):
    """Describes clips by numbers."""

    @property
    def min_frames(self) -> int:
        """How many frames a clip needs."""
        ...

    def __call__(self, clips: Clips) -> Float64[np.ndarray, "n dim"]:
        """Return the features of each clip."""
        ...


def require_pictures(*pictures: Picture) -> None:
    """Raise unless all are (3, h, w) uint8 pictures of one size.

    Raises:
        EvaluationError: Else; it says what was found.
    """
    for picture in pictures:
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[0] != 3:
            raise EvaluationError(
                "a picture must be uint8 RGB of shape (3, h, w), "
                f"got {picture.dtype} of shape {picture.shape}."
            )
    if len({picture.shape for picture in pictures}) > 1:
        sizes = " and ".join("x".join(map(str, picture.shape[:0:-1])) for picture in pictures)
        raise EvaluationError(f"the pictures of one score must be of one size, got {sizes}.")


def require_batch(pictures: Pictures) -> None:
    """Raise unless these are (n, 3, h, w) uint8 pictures.

    Raises:
        EvaluationError: Else; it says what was found.
    """
    if pictures.dtype != np.uint8 or pictures.ndim != 4 or pictures.shape[1] != 3:
        raise EvaluationError(
            "pictures must be uint8 RGB of shape (n, 3, h, w), "
            f"got {pictures.dtype} of shape {pictures.shape}."
        )


def require_clips(clips: Clips) -> None:
    """Raise unless these are (n, t, 3, h, w) uint8 clips.

    Raises:
        EvaluationError: Else; it says what was found.
    """
    if clips.dtype != np.uint8 or clips.ndim != 5 or clips.shape[2] != 3:
        raise EvaluationError(
            "clips must be uint8 RGB of shape (n, t, 3, h, w), "
            f"got {clips.dtype} of shape {clips.shape}."
        )
