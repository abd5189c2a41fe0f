"""What the pictures of a scene have in common, found without any depth.

Rows of two rectified pictures are correlated: every pixel of a row is compared with every pixel of
the same row of the other picture. So no range of disparities is assumed, and no near optimum is
locked to, whatever the depth claims. RowMatches that hold in both directions are kept. numpy alone
does it: a row's comparisons are one product of matrices.

`SceneFrames` holds one scene's pictures and stored depth, and predicts by a hypothesis which
disparity each matched pixel should have.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8, UInt16
from numpy.lib.stride_tricks import sliding_window_view

from stereogenbench_data.audit.contract.hypotheses import LAGS, Flip, Hypothesis
from stereogenbench_data.errors import MediaError
from stereogenbench_data.geometry.camera import Intrinsics, rig_intrinsics
from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.schema.records import DepthEncoding, Scene
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
"""How much better than the second best place, more than `_NEAR_PX` away, a match must be."""
_NEAR_PX: Final = 3
_LEAST_SLOPE: Final = 2.0
"""Root mean square of the horizontal slope in a patch, in grey levels a pixel: texture."""
_BLOCK: Final = 2**18
"""Multiplications in one product of matrices. BLAS starts threads for more; in several processes
on a busy machine they wait for one another (25 times slower, measured)."""

Luma = Float32[np.ndarray, "h w"]


@dataclass(frozen=True, slots=True, eq=False)
class RowMatches:
    """Pixels of a left picture that were found again in the right one.

    Attributes:
        rows: (n,) rows.
        columns: (n,) columns.
        disparity_px: (n,) how far to the left each was found, negative for to the right.
        textured: How many pixels were looked for.
        grain_px: Size of the pixels that were compared.
    """

    rows: Int64[np.ndarray, " n"]
    columns: Int64[np.ndarray, " n"]
    disparity_px: Float32[np.ndarray, " n"]
    textured: int
    grain_px: float = 1.0


def match_rows(left: Luma, right: Luma) -> RowMatches:
    """Return what a left picture has in common with the right one of a rectified pair."""
    return match_pairs({0: left, 1: right}, [(0, 1)])[0, 1]


def match_pairs(
    pictures: Mapping[int, Luma], pairs: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], RowMatches]:
    """Return what the left and the right picture of each pair have in common.

    Large pictures are matched at 512 columns or fewer, and then disparity is good to half a pixel
    of the full size; else to about 0.2 pixels. The patches of a row are cut once for all pairs.

    Args:
        pictures: (h, w) grey levels of views by number, all of one size, rows aligned.
        pairs: Numbers of the left and the right picture.
    """
    height, width = next(iter(pictures.values())).shape
    factor = -(-width // _WIDEST_PX)
    small = {number: _reduced(picture, factor=factor) for number, picture in pictures.items()}
    height, width = height // factor, width // factor
    if min(height, width) <= 2 * _RADIUS_PX:
        return {pair: _gathered([], factor=factor, textured=0) for pair in pairs}
    inner = np.arange(_RADIUS_PX, height - _RADIUS_PX)
    rows = inner[np.unique(np.linspace(0, len(inner) - 1, min(_ROWS, len(inner))).astype(int))]
    found: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray, np.ndarray]]]
    found = {pair: [] for pair in pairs}
    textured = dict.fromkeys(pairs, 0)
    left_numbers = {left for left, _ in pairs}
    for row in rows:
        windows = {number: _windows(picture, row) for number, picture in small.items()}
        patches = {number: _normalised(each) for number, each in windows.items()}
        has_texture = {number: _has_texture(windows[number]) for number in left_numbers}
        for left, right in pairs:
            is_textured = has_texture[left]
            textured[left, right] += int(is_textured.sum())
            columns, disparity_px = _match_row(_product(patches[left], patches[right]), is_textured)
            found[left, right].append(
                (np.full(len(columns), row), columns + _RADIUS_PX, disparity_px)
            )
    return {pair: _gathered(found[pair], factor=factor, textured=textured[pair]) for pair in pairs}


def _reduced(picture: Luma, *, factor: int) -> Luma:
    """Return the means of blocks of factor x factor pixels."""
    height, width = (side // factor * factor for side in picture.shape)
    blocks = picture[:height, :width].reshape(height // factor, factor, width // factor, factor)
    reduced: Luma = blocks.mean(axis=(1, 3), dtype=np.float32)
    return reduced


def _windows(picture: Luma, row: int) -> Float32[np.ndarray, "columns side side"]:
    """Return the patches around a row's inner columns, as views of the picture."""
    band = picture[row - _RADIUS_PX : row + _RADIUS_PX + 1]
    side = 2 * _RADIUS_PX + 1
    windows: Float32[np.ndarray, "columns side side"]
    windows = sliding_window_view(band, (side, side))[0]
    return windows


