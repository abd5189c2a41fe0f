"""Features without learned weights: stand-ins where Inception and I3D are not available.

They see colour, contrast and change, not content. Their distances say nothing about realism, have
other units than FID and FVD, and never bear these names.
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
    """Mean colours of a grid of tiles, and mean differences of near pixels; `ImageFeatures`."""

    name = "colour statistics (stand-in)"
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
        return np.array(features, dtype=np.float64).reshape(len(pictures), _TILES + _EDGES)


class MotionStatistics:
    """Colour statistics, mean over a clip, and mean changes from frame to frame of its tiles.

    They are `VideoFeatures`.
    """

    name = "motion statistics (stand-in)"
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
        require_clips(clips, frames=self.min_frames, name=self.name)
        _require_size(clips)
        features = np.empty((len(clips), _TILES + _EDGES + _TILES))
        for row, clip in zip(features, clips, strict=True):
            row[:-_TILES] = np.mean([_described(frame) for frame in clip], axis=0)
            changes = (_apart(one, two) for one, two in zip(clip[1:], clip[:-1], strict=True))
            row[-_TILES:] = np.mean([_tiles(change) for change in changes], axis=0)
        return features


def _described(picture: Picture) -> Float64[np.ndarray, " dim"]:
    along_rows = [_apart(picture[:, :, step:], picture[:, :, :-step]) for step in _STEPS_PX]
    along_columns = [_apart(picture[:, step:], picture[:, :-step]) for step in _STEPS_PX]
    edges = [apart.mean(axis=(1, 2), dtype=np.float64) for apart in (*along_rows, *along_columns)]
    return np.concatenate([_tiles(picture), *edges])


def _apart(one: Picture, two: Picture) -> Picture:
    """Return |one - two| without leaving 8 bits."""
    return np.asarray(np.maximum(one, two) - np.minimum(one, two))


def _tiles(picture: Picture) -> Float64[np.ndarray, " tiles"]:
    """Return the mean colours of a grid of tiles of nearly equal size."""
    rows, columns = (np.linspace(0, side, _GRID + 1).astype(int) for side in picture.shape[1:])
    by_row = np.add.reduceat(picture, rows[:-1], axis=1, dtype=np.int64)
    sums = np.add.reduceat(by_row, columns[:-1], axis=2)
    return np.asarray(sums / (np.diff(rows)[:, None] * np.diff(columns))).reshape(-1)


def _require_size(pictures: Pictures | Clips) -> None:
    if min(pictures.shape[-2:]) < _LEAST_SIDE_PX:
        raise EvaluationError(
            f"picture statistics need sides of at least {_LEAST_SIDE_PX} px, "
            f"got {pictures.shape[-1]}x{pictures.shape[-2]}."
        )
