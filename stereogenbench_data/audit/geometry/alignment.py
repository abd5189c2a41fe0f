"""Whether a scene's pictures, depth and poses fit together to a part of a pixel.

Points on smooth surfaces are taken from one camera to another, or from one moment to another, by
their depth and the recorded poses. On a plane 1 / depth is linear in the pixel, so the target's
inverse depth, interpolated at that place, equals the expected one but for rounding. What is left
is reported with every cause that would look so: the doctor (`audit.contract`) looks for the right
one.

A point is seen through if the target sees something behind it. An occluder never causes that: it
hides what is behind it. In correct data the share of such points is 0 to 0.1 % between cameras.

Pictures are only correlated, at the points that depth puts in the same place, and those of the
frames beside with them: whether each camera shows its own view and moment.
"""

import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Float64

from stereogenbench_data.audit.geometry.records import CHECKS, Figure
from stereogenbench_data.audit.geometry.reprojection import MeasuredDepth, moved_points
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.projection import Projection, backward_warp
from stereogenbench_data.schema.release import CAMERA_COUNT, depth_name, rgb_name

ALIGNED_PAIRS: Final = tuple(
    (a, b)
    for a in range(CAMERA_COUNT)
    for b in range(CAMERA_COUNT)
    if abs(a - b) in (1, 2, CAMERA_COUNT - 1)
)
"""Directed pairs that are compared: neighbours, next but one, and the outermost."""

_POINTS: Final = 1600
_FEWEST_POINTS: Final = 100
_FEWEST_MOVED: Final = 1000
_TOLERANCE: Final = 0.005
"""Share of the depth, plus two stored steps, beyond which a point counts as seen through. A smooth
surface bends by less between pixels."""
_VISIBLE: Final = 0.02
_BEND: Final = 0.004
"""Largest second difference of 1 / depth in a smooth patch, as a share, plus four steps."""
_COARSE: Final = 0.05
"""Depth whose stored steps are a larger share of it is too coarse to compare."""
_WINDOW: Final = 0.1
"""Relative differences of inverse depth beyond which points are of two surfaces."""
_MOST_OF_PAIR: Final = 90
_STILL_PX: Final = 0.25
_TELLS_TIME: Final = 0.02
"""Pictures tell the time where those of a frame beside lower the correlation by as much."""
LEAST_CONTRAST: Final = 2.0
"""Least standard deviation, in grey levels, of a band-passed picture with texture."""

Points = Float64[np.ndarray, " n"]
Cameras = tuple[int, ...]
"""One camera, or a pair."""


@dataclass(frozen=True, slots=True, eq=False)
class _Landed:
    """Points of one view that land in another.

    ``off`` is the target's inverse depth over the expected one, less 1; ``steps`` the stored step
    as a share of depth.
    """

    rows: np.ndarray
    columns: np.ndarray
    u_px: Points
    v_px: Points
    off: Points
    steps: Points
    smooth: np.ndarray


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


def _sampled(values: Any, u_px: Points, v_px: Points) -> Points:
    """Return values of a picture or map between its pixels, interpolated bilinearly."""
    places = Projection(u_px=u_px[None], v_px=v_px[None], depth_m=np.ones((1, len(u_px))))
    sampled: Points = backward_warp(values[None], places)[0][0, 0]
    return sampled


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
    depth_m = source.depth_m[rows, columns]
    u_px, v_px, ahead_m = moved_points(columns + 0.5, rows + 0.5, depth_m, intrinsics, motion)
    keep = (u_px >= 1.5) & (u_px < width - 2) & (v_px >= 1.5) & (v_px < height - 2)
    if keep.sum() < _FEWEST_POINTS:
        return None
    rows, columns, depth_m, ahead_m, u_px, v_px = (
        each[keep] for each in (rows, columns, depth_m, ahead_m, u_px, v_px)
    )
    left, top = np.floor(u_px - 0.5).astype(np.intp), np.floor(v_px - 0.5).astype(np.intp)
    here = _patch(source, rows - 1, columns - 1, side=3)
    there = _patch(target, top - 1, left - 1, side=4)
    x, y = u_px - 0.5 - left, v_px - 0.5 - top
    above, below = (there[row, 1] * (1 - x) + there[row, 2] * x for row in (1, 2))
    found = above * (1 - y) + below * y
    steps = np.maximum(*(each.steps_m(ahead_m) / ahead_m for each in (source, target)))
    smooth = (_bend(here) <= (_BEND + 4 * steps) / depth_m) & (
        _bend(there) <= (_BEND + 4 * steps) / ahead_m
    )
    return _Landed(
        rows=rows, columns=columns, u_px=u_px, v_px=v_px, off=found * ahead_m - 1, steps=steps,
        smooth=smooth & np.isfinite(found) & (steps <= _COARSE),
    )  # fmt: skip


