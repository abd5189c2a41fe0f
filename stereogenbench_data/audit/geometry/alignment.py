"""Whether a scene's pictures, depth, poses and focal length fit together to a part of a pixel.

Points on smooth surfaces are taken from one camera to another, or from one moment to another, by
their depth and the recorded poses. On a plane 1 / depth is linear in the pixel, so the target's
inverse depth, interpolated at that place, equals the expected one but for rounding. The residual
is fitted by one parameter at a time (least squares, Tukey's weights): depth of one camera that is
shifted, scaled or along the ray; a wrong focal length, which shifts the depth of every camera by
its disparity. The parameter that explains most is kept, its camera is left out, and the rest is
fitted again.

Pictures are only correlated, at the points that depth puts in the same place, and those of the
frames beside with them: whether each camera shows its own view and moment. What pictures say of
depth itself is the doctor's (`audit.contract`).

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
_OF_CAMERAS: Final = {"depth": ("scale", "ray", "shift_x", "shift_y"), "motion": ()}
_OF_ALL_CAMERAS: Final = {
    "depth": ("ray", "focal"), "motion": ("scale", "focal", "focal_x", "focal_y"),
}  # fmt: skip
"""The parameters that are fitted, of each camera and of all."""
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

    def by_parameter(self, check: str) -> dict[str, tuple[Points, Points]]:
        """Return d(off) for each parameter: of the source's depth, and of the target's."""
        by_depth = self._seen(self.by_depth)
        scale = (-by_depth, -(1 + self.off))
        across, down = (self._seen(moved) for moved in self.by_focal)
        none = np.zeros_like(across)
        focal = {"focal": (across + down, none)}
        if check == "motion":
            return focal | {"scale": scale, "focal_x": (across, none), "focal_y": (down, none)}
        (source_x, source_y), (target_x, target_y) = self.slope
        return focal | {
            "scale": scale,
            "ray": (-self.log_ray[0] * by_depth, -self.log_ray[1]),
            "shift_x": (-source_x * by_depth, -target_x),
            "shift_y": (-source_y * by_depth, -target_y),
        }

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
    """One-parameter fits of a check's residuals over directed pairs."""

    def __init__(self, sums: Mapping[tuple[int, int], _Sums], check: str) -> None:
        pairs = [pair for pair, each in sums.items() if each.differences]
        parts = [sums[pair] for pair in pairs]
        sizes = [sum(map(len, each.differences)) for each in parts]
        self.check, self.window = check, _WINDOW[check]
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

    def estimates(self) -> Iterator[Estimate]:
        """Yield an estimate of each parameter of each camera, and of each that all share."""
        if self.is_empty:
            return
        for name in _OF_CAMERAS[self.check]:
            source, target = self.columns[name]
            for camera in range(CAMERA_COUNT):
                column = source * (self.source == camera) + target * (self.target == camera)
                yield self._one(name, camera, column)
        for name in _OF_ALL_CAMERAS[self.check]:
            source, target = self.columns[name]
            yield self._one(name, _OF_ALL, source + target)

    def _one(self, name: str, camera: int, column: Points) -> Estimate:
        used = np.flatnonzero(column)
        column, off = column[used].astype(np.float64), self.off[used].astype(np.float64)
        untold = Estimate(self.check, name, camera)
        if len(used) < _FEWEST_POINTS:
            return untold
        value, total, weight, rest = 0.0, 0.0, self.weight[used], off
        for _ in range(3):
            weight = self.weight[used] * np.clip(1 - (rest / self.window) ** 2, 0, None) ** 2
            total = float((weight * column**2).sum())
            if total <= 0:
                return untold
            value = float((weight * column * off).sum()) / total
            rest = off - value * column
        scores = np.bincount(self.cell[used], weights=weight * column * rest)
        before, after = (
            float((self.weight[used] * np.minimum((each / self.window) ** 2, 1)).sum())
            for each in (off, rest)
        )
        return replace(
            untold, value=value, error=float(np.sqrt((scores**2).sum())) / total,
            explained=before - after, share=1 - after / max(before, 1e-12),
        )  # fmt: skip


