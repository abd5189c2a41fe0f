"""Stereo matches of a scene's pictures, found without depth, and the disparity that depth predicts.

Each pixel of a row is correlated with every pixel of the same row of the other, rectified picture.
So no range of disparities is assumed, and wrong depth cannot mislead the search. Matches that hold
in both directions are kept. A row's correlations are one matrix product.

`SceneFrames` holds one scene's pictures and stored depth, and predicts the disparity of matched
pixels by a hypothesis.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt16
from numpy.lib.stride_tricks import sliding_window_view

from stereogenbench_data.audit.contract.hypotheses import LAGS, Flip, Hypothesis
from stereogenbench_data.audit.geometry.picture_check import Luma, band_passed, luma_of
from stereogenbench_data.audit.geometry.reprojection import MeasuredDepth
from stereogenbench_data.geometry.camera import Intrinsics, rig_intrinsics
from stereogenbench_data.samples.load import Streams
from stereogenbench_data.schema.records import DepthEncoding, DepthKind, Scene
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    DEFAULT_DEPTH_UNIT_M,
    depth_name,
    rgb_name,
)

_WIDEST_PX: Final = 512
_ROWS: Final = 64
_RADIUS_PX: Final = 4
_LEAST_CORRELATION: Final = 0.75
_LEAST_LEAD: Final = 0.04
"""How much a match must beat the best place more than `_NEAR_PX` away from it."""
_NEAR_PX: Final = 3
_LEAST_SLOPE: Final = 2.0
"""Least root mean square of the horizontal slope in a patch with texture, grey levels a pixel."""
_BLOCK: Final = 2**18
"""Multiplications in one matrix product. For more BLAS starts threads, which wait for one another
where several processes share a machine (25 times slower, measured)."""


RowMatches = Float32[np.ndarray, "n 3"]


def match_pairs(
    pictures: Mapping[int, Luma], pairs: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], RowMatches]:
    """Return the matches of each pair: row, column, and how far to the left each was found, in px.

    Disparity is accurate to about 0.2 pixels. Pictures wider than 512 columns are reduced first;
    then it is accurate to half a pixel of the full size.

    Args:
        pictures: (h, w) grey levels of views by number, all of one size, rows aligned.
        pairs: Numbers of the left and the right picture.
    """
    height, width = next(iter(pictures.values())).shape
    factor = _grain(width)
    height, width = height // factor, width // factor
    small = {  # the means of blocks of factor x factor pixels
        number: picture[: height * factor, : width * factor]
        .reshape(height, factor, width, factor)
        .mean(axis=(1, 3), dtype=np.float32)
        for number, picture in pictures.items()
    }
    inner = np.arange(_RADIUS_PX, height - _RADIUS_PX if width > 2 * _RADIUS_PX else 0)
    rows = inner[np.unique(np.linspace(0, len(inner) - 1, min(_ROWS, len(inner))).astype(int))]
    found: dict[tuple[int, int], list[np.ndarray]]
    found = {pair: [np.zeros((0, 3), dtype=np.float32)] for pair in pairs}
    left_numbers = {left for left, _ in pairs}
    side = 2 * _RADIUS_PX + 1
    for row in rows:
        # The patches around the row's inner columns, (columns, side, side), cut once for all pairs.
        windows = {
            number: sliding_window_view(
                picture[row - _RADIUS_PX : row + _RADIUS_PX + 1], (side, side)
            )[0]
            for number, picture in small.items()
        }
        patches = {number: _normalised(each) for number, each in windows.items()}
        slopes = {number: np.diff(windows[number], axis=-1) for number in left_numbers}
        has_texture = {
            number: np.sqrt((each**2).mean(axis=(1, 2))) >= _LEAST_SLOPE
            for number, each in slopes.items()
        }
        for left, right in pairs:
            columns, disparity_px = _match_row(
                _product(patches[left], patches[right]), has_texture[left]
            )
            here = np.full(len(columns), row), columns + _RADIUS_PX, disparity_px
            found[left, right].append(np.stack(here, axis=-1, dtype=np.float32))
    # A block's centre is a pixel or nearly so.
    middle = np.array([factor // 2, factor // 2, 0], dtype=np.float32)
    return {pair: np.concatenate(rows) * factor + middle for pair, rows in found.items()}


def _grain(width_px: int) -> int:
    """Return the size of the pixels that are compared, in pixels of a picture."""
    return -(-width_px // _WIDEST_PX)


def _normalised(
    windows: Float32[np.ndarray, "columns side side"],
) -> Float32[np.ndarray, "columns pixels"]:
    """Return patches with mean 0 and length 1."""
    flat = windows.reshape(len(windows), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    normalised: Float32[np.ndarray, "columns pixels"] = flat / np.maximum(length, 1e-3)
    return normalised


def _product(
    here: Float32[np.ndarray, "left pixels"], there: Float32[np.ndarray, "right pixels"]
) -> Float32[np.ndarray, "left right"]:
    """Return here @ there.T, a few rows at a time."""
    few = max(1, _BLOCK // there.size)
    product = np.empty((len(here), len(there)), dtype=np.float32)
    for start in range(0, len(here), few):
        np.matmul(here[start : start + few], there.T, out=product[start : start + few])
    return product


def _match_row(
    correlation: Float32[np.ndarray, "left right"], textured: np.ndarray
) -> tuple[Int64[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Return the columns with one good match that holds both ways, and their disparity."""
    width = correlation.shape[1]
    columns = np.flatnonzero(textured)
    scores = correlation[columns]
    best = scores.argmax(axis=1)
    each = np.arange(len(columns))
    top = scores[each, best]
    back = correlation.argmax(axis=0)[best]
    # In a copy, the scores near the best place are masked to find the second best.
    for step in range(-_NEAR_PX, _NEAR_PX + 1):
        scores[each, np.clip(best + step, 0, width - 1)] = -1.0
    second = scores.max(axis=1)
    keep = (top >= _LEAST_CORRELATION) & (top - second >= _LEAST_LEAD)
    keep &= (np.abs(back - columns) <= 1) & (best > 0) & (best < width - 1)
    columns, best = columns[keep], best[keep]
    before, peak, after = (correlation[columns, best + step] for step in (-1, 0, 1))
    curvature = before - 2 * peak + after
    shift = np.where(curvature < 0, (before - after) / np.where(curvature < 0, 2 * curvature, 1), 0)
    return columns, (columns - best - np.clip(shift, -0.5, 0.5)).astype(np.float32)


