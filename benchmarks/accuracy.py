"""Speed against error: nanoseconds a pixel of every way, and its error on hard cases."""

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import av
import numpy as np

from benchmarks.material import Material
from benchmarks.results import Report
from benchmarks.ways import WAYS, Pair, interpolated
from stereogenbench_data.geometry.disparity import disparity_error_px
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth import resized_nearest

CASES: Final = 240
PIXELS: Final = (8, 256)
SCREEN_PX: Final = 1280.0
"""Beyond this disparity a point is outside any picture of the release."""
CONVERSION: Final = "uint16 to float32"

INVENTED_PX: Final = 1.0
"""A disparity that is farther from every surface at its pixel belongs to none: it was averaged."""

SHORTEST_S: Final = 0.02
"""A call is repeated until it has used this much processor time."""


def hard_pairs(count: int = CASES) -> Iterator[tuple[Pair, np.ndarray]]:
    """Yield pairs and maps of stored depth: the hard cases of the geometry tests.

    Baselines of 1 cm to 7.5 m either way, depth of 0.1 to 6,553 m, 1e6 cm from the world's origin,
    looking straight up and down, focal lengths of the release and units of 0.1 mm to 0.1 m.
    """
    rng = np.random.default_rng(0)
    for number in range(count):
        unit_m = float(rng.choice([0.1, 0.01, 0.001, 1 / 256, 0.05]))
        nearest, farthest = max(0.1 / unit_m, 1), min(65534.0, 6553.0 / unit_m)
        depth = np.exp(rng.uniform(np.log(nearest), np.log(farthest), PIXELS))
        units = np.clip(np.rint(depth), 1, 65534).astype(np.uint16)
        focal_px = float(rng.uniform(970, 4580))
        baseline_m = float(np.exp(rng.uniform(np.log(0.01), np.log(7.5)))) * (-1) ** number
        rotator_deg = (
            float(rng.choice([-90.0, 90.0, 89.9999, 0.0, rng.uniform(-90, 90)])),
            float(rng.uniform(-180, 180)),
            float(rng.uniform(-180, 180)),
        )
        x_cm, y_cm, z_cm = rng.choice([-1e6, 1e6, 1e5, 0.0], 3).tolist()
        pair = Pair(
            focal_px=focal_px,
            baseline_m=baseline_m,
            unit_m=unit_m,
            rotator_deg=rotator_deg,
            offset_cm=(x_cm, y_cm, z_cm),
        )
        yield pair, units


def measure_accuracy(
    material: Material, *, rounds: int, cases: int, report: Report
) -> dict[str, Any]:
    """Return the section of the results: error and speed of every way."""
    report("speed against error")
    pair, left = rendered_pair(material)
    ways = [{"name": way.name, "offered": way.offered} | _errors(way.run, cases) for way in WAYS]
    calls: dict[str, Callable[[], Any]] = {
        way.name: (lambda run=way.run: run(left, pair)) for way in WAYS
    }
    calls[CONVERSION] = lambda: left.astype(np.float32)
    resized, resizing = _resized(material.size_px)
    calls |= resizing
    spent = time_calls(calls, pixels=left.size, rounds=rounds)
    for way in (*ways, *resized):
        way["ns_a_pixel"] = _spread(spent[way["name"]], beside=spent[CONVERSION])
    return {
        "pixels": left.size,
        "cases": cases * PIXELS[0] * PIXELS[1],
        "conversion_ns": _spread(spent[CONVERSION], beside=spent[CONVERSION]),
        "ways": ways,
        "resized": resized,
        "justified": justified(ways),
        "rounds": rounds,
    }


def _errors(run: Callable[[np.ndarray, Pair], np.ndarray], cases: int) -> dict[str, Any]:
    """Return the error of a way over the hard cases."""
    all_px, screen_px, ulps, of_bound, lost = [], [], 0.0, 0.0, 0
    for pair, units in hard_pairs(cases):
        true_px = pair.true_px(units)
        found = run(units, pair)
        kept = np.isfinite(found)
        lost += int((~kept).sum())
        error_px = np.abs(found[kept].astype(np.longdouble) - true_px[kept]).astype(np.float64)
        size_px = np.abs(true_px[kept]).astype(np.float64)
        bound_px = disparity_error_px(
            (units * pair.unit_m)[kept][None],
            shift_px_m=pair.focal_px * abs(pair.baseline_m), half_step_m=pair.unit_m / 2,
        )[0]  # fmt: skip
        all_px.append(error_px)
        screen_px.append(error_px[size_px <= SCREEN_PX])
        ulps = max(ulps, float((error_px / np.spacing(size_px.astype(np.float32))).max()))
        of_bound = max(of_bound, float((error_px / bound_px).max()))
    everywhere, within = np.concatenate(all_px), np.concatenate(screen_px)
    return {
        "worst_px": float(everywhere.max()),
        "p999_px": float(np.quantile(everywhere, 0.999)),
        "worst_on_screen_px": float(within.max()),
        "p999_on_screen_px": float(np.quantile(within, 0.999)),
        "worst_ulps": ulps,
        "worst_of_bound": of_bound,
        "overflowed": lost,
    }