def _has_texture(windows: Float32[np.ndarray, "columns side side"]) -> Bool[np.ndarray, " columns"]:
    slopes = np.diff(windows, axis=-1)
    textured: Bool[np.ndarray, " columns"]
    textured = np.sqrt((slopes**2).mean(axis=(1, 2))) >= _LEAST_SLOPE
    return textured


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
    """Return the columns that match one place well, alone and both ways, and their disparity."""
    width = correlation.shape[1]
    columns = np.flatnonzero(textured)
    scores = correlation[columns]
    best = scores.argmax(axis=1)
    each = np.arange(len(columns))
    top = scores[each, best]
    back = correlation.argmax(axis=0)[best]
    # A copy of the rows is masked near the best place: what is left is the second best.
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


def _gathered(
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]], *, factor: int, textured: int
) -> RowMatches:
    """Put rows together and return to the full size, where a block's centre is a pixel or near."""
    empty = (np.zeros(0, int), np.zeros(0, int), np.zeros(0, np.float32))
    rows, columns, disparity_px = (
        np.concatenate(part) for part in zip(*[empty, *found], strict=True)
    )
    return RowMatches(
        rows=rows.astype(np.int64) * factor + factor // 2,
        columns=columns.astype(np.int64) * factor + factor // 2,
        disparity_px=(disparity_px * factor).astype(np.float32),
        textured=textured,
        grain_px=float(factor),
    )


Points = Float64[np.ndarray, " n"]
_Prediction = tuple[Points, Bool[np.ndarray, " n"]]
_Numbers = tuple[UInt16[np.ndarray, " n"], Bool[np.ndarray, " n"]]

_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)
_BLUR: Final = np.array([1, 4, 6, 4, 1], dtype=np.float32) / 16
_MEAN_RADIUS_PX: Final = 6
_MOST_POINTS: Final = 2000
_MOST_DEPTH_BYTES: Final = 96 * 2**20
"""Decoded depth that is kept: every lag of every camera of small pictures."""
SIDE_CELLS: Final = 4
"""Parts of a picture along each side. Their spread gives the error of a comparison."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameMatch:
    """What one frame of two cameras has in common, found in the pictures alone.

    Attributes:
        frame: The RGB frame.
        left: Number of the file whose pixels these are.
        right: Number of the file in which they were found again.
        rows: (n,) rows of the pixels.
        columns: (n,) columns.
        matched_px: (n,) how far to the left they were found.
        brightness: (n,) band-passed grey levels there.
        slope: (n,) their horizontal derivative.
        cells: (n,) in which part of the picture each pixel lies.
        cap: The square of a difference between pixels that have nothing to do with each other.
        textured: How many pixels were looked for.
        grain_px: Size of the pixels that were matched: those of large pictures are put together.
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
    textured: int
    grain_px: float = 1.0

    @property
    def pair(self) -> tuple[int, int]:
        """The two files, the lower number first."""
        return min(self.left, self.right), max(self.left, self.right)

    def at(self, pixels: Bool[np.ndarray, " n"]) -> "FrameMatch":
        """Return the frame match of some of its pixels alone."""
        return replace(
            self, rows=self.rows[pixels], columns=self.columns[pixels],
            matched_px=self.matched_px[pixels], brightness=self.brightness[pixels],
            slope=self.slope[pixels], cells=self.cells[pixels],
        )  # fmt: skip

    def shift_px(self, offsets_px: dict[tuple[int, int], float]) -> float:
        """Return the constant disparity here, of those of pairs seen from their lower number."""
        offset_px = offsets_px.get(self.pair, 0.0)
        return offset_px if self.left < self.right else -offset_px


