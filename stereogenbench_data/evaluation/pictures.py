"""Pictures as the metrics take them: uint8 RGB, channel first, two of one size."""

from types import ModuleType

import numpy as np

from stereogenbench_data.errors import EvaluationError, ExtraError
from stereogenbench_data.evaluation.protocols import Clips, Picture, Pictures


def require_pictures(*pictures: Picture) -> None:
    """Return if all are (3, h, w) uint8 pictures of one size.

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
    """Return if these are (n, 3, h, w) uint8 pictures.

    Raises:
        EvaluationError: Else; it says what was found.
    """
    if pictures.dtype != np.uint8 or pictures.ndim != 4 or pictures.shape[1] != 3:
        raise EvaluationError(
            "pictures must be uint8 RGB of shape (n, 3, h, w), "
            f"got {pictures.dtype} of shape {pictures.shape}."
        )


def require_clips(clips: Clips) -> None:
    """Return if these are (n, t, 3, h, w) uint8 clips.

    Raises:
        EvaluationError: Else; it says what was found.
    """
    if clips.dtype != np.uint8 or clips.ndim != 5 or clips.shape[2] != 3:
        raise EvaluationError(
            "clips must be uint8 RGB of shape (n, t, 3, h, w), "
            f"got {clips.dtype} of shape {clips.shape}."
        )


def require_opencv() -> ModuleType:
    """Return the module ``cv2``.

    Raises:
        ExtraError: If it is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise ExtraError(
            "SSIM, SIFT and SGBM need OpenCV: pip install 'stereogenbench-data[evaluation]'"
        ) from error
    return cv2