class AlignmentCheck:
    """Takes a scene's frames one after another; `result` returns what all frames show."""

    def __init__(self, intrinsics: Intrinsics, *, frames: int) -> None:
        """Prepare for a number of frames of one rig."""
        self.intrinsics = intrinsics
        self._is_both_ways = frames < _FEW_FRAMES
        self._frames_a_moment = -(-frames // _MOMENTS)
        self._depth = {pair: _Sums() for pair in ALIGNED_PAIRS}
        self._motion = {(camera, camera): _Sums() for camera in range(CAMERA_COUNT)}
        self._correlations: dict[tuple[int, int], list[float]] = {}
        self._lags: dict[tuple[int, int], list[float]] = {}
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
        columns = {name: (a[keep], b[keep]) for name, (a, b) in landed.by_parameter(check).items()}
        # Coarse steps make a point count less; rounding moves it by 0.3 of one.
        weight = 1 / (1 + (landed.steps[keep] / _TOLERANCE) ** 2)
        moment = self._frames // self._frames_a_moment
        sums.add(landed.off[keep], weight, landed.cell[keep] + _CELLS**2 * moment, columns)

    def _add_pictures(
        self,
        pair: tuple[int, int],
        frame: int,
        landed: _Landed,
        bands: Mapping[tuple[int, int], Float[np.ndarray, "h w"]],
    ) -> None:
        """Correlate two cameras' pictures at the same points, and those of the frames beside."""
        seen = np.abs(landed.off) < _VISIBLE + 2 * landed.steps
        if not {(camera, frame) for camera in pair} <= bands.keys() or seen.sum() < _FEWEST_POINTS:
            return
        height, width = bands[pair[0], frame].shape
        across, down = width / self.intrinsics.width_px, height / self.intrinsics.height_px
        places = (
            ((landed.columns[seen] + 0.5) * across, (landed.rows[seen] + 0.5) * down),
            (landed.u_px[seen] * across, landed.v_px[seen] * down),
        )
        values = {
            (camera, lag): _value(bands[camera, frame + lag], *place)
            for camera, place in zip(pair, places, strict=True)
            for lag in (-1, 0, 1)
            if (camera, frame + lag) in bands
        }
        source, target = pair
        if min(values[source, 0].std(), values[target, 0].std()) < LEAST_CONTRAST:
            return
        now = _correlation(values[source, 0], values[target, 0])
        self._correlations.setdefault(pair, []).append(now)
        for lag in (-1, 1):
            for camera, one, two in (
                (source, lag, 0), (target, 0, lag), (_OF_ALL, lag, lag),
            ):  # fmt: skip
                if (source, one) in values and (target, two) in values:
                    then = _correlation(values[source, one], values[target, two])
                    self._lags.setdefault((camera, lag), []).append(then - now)

    def result(self) -> Alignment:
        """Return what all frames show."""
        pairs = tuple(
            PairFit(
                left=left,
                right=right,
                smooth=sum(self._depth[pair].smooth for pair in both),
                through=sum(self._depth[pair].through for pair in both),
                correlation=_mean(self._correlations.get(pair, []) for pair in both),
            )
            for left, right in ALIGNED_PAIRS
            if left < right
            for both in [((left, right), (right, left))]
        )
        return Alignment(
            pairs=pairs,
            estimates=(*_explained(self._depth, "depth"), *_explained(self._motion, "motion")),
            lags=tuple(
                (camera, lag, float(np.mean(gained)))
                for (camera, lag), gained in sorted(self._lags.items())
            ),
            moved_smooth=sum(each.smooth for each in self._motion.values()),
            moved_through=sum(each.through for each in self._motion.values()),
            moved_px=_mean([self._moved_px]),
        )


def _explained(sums: Mapping[tuple[int, int], _Sums], check: str) -> list[Estimate]:
    """Return all estimates, those that explained most in a round first and marked.

    The camera of a round's best estimate is left out of the next round.
    """
    left, first = dict(sums), []
    estimates: list[Estimate] = []
    for _ in range(CAMERA_COUNT - 1):
        found = list(_Fit(left, check).estimates())
        estimates = estimates or found
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