class SceneFrames:
    """One scene's pictures and depth, each decoded once."""

    def __init__(self, scene: Scene, streams: Streams, *, encoding: DepthEncoding) -> None:
        """Take a scene; ``encoding`` is the declared contract, whose unit may wait for the tags."""
        self.scene = scene
        self.encoding = encoding
        self.intrinsics: Intrinsics = rig_intrinsics(scene.rig)
        self._streams = streams
        self._bands: dict[tuple[int, int], Luma] = {}
        self._stored: dict[tuple[int, int, int], tuple[FrameMatch, dict[Flip, _Numbers]]] = {}
        self._predicted_by: Hypothesis | None = None
        self._predictions: dict[tuple[int, int], tuple[FrameMatch, _Prediction | None]] = {}
        self._depths: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    @property
    def primary(self) -> tuple[int, int]:
        """The primary pair, the lower number first."""
        left, right = sorted(self.scene.rig.primary_pair)
        return left, right

    def unit_m(self, file: int) -> float:
        """Return the declared unit of a depth file; the release's default where there is none."""
        unit_m = self.encoding.unit_m or self.scene.depth_unit_m[file]
        return unit_m if np.isfinite(unit_m) else DEFAULT_DEPTH_UNIT_M

    def rgb(self, frame: int, file: int) -> UInt8[np.ndarray, "3 h w"]:
        """Return a picture."""
        picture: UInt8[np.ndarray, "3 h w"] = self._streams.rgb(
            self.scene, rgb_name(file), frame, size=None
        )
        expected = (self.intrinsics.height_px, self.intrinsics.width_px)
        _require_size(picture.shape[1:], expected, where=f"{self.scene.id.key}/{rgb_name(file)}")
        return picture

    def band(self, frame: int, file: int) -> Luma:
        """Return a picture's grey levels without noise and without slow changes of brightness."""
        if (frame, file) not in self._bands:
            luma = np.tensordot(_LUMA, self.rgb(frame, file).astype(np.float32), axes=1)
            self._bands[frame, file] = band_passed(luma)
        return self._bands[frame, file]

    def depth(
        self, frame: int, file: int
    ) -> tuple[UInt16[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """Return stored depth and where it was measured."""
        if (frame, file) in self._depths:
            return self._depths[frame, file]
        name = depth_name(file)
        stored = self._streams.read_stored_depth(self.scene, name, frame, encoding=self.encoding)
        units = stored.units
        expected = (self.intrinsics.height_px, self.intrinsics.width_px)
        _require_size(units.shape, expected, where=f"{self.scene.id.key}/{name}")
        if (len(self._depths) + 1) * units.size * 3 > _MOST_DEPTH_BYTES and self._depths:
            self._depths.pop(next(iter(self._depths)))
        self._depths[frame, file] = units, stored.measured & (units > 0)
        return self._depths[frame, file]

    def _numbers(self, match: FrameMatch, *, frame: int, file: int) -> dict[Flip, _Numbers]:
        """Return what a depth frame stores at a frame match's pixels, as it is and turned over.

        Only these numbers are kept: whole maps of all lags and cameras would fill the memory.
        """
        key = (id(match), frame, file)
        if key not in self._stored:
            units, known = self.depth(frame, file)
            height, width = units.shape
            places: dict[Flip, tuple[np.ndarray, np.ndarray]] = {
                "none": (match.rows, match.columns),
                "vertical": (height - 1 - match.rows, match.columns),
                "horizontal": (match.rows, width - 1 - match.columns),
            }
            numbers = {flip: (units[place], known[place]) for flip, place in places.items()}
            # The frame match is kept too, so that no other can get its identity.
            self._stored[key] = (match, numbers)
        return self._stored[key][1]

    def depth_step(self, frame: int) -> float:
        """Return how far apart neighbouring depths of a frame lie, as a share: `relative_step`."""
        units, known = self.depth(frame, self.primary[0])
        return relative_step(units[known])

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
        """Return what pairs of several frames have in common, seen from either side.

        The pairs are those that stand beside each other by a hypothesis's order of cameras.
        """
        pairs = self.chosen_pairs(hypothesis or Hypothesis())
        files = dict.fromkeys(itertools.chain.from_iterable(pairs))
        matches: list[FrameMatch] = []
        for frame in chosen_frames(self.scene.frames, count=frames):
            found = match_pairs({file: self.band(frame, file) for file in files}, pairs)
            for (left, right), row_matches in found.items():
                matches += self._both_ways(frame, left, right, row_matches)
        return matches

    def chosen_pairs(self, hypothesis: Hypothesis) -> list[tuple[int, int]]:
        """Return pairs in which every camera stands beside others: next to it, and next but one.

        The primary and the widest pair are among them. The lower number comes first.
        """
        across = self._across(hypothesis)
        beside = ((min(pair), max(pair)) for pair in zip(across, across[2:], strict=False))
        return list(dict.fromkeys([*self.neighbours(hypothesis), *beside]))

    def neighbours(self, hypothesis: Hypothesis) -> list[tuple[int, int]]:
        """Return the primary pair, those that stand next to each other, and the widest."""
        across = self._across(hypothesis)
        pairs = [self.primary, *itertools.pairwise(across), (across[0], across[-1])]
        return list(dict.fromkeys((min(pair), max(pair)) for pair in pairs))

    def _across(self, hypothesis: Hypothesis) -> list[int]:
        """Return the numbers of the pictures' files from left to right."""
        return sorted(
            range(CAMERA_COUNT),
            key=lambda file: self.scene.lateral_m[hypothesis.camera_of(file, content="rgb")],
        )

    def _both_ways(
        self, frame: int, left: int, right: int, row_matches: RowMatches
    ) -> tuple[FrameMatch, FrameMatch]:
        """Return one set of matches from both sides, so that either camera's depth is tested."""
        here, there = self.band(frame, left), self.band(frame, right)
        keep = np.arange(len(row_matches.rows))
        if len(keep) > _MOST_POINTS:
            chosen = np.random.default_rng(0).choice(keep, _MOST_POINTS, replace=False)
            keep = np.sort(chosen)
        rows, columns = row_matches.rows[keep], row_matches.columns[keep]
        matched_px = row_matches.disparity_px[keep].astype(np.float64)
        width = here.shape[1]
        found = np.clip(np.rint(columns - matched_px), 0, width - 1).astype(np.int64)
        matches = (
            _frame_match(here, rows, columns, matched_px, frame=frame, files=(left, right)),
            _frame_match(there, rows, found, -matched_px, frame=frame, files=(right, left)),
        )
        here_seen, there_seen = (
            replace(match, textured=row_matches.textured, grain_px=row_matches.grain_px)
            for match in matches
        )
        return here_seen, there_seen

    def predicted(
        self, match: FrameMatch, hypothesis: Hypothesis, *, depth_file: int | None = None
    ) -> _Prediction | None:
        """Return the disparity of matched pixels at the declared unit, and where it is known.

        None where the frame of depth does not exist. ``depth_file`` is read in place of the one
        that the hypothesis names. The predictions of one hypothesis are kept, read-only, until
        another is asked for: it is fitted, scored and drawn at many scales.
        """
        file = hypothesis.depth_file(match.left) if depth_file is None else depth_file
        if hypothesis != self._predicted_by:
            self._predicted_by, self._predictions = hypothesis, {}
        key = (id(match), file)
        if key not in self._predictions:
            # The frame match is kept too, so that no other can get its identity.
            prediction = self._predict(match, hypothesis, file=file)
            self._predictions[key] = (match, prediction)
        return self._predictions[key][1]

    def _predict(
        self, match: FrameMatch, hypothesis: Hypothesis, *, file: int
    ) -> _Prediction | None:
        frame = match.frame + hypothesis.frame_lag
        if not 0 <= frame < self.scene.frames:
            return None
        units, known = self._numbers(match, frame=frame, file=file)[hypothesis.flip]
        number = np.where(known, units, 1).astype(np.float64)
        place = match.rows, match.columns
        disparity_px = self.disparity_of(number, match, hypothesis, place=place, file=file)
        disparity_px.flags.writeable = known.flags.writeable = False
        return disparity_px, known

    def disparity_of(
        self,
        number: Points,
        match: FrameMatch,
        hypothesis: Hypothesis,
        *,
        place: tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]],
        file: int,
    ) -> Points:
        """Return the disparity, between a frame match's files, that stored depths mean."""
        unit_m = self.unit_m(file)
        per_m = 1 / (unit_m * number) if hypothesis.form == "depth" else number / unit_m
        if hypothesis.kind == "ray":
            per_m *= self.ray_per_planar[place]
        disparity_px: Points = self.intrinsics.fx_px * self.baseline_m(match, hypothesis) * per_m
        return disparity_px

    def baseline_m(self, match: FrameMatch, hypothesis: Hypothesis) -> float:
        """Return the signed baseline of a frame match's two files."""
        left, right = (
            hypothesis.camera_of(file, content="rgb") for file in (match.left, match.right)
        )
        lateral_m = self.scene.lateral_m
        baseline_m = lateral_m[right] - lateral_m[left]
        return -baseline_m if hypothesis.is_mirrored else baseline_m