Points = Float64[np.ndarray, " n"]
_Prediction = tuple[Points, Bool[np.ndarray, " n"]]
_Numbers = tuple[UInt16[np.ndarray, " n"], Bool[np.ndarray, " n"]]


_MOST_POINTS: Final = 2000
SIDE_CELLS: Final = 4
"""Number of parts along each side of a picture. Their spread gives a comparison's error."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameMatch:
    """The matches of one frame of two cameras, found in the pictures alone.

    Attributes:
        frame: The RGB frame.
        left: Number of the file that has these pixels.
        right: Number of the file in which they were found.
        rows: (n,) rows of the pixels.
        columns: (n,) columns.
        matched_px: (n,) how far to the left they were found.
        brightness: (n,) band-passed grey levels there.
        slope: (n,) their horizontal derivative.
        cells: (n,) the part of the picture that each pixel lies in.
        cap: The squared difference between unrelated pixels.
        grain_px: Size of the compared pixels, in pixels of the picture.
    """

    frame: int
    left: int
    right: int
    rows: Int64[np.ndarray, " n"]
    columns: Int64[np.ndarray, " n"]
    matched_px: Points
    brightness: Float32[np.ndarray, " n"]
    slope: Float32[np.ndarray, " n"]
    cells: Int64[np.ndarray, " n"]
    cap: float
    grain_px: int = 1

    @property
    def pair(self) -> tuple[int, int]:
        """The two files, the lower number first."""
        return min(self.left, self.right), max(self.left, self.right)

    def at(self, pixels: Bool[np.ndarray, " n"]) -> "FrameMatch":
        """Return the match with some of its pixels."""
        each = ("rows", "columns", "matched_px", "brightness", "slope", "cells")
        return replace(self, **{name: getattr(self, name)[pixels] for name in each})


class SceneFrames:
    """One scene's pictures and depth."""

    def __init__(self, scene: Scene, streams: Streams, *, encoding: DepthEncoding) -> None:
        """Take a scene, and the declared contract, whose unit may come from the tags."""
        self.scene = scene
        self.encoding = encoding
        self.intrinsics: Intrinsics = rig_intrinsics(scene.rig)
        self._streams = streams
        self._bands: dict[tuple[int, int], Luma] = {}
        self._stored: dict[tuple[FrameMatch, int, int], dict[Flip, _Numbers]] = {}

    def read_as(self, encoding: DepthEncoding) -> "SceneFrames":
        """Return the same pictures and stored numbers, read by another contract."""
        other = copy(self)
        other.encoding = encoding
        return other

    @property
    def primary(self) -> tuple[int, int]:
        """The primary pair, the lower number first."""
        left, right = sorted(self.scene.rig.primary_pair)
        return left, right

    def unit_m(self, file: int) -> float:
        """Return the declared unit of a depth file; the release's default if there is none."""
        return self.scene.depth_encoding(file, self.encoding).unit_m or DEFAULT_DEPTH_UNIT_M

    def band(self, frame: int, file: int) -> Luma:
        """Return a picture's grey levels, band-passed."""
        if (frame, file) not in self._bands:
            picture = self._streams.rgb(self.scene, rgb_name(file), frame, size=None)
            self._bands[frame, file] = band_passed(luma_of(picture))
        return self._bands[frame, file]

    def depth(
        self, frame: int, file: int
    ) -> tuple[UInt16[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """Return stored depth and where it was measured."""
        stored = self._streams.read_stored_depth(
            self.scene, depth_name(file), frame, encoding=self.encoding
        )
        return stored.units, stored.measured & (stored.units > 0)

    def measured_depth(
        self, frame: int, file: int, *, kind: DepthKind | None = None
    ) -> MeasuredDepth:
        """Return the depth that belongs to a frame of pictures, read as a kind of depth.

        Args:
            frame: The frame of pictures.
            file: The camera.
            kind: None for the contract's; "planar" leaves the lengths of rays as they are.
        """
        units, measured = self.depth(frame + self.encoding.frame_lag, file)
        stated = self.scene.depth_encoding(file, self.encoding)
        encoding = replace(stated, unit_m=self.unit_m(file), kind=kind or stated.kind)
        return MeasuredDepth.of(units, measured, encoding=encoding, intrinsics=self.intrinsics)

    def _numbers(self, match: FrameMatch, *, frame: int, file: int) -> dict[Flip, _Numbers]:
        """Return what a depth frame stores at a match's pixels, as it is and flipped.

        Only these numbers are kept, because maps of all lags and cameras would fill the memory.
        """
        if (match, frame, file) not in self._stored:
            units, known = self.depth(frame, file)
            height, width = units.shape
            places: dict[Flip, tuple[np.ndarray, np.ndarray]] = {
                "none": (match.rows, match.columns),
                "vertical": (height - 1 - match.rows, match.columns),
                "horizontal": (match.rows, width - 1 - match.columns),
            }
            self._stored[match, frame, file] = {
                flip: (units[place], known[place]) for flip, place in places.items()
            }
        return self._stored[match, frame, file]

    @cached_property
    def ray_per_planar(self) -> Float64[np.ndarray, "h w"]:
        """The length of each pixel's ray to depth 1."""
        camera = self.intrinsics
        x = (np.arange(camera.width_px) + 0.5 - camera.cx_px) / camera.fx_px
        y = (np.arange(camera.height_px) + 0.5 - camera.cy_px) / camera.fy_px
        return np.sqrt(1 + x**2 + y[:, None] ** 2)

    def frame_matches(
        self, *, frames: int, hypothesis: Hypothesis | None = None
    ) -> list[FrameMatch]:
        """Return the matches of several frames, from either side of each chosen pair.

        The hypothesis's order of cameras decides which cameras are neighbours.
        """
        pairs = self.chosen_pairs(hypothesis or Hypothesis())
        files = dict.fromkeys(itertools.chain.from_iterable(pairs))
        matches: list[FrameMatch] = []
        for frame in chosen_frames(self.scene.frames, count=frames):
            found = match_pairs({file: self.band(frame, file) for file in files}, pairs)
            for (left, right), row_matches in found.items():
                matches += self._both_ways(frame, left, right, row_matches)
        return matches

    def frame_moves(self, parts: Sequence[int]) -> list[tuple[int, int]]:
        """Return frames and later ones whose depth is there, from the beginning and up to the end.

        They are such parts of the scene apart: a quarter for 4.
        """
        frames, lag = self.scene.frames, self.encoding.frame_lag
        first, last = max(0, -lag), min(frames, frames - lag) - 1
        steps = sorted({(last - first) // part for part in parts if last - first >= part})
        return [(start, start + step) for step in steps for start in {first, last - step}]

    def matched_later(self, frame: int, file: int, other: int, *, lag: int) -> FrameMatch | None:
        """Return the pixels of a file's frame that another file shows ``lag`` frames later.

        None if there is no such frame.
        """
        if not 0 <= frame + lag < self.scene.frames:
            return None
        pictures = {file: self.band(frame, file), other: self.band(frame + lag, other)}
        row_matches = match_pairs(pictures, [(file, other)])[file, other]
        return self._both_ways(frame, file, other, row_matches)[0]

    def chosen_pairs(self, hypothesis: Hypothesis) -> list[tuple[int, int]]:
        """Return the `neighbours`, and the pairs next but one; the lower number comes first."""
        across = self._across(hypothesis)
        beside = ((min(pair), max(pair)) for pair in zip(across, across[2:], strict=False))
        return list(dict.fromkeys([*self.neighbours(hypothesis), *beside]))

    def neighbours(self, hypothesis: Hypothesis) -> list[tuple[int, int]]:
        """Return the primary pair, the pairs next to each other, and the widest pair."""
        across = self._across(hypothesis)
        pairs = [self.primary, *itertools.pairwise(across), (across[0], across[-1])]
        return list(dict.fromkeys((min(pair), max(pair)) for pair in pairs))

    def _across(self, hypothesis: Hypothesis) -> list[int]:
        """Return the file numbers of the pictures from left to right."""
        return sorted(
            range(CAMERA_COUNT),
            key=lambda file: self.scene.lateral_m[hypothesis.camera_of(file, content="rgb")],
        )

    def _both_ways(
        self, frame: int, left: int, right: int, row_matches: RowMatches
    ) -> tuple[FrameMatch, FrameMatch]:
        """Return one set of matches from both sides, so that both cameras' depth is tested."""
        if len(row_matches) > _MOST_POINTS:
            chosen = np.random.default_rng(0).choice(len(row_matches), _MOST_POINTS, replace=False)
            row_matches = row_matches[np.sort(chosen)]
        rows, columns = row_matches[:, :2].T.astype(np.int64)
        matched_px = row_matches[:, 2].astype(np.float64)
        height, width = self.band(frame, left).shape
        found = np.clip(np.rint(columns - matched_px), 0, width - 1).astype(np.int64)
        sides = []
        for file, other, at, away_px in (
            (left, right, columns, matched_px), (right, left, found, -matched_px),
        ):  # fmt: skip
            band = self.band(frame, file)
            after, before = np.minimum(at + 1, width - 1), np.maximum(at - 1, 0)
            sides.append(
                FrameMatch(
                    frame=frame,
                    left=file,
                    right=other,
                    rows=rows,
                    columns=at,
                    matched_px=away_px,
                    brightness=band[rows, at],
                    slope=(band[rows, after] - band[rows, before]) / 2,
                    cells=rows * SIDE_CELLS // height * SIDE_CELLS + at * SIDE_CELLS // width,
                    cap=2 * float((band[rows, at] ** 2).mean()) if len(rows) else 1.0,
                    grain_px=_grain(width),
                )
            )
        return sides[0], sides[1]

    def predicted(
        self, match: FrameMatch, hypothesis: Hypothesis, *, depth_file: int | None = None
    ) -> _Prediction | None:
        """Return the disparity of matched pixels at the declared unit, and where it is known.

        None if the frame of depth does not exist. ``depth_file`` replaces the file that the
        hypothesis names.
        """
        file = hypothesis.depth_file(match.left) if depth_file is None else depth_file
        frame = match.frame + hypothesis.frame_lag
        if not 0 <= frame < self.scene.frames:
            return None
        units, known = self._numbers(match, frame=frame, file=file)[hypothesis.flip]
        number, unit_m = np.where(known, units, 1).astype(np.float64), self.unit_m(file)
        offset_m = self.scene.depth_encoding(file, self.encoding).offset_m
        is_depth = hypothesis.form == "depth"
        per_m = 1 / (offset_m + unit_m * number) if is_depth else number / unit_m
        if hypothesis.kind == "ray":
            per_m *= self.ray_per_planar[match.rows, match.columns]
        return self.intrinsics.fx_px * self.baseline_m(match, hypothesis) * per_m, known

    def baseline_m(self, match: FrameMatch, hypothesis: Hypothesis) -> float:
        """Return the signed baseline of a match's two files."""
        left, right = (
            hypothesis.camera_of(file, content="rgb") for file in (match.left, match.right)
        )
        lateral_m = self.scene.lateral_m
        baseline_m = lateral_m[right] - lateral_m[left]
        return -baseline_m if hypothesis.is_mirrored else baseline_m


def disparity_px(matches: Sequence[FrameMatch]) -> float:
    """Return the root mean square of found disparities, inf for none."""
    found = np.concatenate([match.matched_px for match in matches])
    return float(np.sqrt((found**2).mean())) if len(found) else math.inf


def chosen_frames(available: int, *, count: int) -> list[int]:
    """Return frames spread over a scene, with room for every lag if it is long enough."""
    margin = min(max(LAGS), max(0, (available - 1) // 2))
    spread = np.linspace(margin, available - 1 - margin, min(count, available - 2 * margin))
    return sorted({round(float(frame)) for frame in spread})


def relative_step(numbers: UInt16[np.ndarray, " n"]) -> float:
    """Return the upper quartile, over pixels, of the distance to the next number over the number.

    0 for no numbers.
    """
    values, counts = np.unique(numbers, return_counts=True)
    if not len(values):
        return 0.0
    gaps = np.diff(values.astype(np.float64))
    nearest = np.minimum(np.append(np.inf, gaps), np.append(gaps, np.inf))
    shares = np.where(np.isfinite(nearest), nearest, 1.0) / np.maximum(values, 1)
    return float(np.quantile(shares, 0.75, weights=counts, method="inverted_cdf"))
