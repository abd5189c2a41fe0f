"""Features without learned weights: stand-ins where Inception and I3D are not available.

They see colour, contrast and change, not content: distances of them tell nothing about realism,
have other units than FID and FVD, and are never called so.
"""

from typing import ClassVar, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.models.interfaces import (
    Clips,
    Picture,
    Pictures,
    Settings,
    require_batch,
    require_clips,
)

_GRID: Final = 4
_STEPS_PX: Final = (1, 2, 4)
_TILES: Final = 3 * _GRID**2
_EDGES: Final = 3 * 2 * len(_STEPS_PX)
_LEAST_SIDE_PX: Final = 8


class ColourStatistics:
    """Mean colours of a grid of tiles, and mean differences of near pixels.

    Attributes:
        name: What tables call it.
        distance: What a Fréchet distance of these features is called.
        dim: How many features there are.
        settings: Every choice that the features depend on.
    """

    name = "colour statistics (stand-in)"
    distance = "FD-colour"
    dim = _TILES + _EDGES
    settings: ClassVar[Settings] = {
        "features": f"mean RGB of {_GRID}x{_GRID} tiles; mean |difference| of pixels "
        f"{', '.join(map(str, _STEPS_PX))} px apart along rows and columns",
        "scale": "0 to 255",
    }

    def __call__(self, pictures: Pictures) -> Float64[np.ndarray, "n dim"]:
        """Return the features of each picture.

        Raises:
            EvaluationError: If they are not pictures of at least 8 x 8 pixels.
        """
        require_batch(pictures)
        _require_size(pictures)
        features = [_described(picture) for picture in pictures]
        return np.array(features, dtype=np.float64).reshape(len(pictures), self.dim)


class MotionStatistics:
    """Colour statistics, mean over a clip, and mean changes from frame to frame of its tiles.

    Attributes:
        name: What tables call it.
        distance: What a Fréchet distance of these features is called.
        dim: How many features there are.
        min_frames: How many frames a clip needs.
        settings: Every choice that the features depend on.
    """

    name = "motion statistics (stand-in)"
    distance = "FD-motion"
    dim = _TILES + _EDGES + _TILES
    min_frames = 2
    settings: ClassVar[Settings] = {
        "features": "colour statistics, mean over time; mean |difference| of consecutive frames "
        f"of {_GRID}x{_GRID} tiles",
        "scale": "0 to 255",
    }

    def __call__(self, clips: Clips) -> Float64[np.ndarray, "n dim"]:
        """Return the features of each clip.

        Raises:
            EvaluationError: If they are not clips of two frames and 8 x 8 pixels or more.
        """
        require_clips(clips)
        _require_size(clips)
        if clips.shape[1] < self.min_frames:
            raise EvaluationError(
                f"{self.name} need clips of at least {self.min_frames} frames, "
                f"got {clips.shape[1]}."
            )
        features = np.empty((len(clips), self.dim))
        for row, clip in zip(features, clips, strict=True):
            row[:-_TILES] = np.mean([_described(frame) for frame in clip], axis=0)
            changes = (_apart(one, two) for one, two in zip(clip[1:], clip[:-1], strict=True))
            row[-_TILES:] = np.mean([_tiles(change) for change in changes], axis=0)
        return features


def _described(picture: Picture) -> Float64[np.ndarray, " dim"]:
    edges = [
        _apart(picture[:, :, step:], picture[:, :, :-step]).mean(axis=(1, 2), dtype=np.float64)
        for step in _STEPS_PX
    ] + [
        _apart(picture[:, step:], picture[:, :-step]).mean(axis=(1, 2), dtype=np.float64)
        for step in _STEPS_PX
    ]
    return np.concatenate([_tiles(picture), *edges])


def _apart(one: Picture, two: Picture) -> Picture:
    """Return |one - two| without leaving 8 bits."""
    return np.asarray(np.maximum(one, two) - np.minimum(one, two))


def _tiles(picture: Picture) -> Float64[np.ndarray, " tiles"]:
    """Return the mean colours of a grid of tiles, all but equally large."""
    rows, columns = (np.linspace(0, side, _GRID + 1).astype(int)[:-1] for side in picture.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(picture, rows, axis=1, dtype=np.int64), columns, axis=2)
    heights = np.diff(np.append(rows, picture.shape[1]))
    widths = np.diff(np.append(columns, picture.shape[2]))
    return np.asarray(sums / (heights[:, None] * widths)).reshape(-1)


def _require_size(pictures: Pictures | Clips) -> None:
    if min(pictures.shape[-2:]) < _LEAST_SIDE_PX:
        raise EvaluationError(
            f"picture statistics need sides of at least {_LEAST_SIDE_PX} px, "
            f"got {pictures.shape[-1]}x{pictures.shape[-2]}."
        )