@dataclass(slots=True)
class _Residuals:
    """What is left between two cameras, or two moments of one, over all frames.

    ``beyond`` holds by how much points of one surface are off beyond one stored step. ``near``
    counts points, of any surface, whose depths differ by less than 2 %, ``rough`` those of them
    whose depths differ by more than 0.5 %.
    """

    smooth: int = 0
    through: int = 0
    near: int = 0
    rough: int = 0
    beyond: list[Points] = field(default_factory=list)

    def add(self, landed: _Landed) -> None:
        """Add points."""
        away = np.abs(landed.off) - 2 * landed.steps
        near = away < _VISIBLE
        self.near += int(near.sum())
        self.rough += int((near & (away > _TOLERANCE)).sum())
        off, steps = landed.off[landed.smooth], landed.steps[landed.smooth]
        self.smooth += len(off)
        self.through += int((off < -_TOLERANCE - 2 * steps).sum())
        size = np.abs(off)
        self.beyond.append(np.maximum(size - steps, 0)[size < _WINDOW + 2 * steps])

    def percentile(self, percent: float) -> float:
        """Return a percentile of what points are off; nan if too few are of one surface."""
        beyond = np.concatenate([np.empty(0), *self.beyond])
        return float(np.percentile(beyond, percent)) if len(beyond) >= _FEWEST_POINTS else np.nan


