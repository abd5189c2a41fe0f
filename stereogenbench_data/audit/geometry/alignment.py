"""Whether a scene's pictures, depth, poses and focal length fit together to a part of a pixel.

Points on smooth surfaces are taken from one camera to another, or from one moment to another, by
their depth and the recorded poses. On a plane 1 / depth is linear in the pixel, so the target's
inverse depth, interpolated at that place, equals the expected one but for rounding. The residual
is fitted by one parameter at a time (least squares, Tukey's weights): depth of one camera that is
shifted, scaled or along the ray; a wrong focal length, which shifts the depth of every camera by
its disparity. In the same way the difference of two pictures is fitted by a shift of one of them
(Lucas and Kanade, 1981), or by a factor of every disparity. The parameter that explains most is
kept, its camera is left out, and the rest is fitted again.

A point is seen through if the target sees something behind it. An occluder never causes that: it
hides what is behind it. In correct data the share of such points is 0 to 0.1 % between cameras at
one moment; moving objects cause it between two moments.

Standard errors come from sums over 16 parts of the picture in each of at most 5 moments, which
differ in content (sandwich estimate). A quantity is not testable if its error is as large as the
effect in question.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Float64

from stereogenbench_data.audit.geometry.records import Alignment, Estimate, PairFit
from stereogenbench_data.audit.geometry.reprojection import MeasuredDepth
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.schema.release import CAMERA_COUNT

ALIGNED_PAIRS: Final = tuple(
    (a, b)
    for a in range(CAMERA_COUNT)
    for b in range(CAMERA_COUNT)
    if abs(a - b) in (1, 2, CAMERA_COUNT - 1)
)
"""Directed pairs that are compared: neighbours, next but one, and the outermost."""

_POINTS: Final = 1600
_FEW_FRAMES: Final = 4
"""Fewer frames are compared in both directions; of more, each takes half of the directions."""
_FEWEST_POINTS: Final = 100
_CELLS: Final = 4
_MOMENTS: Final = 5
"""Number of groups of a scene's frames: frames of one group show the same content and share their
errors."""
_TOLERANCE: Final = 0.005
"""Share of the depth, plus two stored steps, beyond which a point counts as seen through. A smooth
surface bends by less between pixels."""
_VISIBLE: Final = 0.02
_BEND: Final = 0.004
"""Largest second difference of 1 / depth in a smooth patch, as a share, plus four steps."""
_COARSE: Final = 0.05
"""Depth whose stored steps are a larger share of it is too coarse to compare."""
_WINDOW: Final = {"depth": 0.05, "motion": 0.1}
"""Relative differences of depth beyond which a point has no weight."""
CERTAIN: Final = 6.0
"""How many standard errors an estimate must be away from 0. Among the 30 parameters of each of
8,000 scenes, 4 or 5 occur by chance, and parts of a picture are not quite independent."""

LEAST_CONTRAST: Final = 2.0
"""Least standard deviation, in grey levels, of a band-passed picture with texture."""
_NOTED: Final = {
    "shift": 0.05, "scale": 0.001, "ray": 0.02, "focal": 0.002,
}  # fmt: skip
"""Estimates below these are ignored; they are well below every limit."""

Points = Float64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class _Landed:
    """Points of one view that land in another, with derivatives of their place and depth there.

    ``by_*`` are (d column, d row, d log inverse depth) for a relative change of the point's
    inverse depth or of a focal length.
    """

    rows: np.ndarray
    columns: np.ndarray
    u_px: Points
    v_px: Points
    cell: np.ndarray
    off: Points
    steps: Points
    smooth: np.ndarray
    by_depth: tuple[Points, Points, Points]
    by_focal: tuple[tuple[Points, Points, Points], tuple[Points, Points, Points]]
    log_ray: tuple[Points, Points]
    slope: tuple[tuple[Points, Points], tuple[Points, Points]]

    def depth_columns(self) -> dict[str, tuple[Points, Points]]:
        """Return d(off) for each parameter: of the source's depth, and of the target's."""
        by_depth = self._seen(self.by_depth)
        (source_x, source_y), (target_x, target_y) = self.slope
        return {
            "scale": (-by_depth, -(1 + self.off)),
            "ray": (-self.log_ray[0] * by_depth, -self.log_ray[1]),
            "shift_x": (-source_x * by_depth, -target_x),
            "shift_y": (-source_y * by_depth, -target_y),
        }

    def focal_columns(self) -> tuple[Points, Points]:
        """Return d(off) for the horizontal and for the vertical focal length."""
        return self._seen(self.by_focal[0]), self._seen(self.by_focal[1])

    def _seen(self, moved: tuple[Points, Points, Points]) -> Points:
        target_x, target_y = self.slope[1]
        seen: Points = target_x * moved[0] + target_y * moved[1] - (1 + self.off) * moved[2]
        return seen


def _patch(depth: MeasuredDepth, rows: Any, columns: Any, *, side: int) -> Any:
    """Return 1 / depth of side x side pixels from (rows, columns), nan where not measured."""
    steps = np.arange(side)
    places = (rows + steps[:, None, None], columns + steps[:, None])
    known = depth.measured[places]
    return np.where(known, 1 / np.where(known, depth.depth_m[places], 1.0), np.nan)


def _bend(patch: Any) -> Any:
    """Return the largest second difference of a patch, over its inner pixels."""
    across = np.abs(patch[:, :-2] - 2 * patch[:, 1:-1] + patch[:, 2:])[1:-1]
    down = np.abs(patch[:-2] - 2 * patch[1:-1] + patch[2:])[:, 1:-1]
    return np.maximum(across, down).max(axis=(0, 1))


def _between(inner: Any, x: Points, y: Points) -> Any:
    """Return (2, 2, n) values interpolated bilinearly."""
    above, below = inner[0, 0] * (1 - x) + inner[0, 1] * x, inner[1, 0] * (1 - x) + inner[1, 1] * x
    return above * (1 - y) + below * y


def _landed(
    source: MeasuredDepth,
    target: MeasuredDepth,
    *,
    intrinsics: Intrinsics,
    motion: Float64[np.ndarray, "4 4"],
) -> _Landed | None:
    """Take evenly spread points to a target; return those that land in it, None if too few do."""
    height, width = source.depth_m.shape
    every = max(1, int((height * width / _POINTS) ** 0.5))
    rows, columns = (
        each.ravel() for each in np.mgrid[1 + every // 2:height - 1:every,
                                          1 + every // 2:width - 1:every]
    )  # fmt: skip
    known = source.measured[rows, columns]
    rows, columns = rows[known], columns[known]
    inverse = 1 / source.depth_m[rows, columns]
    camera = intrinsics
    x = (columns + 0.5 - camera.cx_px) / camera.fx_px
    y = (rows + 0.5 - camera.cy_px) / camera.fy_px
    turn, way = motion[:3, :3], motion[:3, 3:]
    ahead = turn @ np.stack([x, y, np.ones_like(x)]) + way * inverse
    far = np.where(ahead[2] > 1e-6, ahead[2], np.nan)
    u_px = camera.fx_px * ahead[0] / far + camera.cx_px
    v_px = camera.fy_px * ahead[1] / far + camera.cy_px
    keep = (u_px >= 1.5) & (u_px < width - 2) & (v_px >= 1.5) & (v_px < height - 2)
    if keep.sum() < _FEWEST_POINTS:
        return None
    rows, columns, inverse, x, y, far, u_px, v_px = (
        each[keep] for each in (rows, columns, inverse, x, y, far, u_px, v_px)
    )
    ahead = ahead[:, keep]
    left, top = np.floor(u_px - 0.5).astype(np.intp), np.floor(v_px - 0.5).astype(np.intp)
    part_x, part_y = u_px - 0.5 - left, v_px - 0.5 - top
    here = _patch(source, rows - 1, columns - 1, side=3)
    there = _patch(target, top - 1, left - 1, side=4)
    expected = inverse / far
    found = _between(there[1:3, 1:3], part_x, part_y)
    steps = np.maximum(_relative_step(source, 1 / expected), _relative_step(target, 1 / expected))
    smooth = (_bend(here) <= (_BEND + 4 * steps) * inverse) & (
        _bend(there) <= (_BEND + 4 * steps) * expected
    )

    def moved(change: Any) -> tuple[Points, Points, Points]:
        return (
            camera.fx_px * (change[0] - ahead[0] / far * change[2]) / far,
            camera.fy_px * (change[1] - ahead[1] / far * change[2]) / far,
            -change[2] / far,
        )

    by_depth = moved(way * inverse)
    by_x, by_y = moved(-turn[:, :1] * x), moved(-turn[:, 1:2] * y)
    return _Landed(
        rows=rows,
        columns=columns,
        u_px=u_px,
        v_px=v_px,
        cell=rows * _CELLS // height * _CELLS + columns * _CELLS // width,
        off=found / expected - 1,
        steps=steps,
        smooth=smooth & np.isfinite(found) & (steps <= _COARSE),
        by_depth=(by_depth[0], by_depth[1], 1 + by_depth[2]),
        by_focal=(
            (by_x[0] + u_px - camera.cx_px, by_x[1], by_x[2]),
            (by_y[0], by_y[1] + v_px - camera.cy_px, by_y[2]),
        ),
        log_ray=(
            np.log1p(x * x + y * y) / 2,
            np.log1p((ahead[0] / far) ** 2 + (ahead[1] / far) ** 2) / 2,
        ),
        slope=(
            ((here[1, 2] - here[1, 0]) / 2 / inverse, (here[2, 1] - here[0, 1]) / 2 / inverse),
            (
                _between(there[1:3, 2:] - there[1:3, :2], part_x, part_y) / 2 / expected,
                _between(there[2:, 1:3] - there[:2, 1:3], part_x, part_y) / 2 / expected,
            ),
        ),
    )


def _relative_step(depth: MeasuredDepth, depth_m: Points) -> Points:
    return np.asarray(depth.steps_m(depth_m) / depth_m)


@dataclass(slots=True)
class _Sums:
    """The residuals and derivatives of one directed pair, over all frames."""

    differences: list[Points] = field(default_factory=list)
    weights: list[Points] = field(default_factory=list)
    cells: list[np.ndarray] = field(default_factory=list)
    columns: list[dict[str, tuple[Points, Points]]] = field(default_factory=list)
    smooth: int = 0
    through: int = 0

    def add(self, off: Points, weight: Points, cell: np.ndarray, columns: dict[str, Any]) -> None:
        """Add points; single precision is enough and takes half the memory."""
        self.differences.append(off.astype(np.float32))
        self.weights.append(weight.astype(np.float32))
        self.cells.append(cell)
        self.columns.append(
            {
                name: (pair[0].astype(np.float32), pair[1].astype(np.float32))
                for name, pair in columns.items()
            }
        )


_OF_ALL: Final = -1


class _Fit:
    """One-parameter fits over directed pairs.

    ``window`` is the residual beyond which a point has no weight; infinite to keep the points' own
    weights.
    """

    def __init__(self, sums: Mapping[tuple[int, int], _Sums], *, window: float) -> None:
        pairs = [pair for pair, each in sums.items() if each.differences]
        parts = [sums[pair] for pair in pairs]
        sizes = [sum(map(len, each.differences)) for each in parts]
        self.window = window
        self.is_empty = sum(sizes) < _FEWEST_POINTS
        if self.is_empty:
            return
        self.source = np.repeat([pair[0] for pair in pairs], sizes)
        self.target = np.repeat([pair[1] for pair in pairs], sizes)
        self.off, self.weight, self.cell = (
            np.concatenate([part for each in parts for part in getattr(each, name)])
            for name in ("differences", "weights", "cells")
        )
        self.columns = {
            name: tuple(
                np.concatenate([part[name][side] for each in parts for part in each.columns])
                for side in (0, 1)
            )
            for name in parts[0].columns[0]
        }

    def estimates(
        self, check: str, *, of_cameras: Iterable[str], of_all: Iterable[str]
    ) -> Iterator[Estimate]:
        """Yield an estimate of each parameter of each camera, and of each that all share."""
        if self.is_empty:
            return
        for name in of_cameras:
            source, target = self.columns[name]
            for camera in range(CAMERA_COUNT):
                column = source * (self.source == camera) + target * (self.target == camera)
                yield self._one(check, name, camera, column)
        for name in of_all:
            source, target = self.columns[name]
            yield self._one(check, name, _OF_ALL, source + target)

    def _one(self, check: str, name: str, camera: int, column: Points) -> Estimate:
        used = np.flatnonzero(column)
        column, off = column[used].astype(np.float64), self.off[used].astype(np.float64)
        if len(used) < _FEWEST_POINTS:
            return Estimate(check, name, camera)
        value, total, weight, rest = 0.0, 0.0, self.weight[used], off
        for _ in range(3 if np.isfinite(self.window) else 1):
            weight = self.weight[used] * np.clip(1 - (rest / self.window) ** 2, 0, None) ** 2
            total = float((weight * column**2).sum())
            if total <= 0:
                return Estimate(check, name, camera)
            value = float((weight * column * off).sum()) / total
            rest = off - value * column
        scores = np.bincount(self.cell[used], weights=weight * column * rest)
        before, after = (
            self.weight[used] * np.minimum((each / self.window) ** 2, 1)
            if np.isfinite(self.window)
            else weight * each**2
            for each in (off, rest)
        )
        return Estimate(
            check,
            name,
            camera,
            value=value,
            error=float(np.sqrt((scores**2).sum())) / total,
            explained=float((before - after).sum()),
            share=1 - float(after.sum()) / max(float(before.sum()), 1e-12),
        )


class AlignmentCheck:
    """Takes a scene's frames one after another; `result` returns what all frames show."""

    def __init__(self, intrinsics: Intrinsics, *, frames: int) -> None:
        """Prepare for a number of frames of one rig."""
        self.intrinsics = intrinsics
        self._is_both_ways = frames < _FEW_FRAMES
        self._frames_a_moment = -(-frames // _MOMENTS)
        self._depth = {pair: _Sums() for pair in ALIGNED_PAIRS}
        self._motion = {(camera, camera): _Sums() for camera in range(CAMERA_COUNT)}
        self._pictures = {pair: _Sums() for pair in ALIGNED_PAIRS}
        self._fits: dict[tuple[int, int], list[float]] = {}
        self._contrast: dict[tuple[int, int], list[float]] = {}
        self._lags: dict[tuple[int, int], list[float]] = {}
        self._factor = 1.0
        self._disparity_px: dict[tuple[int, int], list[float]] = {}
        self._moved_px: list[float] = []
        self._frames = 0
        self._last: tuple[int, dict[int, MeasuredDepth]] | None = None

    def take(
        self,
        frame: int,
        depths: Mapping[int, MeasuredDepth],
        bands: Mapping[tuple[int, int], Float[np.ndarray, "h w"]],
        poses: CameraPoses,
    ) -> None:
        """Add one frame.

        Args:
            frame: Its number.
            depths: Each camera's depth.
            bands: By (camera, frame), the `band` of pictures of this frame and its neighbours.
            poses: Poses of all frames.
        """
        for source, target in ALIGNED_PAIRS:
            is_turn = self._is_both_ways or (source < target) == (self._frames % 2 == 0)
            if is_turn and source in depths and target in depths:
                motion = poses.cam_from_cam(frame, target=target, source=source)
                landed = _landed(
                    depths[source], depths[target], intrinsics=self.intrinsics, motion=motion
                )
                if landed is not None:
                    self._add_depth(self._depth[source, target], landed, check="depth")
                    self._add_pictures((source, target), frame, landed, bands)
        if self._last is not None:
            before, others = self._last
            for camera in others.keys() & depths.keys():
                self._add_motion(camera, (before, others[camera]), (frame, depths[camera]), poses)
        self._last = (frame, dict(depths))
        self._frames += 1

    def _add_motion(
        self,
        camera: int,
        before: tuple[int, MeasuredDepth],
        after: tuple[int, MeasuredDepth],
        poses: CameraPoses,
    ) -> None:
        ways = ((before, after), (after, before))
        turn = (self._frames + camera) % 2
        for (here, source), (there, target) in ways if self._is_both_ways else ways[turn:][:1]:
            motion = np.linalg.inv(poses.world_from_cam(there, camera)) @ poses.world_from_cam(
                here, camera
            )
            landed = _landed(source, target, intrinsics=self.intrinsics, motion=motion)
            if landed is not None:
                self._add_depth(self._motion[camera, camera], landed, check="motion")
                away_px = np.hypot(
                    landed.u_px - landed.columns - 0.5, landed.v_px - landed.rows - 0.5
                )
                self._moved_px.append(float(np.median(away_px)))

    def _add_depth(self, sums: _Sums, landed: _Landed, *, check: str) -> None:
        smooth = landed.smooth
        tolerance = _TOLERANCE + 2 * landed.steps
        sums.smooth += int(smooth.sum())
        sums.through += int((smooth & (landed.off < -tolerance)).sum())
        window = _WINDOW[check]
        keep = smooth & (np.abs(landed.off) < window + 2 * landed.steps)
        columns = {name: (a[keep], b[keep]) for name, (a, b) in landed.depth_columns().items()}
        across, down = (column[keep] for column in landed.focal_columns())
        none = np.zeros_like(across)
        columns["focal"] = (across + down, none)
        if check == "motion":
            columns |= {"focal_x": (across, none), "focal_y": (down, none)}
            del columns["shift_x"], columns["shift_y"], columns["ray"]
        # Coarse steps make a point count less; rounding moves it by 0.3 of one.
        weight = 1 / (1 + (landed.steps[keep] / _TOLERANCE) ** 2)
        sums.add(landed.off[keep], weight, self._cells(landed, keep), columns)

    def _cells(self, landed: _Landed, keep: np.ndarray) -> np.ndarray:
        """Return the part of the picture and the moment of each point."""
        moment = self._frames // self._frames_a_moment
        cells: np.ndarray = landed.cell[keep] + _CELLS**2 * moment
        return cells

    def _add_pictures(
        self,
        pair: tuple[int, int],
        frame: int,
        landed: _Landed,
        bands: Mapping[tuple[int, int], Float[np.ndarray, "h w"]],
    ) -> None:
        source, target = pair
        if (source, frame) not in bands or (target, frame) not in bands:
            return
        here, there = bands[source, frame], bands[target, frame]
        factor = self.intrinsics.width_px / here.shape[1]
        factor_y = self.intrinsics.height_px / here.shape[0]
        self._factor = factor
        seen = np.abs(landed.off) < _VISIBLE + 2 * landed.steps
        if seen.sum() < _FEWEST_POINTS:
            return
        from_px = ((landed.columns[seen] + 0.5) / factor, (landed.rows[seen] + 0.5) / factor_y)
        to_px = (landed.u_px[seen] / factor, landed.v_px[seen] / factor_y)
        (first, *slope), (second, *other) = _sampled(here, *from_px), _sampled(there, *to_px)
        slope_x, slope_y = ((a + b) / 2 for a, b in zip(slope, other, strict=True))
        contrast = float(min(first.std(), second.std()))
        self._contrast.setdefault(pair, []).append(contrast)
        if contrast < LEAST_CONTRAST:
            return
        self._fits.setdefault(pair, []).append(_correlation(first, second))
        disparity_px = float(np.abs(landed.by_depth[0][seen]).mean()) / factor
        self._disparity_px.setdefault(pair, []).append(disparity_px)
        for lag in (-1, 1):
            beside = bands.get((source, frame + lag)), bands.get((target, frame + lag))
            early = None if beside[0] is None else _value(beside[0], *from_px)
            late = None if beside[1] is None else _value(beside[1], *to_px)
            for camera, one, two in (
                (source, early, second), (target, first, late), (_OF_ALL, early, late),
            ):  # fmt: skip
                if one is not None and two is not None:
                    gained = _correlation(one, two) - _correlation(first, second)
                    self._lags.setdefault((camera, lag), []).append(gained)
        gain = float((first * second).sum() / max(float((first * first).sum()), 1e-9))
        off = second - np.clip(gain, 0.5, 2.0) * first
        spread = 1.4826 * float(np.median(np.abs(off)))
        # A picture that is off by a pixel differs by its slope: that counts in full.
        cut = max(6 * spread, 3 * float(np.sqrt((slope_x**2 + slope_y**2).mean())))
        weight = np.clip(1 - (off / cut) ** 2, 0, None) ** 2 / max(spread, 1.0) ** 2
        by_depth_x, by_depth_y = landed.by_depth[0][seen], landed.by_depth[1][seen]
        by_scale = slope_x * by_depth_x / factor + slope_y * by_depth_y / factor_y
        columns = {
            "shift_x": (slope_x, -slope_x),
            "shift_y": (slope_y, -slope_y),
            "scale": (-by_scale, np.zeros_like(by_scale)),
        }
        self._pictures[pair].add(off, weight, self._cells(landed, seen), columns)

    def result(self) -> Alignment:
        """Return what all frames show."""
        pairs = tuple(
            PairFit(
                left=left,
                right=right,
                smooth=sum(self._depth[pair].smooth for pair in both),
                through=sum(self._depth[pair].through for pair in both),
                contrast=_mean(self._contrast.get(pair, []) for pair in both),
                correlation=_mean(self._fits.get(pair, []) for pair in both),
                disparity_px=_mean(self._disparity_px.get(pair, []) for pair in both),
            )
            for left, right in ALIGNED_PAIRS
            if left < right
            for both in [((left, right), (right, left))]
        )
        depth = _explained(
            self._depth, "depth", of_cameras=("scale", "ray", "shift_x", "shift_y"),
            of_all=("ray", "focal"),
        )  # fmt: skip
        motion = _explained(self._motion, "motion", of_all=("scale", "focal", "focal_x", "focal_y"))
        faulty = {each.camera for each in depth if each.is_first}
        clean = {pair: sums for pair, sums in self._pictures.items() if not faulty & set(pair)}
        pictures = _explained(
            clean, "pictures", of_cameras=("shift_x", "shift_y"), of_all=("scale",)
        )
        return Alignment(
            pairs=pairs,
            estimates=(*depth, *motion, *pictures),
            lags=tuple(
                (camera, lag, float(np.mean(gained)))
                for (camera, lag), gained in sorted(self._lags.items())
            ),
            moved_smooth=sum(each.smooth for each in self._motion.values()),
            moved_through=sum(each.through for each in self._motion.values()),
            picture_px=self._factor,
            width_px=self.intrinsics.width_px / self._factor,
            moved_px=_mean([self._moved_px]),
            disparity_px=_mean(self._disparity_px.values()),
        )


def _explained(
    sums: Mapping[tuple[int, int], _Sums],
    check: str,
    *,
    of_cameras: tuple[str, ...] = (),
    of_all: tuple[str, ...] = (),
) -> list[Estimate]:
    """Return all estimates, those that explained most in a round first and marked.

    The camera of a round's best estimate is left out of the next round.
    """
    left, first = dict(sums), []
    estimates: list[Estimate] = []
    window = _WINDOW.get(check, np.inf)
    for turn in range(CAMERA_COUNT - 1):
        fit = _Fit(left, window=window)
        found = list(fit.estimates(check, of_cameras=of_cameras, of_all=of_all))
        if turn == 0:
            estimates = found
        certain = [
            each for each in found
            if abs(each.value) > max(_NOTED[each.what.split("_")[0]], CERTAIN * each.error)
        ]  # fmt: skip
        if not certain:
            break
        best = max(certain, key=lambda each: each.explained)
        others = [each for each in certain if each is not best and each.explained > 0]
        next_best = max(
            (each.explained for each in others if not _is_part(best, each)), default=0.0
        )
        best = replace(best, is_first=True, next_best=next_best / best.explained)
        first.append(best)
        if best.camera == _OF_ALL:
            break
        left = {pair: each for pair, each in left.items() if best.camera not in pair}
    known = {(each.what, each.camera) for each in first}
    return first + [each for each in estimates if (each.what, each.camera) not in known]


def _is_part(best: Estimate, other: Estimate) -> bool:
    """Tell whether an estimate explains only what it has in common with a better one."""
    whats = {best.what, other.what}
    return whats <= {"focal", "focal_x", "focal_y"} and "focal" in whats


def _sampled(picture: Any, u_px: Points, v_px: Points) -> tuple[Points, Points, Points]:
    """Return a picture's values and slopes between its pixels."""
    height, width = picture.shape
    x, y = np.clip(u_px - 0.5, 1, width - 3.001), np.clip(v_px - 0.5, 1, height - 3.001)
    left, top = x.astype(np.intp), y.astype(np.intp)
    steps = np.arange(-1, 3)
    patch = picture[top + steps[:, None, None], left + steps[:, None]]
    part_x, part_y = x - left, y - top
    return (
        _between(patch[1:3, 1:3], part_x, part_y),
        _between(patch[1:3, 2:] - patch[1:3, :2], part_x, part_y) / 2,
        _between(patch[2:, 1:3] - patch[:2, 1:3], part_x, part_y) / 2,
    )


def _value(picture: Any, u_px: Points, v_px: Points) -> Points:
    """Return a picture's values between its pixels."""
    height, width = picture.shape
    x, y = np.clip(u_px - 0.5, 0, width - 1.001), np.clip(v_px - 0.5, 0, height - 1.001)
    left, top = x.astype(np.intp), y.astype(np.intp)
    steps = np.arange(2)
    inner = picture[top + steps[:, None, None], left + steps[:, None]]
    value: Points = _between(inner, x - left, y - top)
    return value


def _correlation(first: Points, second: Points) -> float:
    first, second = first - first.mean(), second - second.mean()
    size = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return float((first * second).sum()) / size if size > 0 else 0.0


def _mean(values: Iterable[list[float]]) -> float:
    every = [value for part in values for value in part]
    return float(np.mean(every)) if every else float("nan")