def _frame_match(
    here: Luma,
    rows: Int64[np.ndarray, " n"],
    columns: Int64[np.ndarray, " n"],
    matched_px: Points,
    *,
    frame: int,
    files: tuple[int, int],
) -> FrameMatch:
    brightness = here[rows, columns]
    height, width = here.shape
    after, before = np.minimum(columns + 1, width - 1), np.maximum(columns - 1, 0)
    return FrameMatch(
        frame=frame,
        left=files[0],
        right=files[1],
        rows=rows,
        columns=columns,
        matched_px=matched_px,
        brightness=brightness,
        slope=(here[rows, after] - here[rows, before]) / 2,
        cells=rows * SIDE_CELLS // height * SIDE_CELLS + columns * SIDE_CELLS // width,
        cap=2 * float((brightness**2).mean()) if len(rows) else 1.0,
        textured=0,
    )


def disparity_px(matches: Sequence[FrameMatch]) -> float:
    """Return the root mean square of found disparities."""
    return float(np.sqrt((np.concatenate([match.matched_px for match in matches]) ** 2).mean()))


def spread_px(matches: Sequence[FrameMatch]) -> float:
    """Return the root mean square of found disparities about the mean of each frame match."""
    spreads = [match.matched_px - match.matched_px.mean() for match in matches if len(match.rows)]
    return float(np.sqrt((np.concatenate(spreads) ** 2).mean())) if spreads else 0.0