class AlignmentCheck:
    """Takes a scene's frames one after another; `figures` returns what all frames show."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        """Take the intrinsics of all cameras."""
        self.intrinsics = intrinsics
        self._depth = {(a, b): _Residuals() for a, b in ALIGNED_PAIRS if a < b}
        self._motion = _Residuals()
        self._correlations: dict[tuple[int, int], list[float]] = {}
        self._lags: dict[tuple[int, int], list[float]] = {}
        self._moved_px: list[float] = []
        self._last: tuple[int, Mapping[int, MeasuredDepth]] = (0, {})

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
            if source in depths and target in depths:
                motion = poses.cam_from_cam(frame, target=target, source=source)
                landed = _landed(
                    depths[source], depths[target], intrinsics=self.intrinsics, motion=motion
                )
                if landed is not None:
                    self._depth[min(source, target), max(source, target)].add(landed)
                    self._add_pictures((source, target), frame, landed, bands)
        before = self._last[0]
        for camera in self._last[1].keys() & depths.keys():
            sides = (before, self._last[1][camera]), (frame, depths[camera])
            for (here, shown), (there, other) in (sides, sides[::-1]):
                motion = poses.later_from_cam(here, there, camera=camera)
                landed = _landed(shown, other, intrinsics=self.intrinsics, motion=motion)
                if landed is not None:
                    self._motion.add(landed)
                    away = landed.u_px - landed.columns - 0.5, landed.v_px - landed.rows - 0.5
                    self._moved_px.append(float(np.median(np.hypot(*away))))
        self._last = (frame, dict(depths))

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
            (camera, lag): _sampled(bands[camera, frame + lag], *place)
            for camera, place in zip(pair, places, strict=True)
            for lag in (-1, 0, 1)
            if (camera, frame + lag) in bands
        }
        source, target = pair
        if min(values[source, 0].std(), values[target, 0].std()) < LEAST_CONTRAST:
            return
        now = _correlation(values[source, 0], values[target, 0])
        self._correlations.setdefault((min(pair), max(pair)), []).append(now)
        for lag in (-1, 1):
            for camera, one, two in ((source, lag, 0), (target, 0, lag)):
                if (source, one) in values and (target, two) in values:
                    then = _correlation(values[source, one], values[target, two])
                    self._lags.setdefault((camera, lag), []).append(then - now)

    def figures(self) -> Iterator[Figure]:
        """Yield what all frames show."""
        known = {pair: each for pair, each in self._depth.items() if each.smooth >= _FEWEST_POINTS}
        near = {pair: each for pair, each in self._depth.items() if each.near >= _FEWEST_POINTS}
        residuals = {pair: each.percentile(_MOST_OF_PAIR) for pair, each in known.items()}
        of_pairs: dict[str, dict[Cameras, float]] = {
            "see_through": {pair: each.through / each.smooth for pair, each in known.items()},
            "depth_agreement": {pair: each.rough / each.near for pair, each in near.items()},
            "depth_residual": {p: each for p, each in residuals.items() if not np.isnan(each)},
        }
        motion = self._motion_figure()
        off = {pair for each in of_pairs.items() for pair in _off(*each)}
        # What is off elsewhere too, or over time in most cameras, is no single camera's.
        suspects = set(range(CAMERA_COUNT)).intersection(*off)
        if motion.value > CHECKS["motion_residual"].limit:
            suspects = set()
        for each in of_pairs.items():
            yield _worst(*each, suspects)
        seen = {camera for pair in known for camera in pair}
        yield from _untested("see_through", seen, "too few points of smooth surfaces")
        yield motion
        yield from self._time_figures(suspects)
        yield from self._content_figures(suspects)

    def _motion_figure(self) -> Figure:
        moved_px = float(np.mean(self._moved_px)) if self._moved_px else 0.0
        if self._motion.smooth < _FEWEST_MOVED:
            why = "too few points of smooth surfaces, or one frame"
        elif moved_px < _STILL_PX:
            why = f"points move by {moved_px:.2f} px from one audited frame to the next"
        else:
            return Figure("motion_residual", "", self._motion.percentile(50))
        return Figure("motion_residual", where=why)

    def _content_figures(self, suspects: Set[int]) -> Iterator[Figure]:
        correlations = {pair: float(np.mean(each)) for pair, each in self._correlations.items()}
        odd, best = dict[Cameras, float](), dict[Cameras, float]()
        for camera in range(CAMERA_COUNT):
            own = [each for pair, each in correlations.items() if camera in pair]
            others = [each for pair, each in correlations.items() if camera not in pair]
            if own and others:
                best[camera,] = max(own)
                odd[camera,] = median(others) - max(own)
        least = min(best.values(), default=math.nan)
        yield _worst("picture_odd", odd, suspects, f"its best is {least:.2f}")
        seen = {camera for pair in correlations for camera in pair}
        yield from _untested("picture_odd", seen, "no texture, or no depth")

    def _time_figures(self, suspects: Set[int]) -> Iterator[Figure]:
        gains = {place: float(np.mean(each)) for place, each in self._lags.items()}
        timed = {camera for (camera, _), gain in gains.items() if gain <= -_TELLS_TIME}
        most: dict[Cameras, float] = {}
        for (camera, _), gain in gains.items():
            most[camera,] = max(gain, most.get((camera,), -math.inf))
        if sum(gain > 0 for gain in most.values()) > 1:
            suspects = set()
        (_, lag) = max(gains, key=lambda place: gains[place], default=(0, 0))
        told = f"by those of the frame {'before' if lag < 0 else 'after'}"
        yield _worst("picture_lag", most, suspects, told)
        why = "pictures of the neighbouring frames fit as well, or there are none"
        yield from _untested("picture_lag", timed, why)


def _off(quantity: str, values: Mapping[Cameras, float]) -> list[Cameras]:
    """Return what is beyond the limit or, in a finding, comes near the largest value."""
    limit, most = CHECKS[quantity].limit, max(values.values(), default=0.0)
    return [key for key, value in values.items() if most > limit and value > min(limit, most / 2)]


def _worst(
    quantity: str, values: Mapping[Cameras, float], suspects: Set[int], told: str = ""
) -> Figure:
    """Return the largest value, with the cameras or the pairs that come near.

    If those that are off are all those of one suspect (and two pairs or more), its file comes with
    it. Pictures are compared where depth and poses put them, so wrong lenses, places or depth put
    several cameras off.
    """
    most = max(values.values(), default=math.nan)
    if not most > 0:
        return Figure(quantity, "", most)
    off = _off(quantity, values)
    file_name = rgb_name if quantity.startswith("picture") else depth_name
    odd = (
        file_name(camera) for camera in suspects
        if off and len(off) >= len(off[0]) and off == [each for each in values if camera in each]
    )  # fmt: skip
    near = ("-".join(map(str, key)) for key, value in values.items() if value > most / 2)
    where = f"{told}, in camera " if told else "most in "
    return Figure(quantity, next(odd, ""), most, where + ", ".join(near))


def _untested(quantity: str, tested: set[int], why: str) -> Iterator[Figure]:
    """Yield a figure without a value for the cameras that were not tested, if there are any."""
    others = sorted(set(range(CAMERA_COUNT)) - tested)
    if others:
        all_of_them = len(others) == CAMERA_COUNT
        which = "all cameras" if all_of_them else f"camera {', '.join(map(str, others))}"
        yield Figure(quantity, where=f"{which}: {why}")


def _correlation(first: Points, second: Points) -> float:
    first, second = first - first.mean(), second - second.mean()
    size = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return float((first * second).sum()) / size if size > 0 else 0.0