def justified(ways: list[dict[str, Any]]) -> str:
    """Return the cheapest way within the depth quantum's bound and 1 ulp of float32."""
    fit = [
        way
        for way in ways
        if way["worst_ulps"] <= 1 and way["worst_of_bound"] <= 1 and not way["overflowed"]
    ]
    return str(min(fit, key=lambda way: way["ns_a_pixel"]["median"])["name"])


def rendered_pair(material: Material) -> tuple[Pair, np.ndarray]:
    """Return the primary pair of a drawn scene, and its first left stored depth."""
    index = SceneIndex.open(material.eight)
    scene = index.scene(0)
    cameras = scene.rig.primary_pair
    pair = Pair(
        focal_px=scene.rig.focal_mm / scene.rig.sensor_width_mm * scene.rig.image_width_px,
        baseline_m=scene.rig.baseline_cm(*cameras) / 100,
        unit_m=scene.depth_unit_m[cameras[0]],
    )
    path = Path(index.root) / scene.members[f"cam_{cameras[0]:02d}_depth.mkv"].path
    with av.open(str(path)) as container:
        return pair, np.ascontiguousarray(next(container.decode(video=0)).to_ndarray())


def two_planes(
    u_px: np.ndarray, v_px: np.ndarray, *, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the disparity of a slanted disc before a slanted wall: visible, disc, wall.

    The disparity of a plane is linear in the pixel, so the truth at any point is known.
    """
    u, v = u_px / size, v_px / size
    wall = 8 + 6 * u + 2 * v
    disc = 90 + 25 * u - 15 * v
    return np.where((u - 0.45) ** 2 + (v - 0.5) ** 2 < 0.09, disc, wall), disc, wall


def _resized(size: int) -> tuple[list[dict[str, Any]], dict[str, Callable[[], np.ndarray]]]:
    """Return the error of every resizing policy on two planes at 832x480, and its call."""
    centres = np.arange(size) + 0.5
    here_px, _, _ = two_planes(centres[None, :], centres[:, None], size=size)
    height, width = max(2, size * 480 // 1280), max(2, size * 832 // 1280)
    across = width / size
    depth = (1000 / here_px).astype(np.float32)
    disparity = here_px.astype(np.float32)
    u_px = (np.arange(width) + 0.5)[None, :] / across
    v_px = (np.arange(height) + 0.5)[:, None] * size / height
    truth, disc, wall = (surface * across for surface in two_planes(u_px, v_px, size=size))
    out = (height, width)
    policies: dict[str, Callable[[], np.ndarray]] = {
        "nearest-exact, depth": lambda: 1000 / resized_nearest(depth, size=out),
        "nearest (corner), depth": lambda: 1000 / interpolated(depth, size=out, mode="nearest"),
        "bilinear, depth": lambda: 1000 / interpolated(depth, size=out, mode="bilinear"),
        "area, depth": lambda: 1000 / interpolated(depth, size=out, mode="area"),
        "bilinear, disparity": lambda: interpolated(disparity, size=out, mode="bilinear"),
        "area, disparity": lambda: interpolated(disparity, size=out, mode="area"),
    }
    found = []
    for name, run in policies.items():
        found_px = run() * across
        error_px = np.abs(found_px - truth)
        nowhere_px = np.minimum(np.abs(found_px - disc), np.abs(found_px - wall))
        found.append(
            {
                "name": name,
                "offered": "not taken" if found else "default",
                "worst_px": float(error_px.max()),
                "p999_px": float(np.quantile(error_px, 0.999)),
                "p99_px": float(np.quantile(error_px, 0.99)),
                "mean_px": float(error_px.mean()),
                "invented_share": float((nowhere_px > INVENTED_PX).mean()),
            }
        )
    return found, policies


def time_calls(
    calls: Mapping[str, Callable[[], Any]], *, pixels: int, rounds: int
) -> dict[str, list[float]]:
    """Return nanoseconds a pixel of each call in every round, after one round that warms up.

    Calls alternate; their order reverses from round to round.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(rounds + 1):
        for name in list(calls)[:: 1 if number % 2 else -1]:
            begin, done = time.process_time(), 0
            while done < 2 or time.process_time() - begin < SHORTEST_S:
                calls[name]()
                done += 1
            if number:
                times[name].append((time.process_time() - begin) / done / pixels * 1e9)
    return times


def _spread(values: list[float], *, beside: list[float]) -> dict[str, float]:
    """Return the median and quartiles of times, and the median of their ratios to others.

    The others are those of a conversion of the map, so ratios are called conversions.
    """
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    conversions = float(np.median(np.divide(values, beside)))
    return {"median": median, "low": low, "high": high, "conversions": conversions}