def chosen_frames(available: int, *, count: int) -> list[int]:
    """Return frames spread over a scene, where it is long enough with room for every lag."""
    margin = min(max(LAGS), max(0, (available - 1) // 2))
    spread = np.linspace(margin, available - 1 - margin, min(count, available - 2 * margin))
    return sorted({round(float(frame)) for frame in spread})


def relative_step(numbers: UInt16[np.ndarray, " n"]) -> float:
    """Return the step to the next number that occurs, over the number: the pixels' upper quartile.

    0 where there is no number at all.
    """
    values, counts = np.unique(numbers, return_counts=True)
    if not len(values):
        return 0.0
    gaps = np.diff(values.astype(np.float64))
    nearest = np.minimum(np.append(np.inf, gaps), np.append(gaps, np.inf))
    shares = np.where(np.isfinite(nearest), nearest, 1.0) / np.maximum(values, 1)
    order = shares.argsort()
    return float(shares[order][np.searchsorted(counts[order].cumsum(), 0.75 * len(numbers))])


def band_passed(luma: Luma) -> Luma:
    """Return grey levels blurred a little, less their mean over 13 x 13 pixels."""
    blurred, mean = luma, luma
    box = np.full(2 * _MEAN_RADIUS_PX + 1, 1 / (2 * _MEAN_RADIUS_PX + 1), dtype=np.float32)
    for axis in (0, 1):
        blurred = _along(blurred, _BLUR, axis=axis)
        mean = _along(mean, box, axis=axis)
    band: Luma = blurred - mean
    return band


def _along(picture: Luma, taps: Float32[np.ndarray, " k"], *, axis: int) -> Luma:
    """Return a picture convolved along one axis, its border repeated."""
    radius = len(taps) // 2
    margins = [(radius, radius) if each == axis else (0, 0) for each in (0, 1)]
    padded = np.pad(picture, margins, mode="edge")
    length = picture.shape[axis]
    moved = (padded.take(range(start, start + length), axis=axis) for start in range(len(taps)))
    total: Luma = np.zeros_like(picture)
    for tap, shifted in zip(taps, moved, strict=True):
        total += tap * shifted
    return total


def _require_size(found: Sequence[int], expected: tuple[int, int], *, where: str) -> None:
    if tuple(found) != expected:
        raise MediaError(
            f"{where}: is {found[1]}x{found[0]} px where the scene's metadata says "
            f"{expected[1]}x{expected[0]}: correct image_width and image_height, or the video."
        )
