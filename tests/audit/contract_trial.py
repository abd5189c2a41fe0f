"""A blind trial of the doctor: fresh scenes, one thing or two made wrong, every verdict counted.

    python -m tests.audit.contract_trial FOLDER --seed 7 --scenes 12

draws as many scenes, rewrites their files in ways that the doctor does not know, runs it on each
alone by four frames, and prints a table of verdicts. Each is kept in FOLDER/verdicts.jsonl.
``--also ROOT`` spoils copies of scenes in the released layout beside those that are drawn.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereogenbench_data.audit.contract.doctor import diagnose
from stereogenbench_data.audit.contract.verdict import Verdict, encoding_line
from stereogenbench_data.synthesis.ray_renderer import RayCasting
from stereogenbench_data.synthesis.request import ExportContract, SynthRequest
from tests.audit.corruption import (
    as_inverse,
    as_ray,
    exchange,
    late,
    place_cameras,
    read_depth,
    rewrite_depth,
    rewrite_one_depth,
    rewrite_rgb,
    scale_camera,
    scaled,
)
from tests.audit.trial import FAMILIES, drawn_scenes, main, run_cases

SENSORS_MM = ((23.76, 23.76), (36.0, 24.0), (22.3, 14.9), (13.2, 8.8))
SIZES_PX = (96, 128, 160, 192, 256)
QUOTIENT, KIND, FORM = "unit / (focal length x baseline)", "depth along", "stored is"
LAG, ORDER, FLIP, OFFSET = "frame lag", "left and right", "flip of depth", "disparity offset"
NOTHING = ("rgb.mp4", "depth.mkv")
OUTCOMES = ("right", "named", "seen", "cannot tell", "WRONG")


@dataclass(frozen=True)
class Case:
    """A scene with something wrong, and what may be said of it.

    Attributes:
        sort: The row of the table.
        corrupt: Rewrites the files.
        named: A regular expression that a right name of the problem matches; empty for none.
        paste: The one line that may be pasted; None where nothing may.
        false: Topics that are not as declared, and may not be confirmed.
        blamed: Topics that may be called wrong.
        cameras: Cameras that may be named as not fitting.
        hidden: Whether pictures do not show it: nothing is asked but that nothing else is blamed.
        details: What was done.
    """

    sort: str
    corrupt: Callable[[Path], object]
    named: str = ""
    paste: str | None = None
    false: frozenset[str] = frozenset()
    blamed: frozenset[str] = frozenset()
    cameras: frozenset[int] = frozenset()
    hidden: bool = False
    details: str = ""


def drawn_requests(seed: int, count: int) -> list[tuple[SynthRequest, RayCasting]]:
    """Return scenes of all families, with lenses, sensors, sizes and units drawn at random."""
    rng = np.random.default_rng(seed)
    requests = []
    for number in range(count):
        shape = float(rng.choice([1.0, 3 / 4, 2 / 3]))
        width = int(rng.choice(SIZES_PX))
        sensor_mm = SENSORS_MM[int(rng.integers(len(SENSORS_MM)))]
        unit_m = float(rng.choice([0.0005, 0.001, 0.002, 0.01]))
        request = SynthRequest(
            family=FAMILIES[number % 3],
            size_px=width,
            height_px=2 * round(width * shape / 2),
            frames=int(rng.integers(4, 21)),
            seed=seed * 1000 + number,
            focal_mm=round(float(rng.uniform(0.75, 3.4)) * sensor_mm[0], 1),
            contract=ExportContract(depth_unit_m=unit_m),
        )
        requests.append((request, RayCasting(sensors_mm=(sensor_mm,))))
    return requests


def cases(rng: np.random.Generator, *, frames: int) -> Iterator[Case]:
    """Yield what is made wrong with one scene."""
    yield Case("nothing", lambda folder: None)
    yield from _contract_cases(rng, frames=frames)
    yield from _camera_cases(rng, frames=frames)
    yield from _picture_cases(rng, frames=frames)
    yield from _combined_cases(rng)


def _contract_cases(rng: np.random.Generator, *, frames: int) -> Iterator[Case]:
    quotient = {"false": frozenset({QUOTIENT}), "blamed": frozenset({QUOTIENT})}
    for factor in (float(rng.choice([0.95, 0.97, 1.03, 1.05])), float(rng.choice([0.1, 2.0, 100]))):
        yield Case(
            "unit wrong", lambda f, x=factor: rewrite_depth(f, lambda u: u, unit_factor=x),
            named=r"if focal length and baselines are right", details=f"x {factor}", **quotient,
        )  # fmt: skip
    focal = float(rng.choice([0.95, 1.05]))
    yield Case(
        "focal length wrong by 5 %", lambda f: scale_camera(f, focal_length_mm=focal),
        named=r"if unit and baselines are right", details=f"x {focal}", **quotient,
    )  # fmt: skip
    yield Case(
        "sensor's height of 4:3", lambda f: scale_camera(f, sensor_height_mm=0.75),
        hidden=True,
    )  # fmt: skip
    yield Case(
        "all distances wrong by 6 %", lambda f: place_cameras(f, dict.fromkeys(range(6), 1.06)),
        named=r"if unit and focal length are right", **quotient,
    )  # fmt: skip
    camera = int(rng.integers(1, 6))
    yield Case(
        "one camera recorded elsewhere",
        lambda f: place_cameras(f, {camera: 1.15}), named=f"camera {camera}( is|'s picture)",
        cameras=frozenset({camera}), details=f"camera {camera}", blamed=frozenset({OFFSET}),
    )  # fmt: skip
    yield Case(
        "depth along the ray", lambda f: rewrite_depth(f, as_ray(f)),
        named="the ray", paste="DepthEncoding(kind='ray')",
        false=frozenset({KIND}), blamed=frozenset({KIND}),
    )  # fmt: skip
    yield Case(
        "inverse depth", lambda f: rewrite_depth(f, as_inverse(f)),
        named="inverse depth", false=frozenset({FORM, QUOTIENT}), blamed=frozenset({FORM}),
    )  # fmt: skip
    lag = int(rng.choice([lag for lag in (-2, -1, 1, 2, 5) if abs(lag) < frames - 1]))
    yield Case(
        "depth of all lagged", lambda f: rewrite_depth(f, late(lag)),
        named=rf"(^| ){lag}( |$)" if abs(lag) < 4 else "or beyond",
        paste=f"DepthEncoding(frame_lag={lag})",
        false=frozenset({LAG}), blamed=frozenset({LAG}), details=f"{lag}",
    )  # fmt: skip
    axis = int(rng.integers(1, 3))
    yield Case(
        "depth of all flipped", lambda f: rewrite_depth(f, lambda u: np.flip(u, axis)),
        named="vertical" if axis == 1 else "horizontal", false=frozenset({FLIP}),
        blamed=frozenset({FLIP}), details=f"axis {axis}",
    )  # fmt: skip
    for words, kinds in (("", NOTHING), ("pictures", NOTHING[:1]), ("depth", NOTHING[1:])):
        yield Case(
            "order of all cameras reversed",
            lambda f, k=kinds: exchange(f, {c: 5 - c for c in range(6)}, kinds=k),
            named=f"{words} reversed|mirrored".strip(), false=frozenset({ORDER}),
            blamed=frozenset({ORDER}), details=words,
        )  # fmt: skip
        # The primary pair, its neighbour, and any two.
        for pair in ((0, 1), (1, 2), tuple(sorted(rng.choice(6, 2, replace=False).tolist()))):
            yield Case(
                f"files of two cameras exchanged: {words or 'both'}",
                lambda f, k=kinds, p=pair: exchange(f, {p[0]: p[1], p[1]: p[0]}, kinds=k),
                named=f"cameras {pair[0]} and {pair[1]} exchanged",
                false=frozenset({ORDER}), blamed=frozenset({ORDER}),
                cameras=frozenset(pair), details=f"{pair}",
            )  # fmt: skip


def _camera_cases(rng: np.random.Generator, *, frames: int) -> Iterator[Case]:
    for sort, change, named in (
        ("depth of one camera halved", scaled(0.5), r"0\.5\d* x"),
        ("depth of one camera scaled by 3 to 5 %", scaled(float(rng.choice([0.95, 1.03, 1.05]))),
         r"is \d\.\d+ x"),
        ("depth of one camera lagged", late(int(rng.choice([-3, -1, 1, 2]))), "lag|explains"),
        ("depth of one camera flipped", lambda u: np.flip(u, 1 + int(rng.integers(2))), "flip"),
        ("depth of one camera one pixel aside", lambda u: np.roll(u, 1, axis=2), "depth of"),
    ):  # fmt: skip
        if "lagged" in sort and frames < 4:
            continue
        camera = int(rng.integers(6))
        yield Case(
            sort, lambda f, c=camera, ch=change: rewrite_one_depth(f, c, ch),
            named=f"depth of camera {camera} .*({named})", cameras=frozenset({camera}),
            details=f"camera {camera}", hidden="aside" in sort,
        )  # fmt: skip
    for sort, change_of, named in (
        ("depth of one camera along the ray", as_ray, "ray| x that"),
        ("depth of one camera inverse", as_inverse, "inverse| x that|explains"),
    ):
        camera = int(rng.integers(6))
        yield Case(
            sort, lambda f, c=camera, g=change_of: rewrite_one_depth(f, c, g(f)),
            named=f"depth of camera {camera} .*({named})", cameras=frozenset({camera}),
            details=f"camera {camera}",
        )  # fmt: skip
    camera, factor = int(rng.integers(6)), float(rng.choice([10.0, 0.1, 1.1]))
    yield Case(
        "tag of one camera wrong",
        lambda f: rewrite_one_depth(f, camera, lambda u: u, unit_factor=factor),
        named=f"depth of camera {camera} is", cameras=frozenset({camera}),
        details=f"camera {camera} x {factor}",
    )  # fmt: skip


def _picture_cases(rng: np.random.Generator, *, frames: int) -> Iterator[Case]:
    for axis, sort in ((1, "pictures of one camera 1 px higher or lower"),
                       (2, "pictures of one camera 1 to 3 px aside")):  # fmt: skip
        camera = int(rng.integers(6))
        shift = int(rng.choice([-1, 1] if axis == 1 else [-1, 1, 3]))
        yield Case(
            sort, lambda f, c=camera, a=axis, n=shift: rewrite_rgb(f, c, rolled(n, a)),
            named=f"camera {camera}('s picture| are)", blamed=frozenset({OFFSET}),
            cameras=frozenset({camera}), details=f"camera {camera} by {shift}",
        )  # fmt: skip
    for frames_late in sorted({1, min(3, frames - 1), min(15, frames - 1)}):
        camera = int(rng.integers(6))
        yield Case(
            "pictures of one camera late by 1 to 15 frames",
            lambda f, c=camera, n=frames_late: rewrite_rgb(f, c, late(n)),
            named=f"camera {camera} are {frames_late} frames? late", cameras=frozenset({camera}),
            details=f"camera {camera} by {frames_late} of {frames}",
        )  # fmt: skip
    camera = int(rng.integers(6))
    yield Case(
        "pictures of one camera mirrored",
        lambda f: rewrite_rgb(f, camera, lambda p: p[:, :, ::-1]),
        named=f"camera {camera} are mirrored", cameras=frozenset({camera}),
        details=f"camera {camera}",
    )  # fmt: skip
    yield Case(
        "pictures of all cameras mirrored",
        lambda f: [rewrite_rgb(f, c, lambda p: p[:, :, ::-1]) for c in range(6)],
        named="horizontal|mirrored", false=frozenset({ORDER, FLIP}),
        blamed=frozenset({ORDER, FLIP}),
    )  # fmt: skip
    yield Case(
        "red and blue exchanged",
        lambda f: [rewrite_rgb(f, c, lambda p: p[..., ::-1]) for c in range(6)], hidden=True,
    )  # fmt: skip
    yield Case(
        "no texture",
        lambda f: [rewrite_rgb(f, c, lambda p: np.full_like(p, 110)) for c in range(6)],
        hidden=True, false=frozenset({QUOTIENT, KIND, FORM, LAG, ORDER, FLIP}),
    )  # fmt: skip
    yield Case(
        "six equal views", lambda f: exchange(f, dict.fromkeys(range(6), 2)),
        hidden=True, false=frozenset({QUOTIENT, KIND, FORM, LAG, ORDER, FLIP}),
    )  # fmt: skip


def rolled(shift: int, axis: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda pictures: np.roll(pictures, shift, axis)


def _combined_cases(rng: np.random.Generator) -> Iterator[Case]:
    def unit_and_ray(folder: Path) -> None:
        rewrite_depth(folder, as_ray(folder), unit_factor=1.04)

    def unit_and_exchange(folder: Path) -> None:
        rewrite_depth(folder, lambda u: u, unit_factor=0.9)
        exchange(folder, {2: 4, 4: 2})

    def two_depths(folder: Path) -> None:
        rewrite_one_depth(folder, 1, scaled(0.5))
        rewrite_one_depth(folder, 4, scaled(1.2))

    def higher_and_halved(folder: Path) -> None:
        rewrite_rgb(folder, 5, lambda p: np.roll(p, -1, 1))
        rewrite_one_depth(folder, 0, scaled(0.5))

    def cycle(folder: Path) -> None:
        exchange(folder, {c: (c + 1) % 6 for c in range(6)})

    every = frozenset({QUOTIENT, KIND, FORM, LAG, ORDER, FLIP, OFFSET})
    for sort, corrupt, blamed, cameras, false in (
        ("two things: unit and ray", unit_and_ray, {KIND, QUOTIENT}, set(), {KIND, QUOTIENT}),
        ("two things: unit and cameras 2, 4", unit_and_exchange, {ORDER, QUOTIENT}, {2, 4},
         {ORDER, QUOTIENT}),
        ("two things: depth of cameras 1, 4", two_depths, set(), {1, 4}, set()),
        ("two things: picture 5, depth 0", higher_and_halved, {OFFSET}, {0, 5}, set()),
        ("files numbered one too high", cycle, {ORDER}, set(range(6)), {ORDER}),
    ):  # fmt: skip
        yield Case(
            sort, corrupt, named=".", blamed=frozenset(blamed), cameras=frozenset(cameras),
            false=frozenset(false & every), details="",
        )  # fmt: skip


def outcome(case: Case, verdict: Verdict) -> tuple[str, str]:
    """Return how good a verdict is, in a word, and why where it is wrong."""
    untouched = case.sort == "nothing"
    pasted = None if verdict.encoding is None else encoding_line(verdict.encoding)
    if pasted is not None and pasted != case.paste:
        return "WRONG", f"pasted {pasted}"
    confirmed = {a.topic for a in verdict.answers if a.status == "confirmed"}
    if confirmed & case.false:
        return "WRONG", f"confirmed {sorted(confirmed & case.false)}"
    if verdict.fits and not (untouched or case.hidden):
        return "WRONG", "declared contract fits"
    blamed = {a.topic for a in verdict.answers if a.status == "wrong"}
    if blamed - case.blamed:
        return "WRONG", f"blamed {sorted(blamed - case.blamed)}"
    named = {int(c) for words in verdict.problems for c in re.findall(r"camera (\d)", words)}
    if named - case.cameras or (verdict.problems and not named and not case.cameras):
        return "WRONG", f"problems {verdict.problems}"
    if not verdict.is_wrong:
        return ("right" if untouched and verdict.fits else "cannot tell"), ""
    found = [a.found for a in verdict.answers if a.status == "wrong"]
    words = [*found, *verdict.problems, *verdict.choices]
    return ("named" if any(re.search(case.named, w) for w in words) else "seen"), ""


def run(root: Path, *, seed: int, count: int, also: Path | None) -> list[dict]:
    """Draw, spoil and ask; return one record a case."""
    rng = np.random.default_rng([seed, 1])
    rendered = list(also.glob("*/*/*/scene_*")) if also else []

    def examine(case: Case, spoilt: Path) -> dict:
        return recorded(case, diagnose(spoilt, frames=4, workers=1).verdicts[0])

    return run_cases(
        root,
        [*rendered, *drawn_scenes(root, drawn_requests(seed, count))],
        cases_of=lambda scene: cases(rng, frames=len(read_depth(scene, 0)[0])),
        examine=examine,
    )


def recorded(case: Case, verdict: Verdict) -> dict:
    """Return what is kept of a verdict."""
    word, why = outcome(case, verdict)
    return {
        "sort": case.sort,
        "details": case.details,
        "outcome": word,
        "why": why,
        "answers": {a.topic: [a.status, a.found, a.note] for a in verdict.answers},
        "problems": verdict.problems,
        "paste": verdict.encoding and encoding_line(verdict.encoding),
        "choices": verdict.choices,
        "agreement": verdict.agreement,
        "quotient": [verdict.quotient, verdict.quotient_error],
        "unexplained": verdict.unexplained_cameras,
        "untested": verdict.untested_cameras,
    }


if __name__ == "__main__":
    main(__doc__, run, OUTCOMES, scenes=12)
