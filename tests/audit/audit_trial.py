"""A trial of the audit: scenes with one thing made wrong, and whether the command tells it.

    python -m tests.audit.audit_trial FOLDER --seed 7 --scenes 6 --also SCENES

draws as many scenes of all families (and takes those below SCENES beside), makes one thing wrong at
a time, runs ``stereogenbench audit`` on each, and prints a table of verdicts. Each is kept in
FOLDER/verdicts.jsonl.
"""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer
from typer.testing import CliRunner

from stereogenbench_data.cli.audit import audit
from stereogenbench_data.synthesis.ray_renderer import RAY_CASTING
from stereogenbench_data.synthesis.request import SynthRequest
from tests.audit.corruption import (
    as_inverse,
    as_ray,
    exchange,
    late,
    lengthen_label,
    read_depth,
    rewrite_depth,
    rewrite_one_depth,
    rewrite_rgb,
    scale_camera,
    scaled,
    write_depth,
)
from tests.audit.trial import FAMILIES, drawn_scenes, main, run_cases

OUTCOMES = ("found", "found elsewhere", "not testable", "missed", "passed", "false alarm")


@dataclass(frozen=True)
class Case:
    """One thing made wrong.

    ``cameras`` are those of which a finding should speak, none for all; ``checks`` are those that
    may tell it.
    """

    sort: str
    corrupt: Callable[[Path], object]
    cameras: tuple[int, ...] = ()
    checks: tuple[str, ...] = ()


def drawn_requests(seed: int, count: int) -> list[SynthRequest]:
    """Return scenes of all families, with sizes, lengths and lenses drawn at random."""
    rng = np.random.default_rng([seed, 2])
    return [
        SynthRequest(
            family=FAMILIES[number % 3],
            size_px=2 * int(rng.integers(48, 129)),
            frames=int(rng.integers(8, 21)),
            seed=seed * 1000 + number,
        )
        for number in range(count)
    ]


def cases(rng: np.random.Generator) -> Iterator[Case]:
    """Yield what is made wrong with a scene; of which camera is drawn."""

    def one() -> int:
        return int(rng.integers(6))

    yield Case("nothing", lambda folder: None)
    yield Case("nothing, pictures encoded again", lambda f: _pictures(f, one(), lambda p: p))
    for sort, change in (
        ("1 px higher", lambda p: np.roll(p, -1, 1)),
        ("1 px aside", lambda p: np.roll(p, 1, 2)),
        ("0.5 px lower", lambda p: ((p.astype(int) + np.roll(p, 1, 1) + 1) // 2).astype(np.uint8)),
        ("1 frame late", late(1)),
        ("2 frames late", late(2)),
        ("5 frames late", late(5)),
        ("15 frames late", late(15)),
        ("reversed in time", lambda p: p[::-1]),
        ("mirrored", lambda p: p[:, :, ::-1]),
    ):
        yield _of_pictures(sort, one(), change)
    for sort, change in (
        ("1 px aside", lambda u: np.roll(u, 1, 2)),
        ("scaled by 2 %", scaled(1.02)),
        ("halved", scaled(0.5)),
        ("1 frame late", late(1)),
        ("5 frames late", late(5)),
    ):
        yield _of_depth(sort, one(), change)
    yield _ray_of_one(one())
    yield Case("all depth along the ray", lambda folder: rewrite_depth(folder, as_ray(folder)),
               checks=("depth fit", "depth consistency", "agreement", "reprojection"))  # fmt: skip
    yield Case("all depth inverse", lambda folder: rewrite_depth(folder, as_inverse(folder)),
               checks=("depth fit", "depth consistency", "agreement", "reprojection"))  # fmt: skip
    for sort, kinds in (
        ("pictures", ("rgb.mp4",)),
        ("depth", ("depth.mkv",)),
        ("both", ("rgb.mp4", "depth.mkv")),
    ):
        yield _exchanged(sort, kinds, tuple(int(c) for c in rng.choice(6, 2, replace=False)))
    for percent in (2, 5):
        factor = 1 + percent / 100 * float(rng.choice([-1, 1]))
        told_by = ("depth fit", "motion fit", "pictures fit")
        yield Case(
            f"focal length off by {percent} %",
            lambda f, x=factor: scale_camera(f, focal_length_mm=x),
            checks=told_by,
        )
    yield Case(
        "sensor height of 4:3",
        lambda f: scale_camera(f, sensor_height_mm=3 / 4),
        checks=("motion fit",),
    )
    yield Case(
        "a baseline's label 0.5 mm off",
        lambda f: lengthen_label(f, (1, 2), by_cm=0.05),
        checks=("pose/baseline",),
    )
    yield _tagged(one())


def _of_pictures(sort: str, camera: int, change: Callable) -> Case:
    told_by = ("pictures fit",) if "px" in sort else ("picture time",)
    return Case(
        f"pictures of one camera {sort}", lambda f: _pictures(f, camera, change), (camera,), told_by
    )


def _of_depth(sort: str, camera: int, change: Callable) -> Case:
    return Case(
        f"depth of one camera {sort}",
        lambda f: rewrite_one_depth(f, camera, change),
        (camera,),
        ("depth fit",),
    )


def _ray_of_one(camera: int) -> Case:
    return Case(
        "depth of one camera along the ray",
        lambda f: rewrite_one_depth(f, camera, as_ray(f)),
        (camera,),
    )


def _exchanged(sort: str, kinds: tuple[str, ...], cameras: tuple[int, ...]) -> Case:
    a, b = cameras
    return Case(
        f"two cameras exchanged: {sort}", lambda f: exchange(f, {a: b, b: a}, kinds=kinds), (a, b)
    )


def _tagged(camera: int) -> Case:
    def corrupt(folder: Path) -> None:
        units, tags = read_depth(folder, camera)
        key = next(iter(key for key in tags if "scale" in key.lower()), "DEPTH_SCALE")
        write_depth(folder, camera, units, {key: repr(2 * float(tags.get(key, 0.1)))})

    return Case("depth tag of one camera doubled", corrupt, (camera,))


def _pictures(folder: Path, camera: int, change: Callable) -> None:
    rewrite_rgb(folder, camera, change, crf=0)


def audited(folder: Path) -> tuple[int, dict]:
    """Run the command as a user does; return its exit status and what it printed."""
    app = typer.Typer()
    app.command()(audit)
    app.command("other")(lambda: None)
    words = ["audit", str(folder), "--workers", "1", "--json", "--journal", f"{folder}.journal"]
    result = CliRunner().invoke(app, words, catch_exceptions=False)
    return result.exit_code, json.loads(result.stdout)


def outcome(case: Case, status: int, document: dict) -> str:
    """Return how good a verdict is, in a word."""
    findings = document["findings"]
    if (status == 1) != bool(findings):
        return f"exit status {status} with {len(findings)} findings"
    if case.sort.startswith("nothing"):
        return "false alarm" if findings else "passed"
    if not findings:
        # Between cameras, a focal length shows on slanted surfaces alone.
        open_checks = {each["check"] for each in document["untested"]} | {"depth fit"}
        return "not testable" if case.checks and set(case.checks) <= open_checks else "missed"
    named = set()
    for each in findings:
        for pattern in (r"cam_0(\d)", r"cameras? (\d)\b", r"\b(\d)-\d\b", r"\b\d-(\d)\b"):
            named |= set(map(int, re.findall(pattern, f"{each['member']} {each['found']}")))
    checks = {each["check"] for each in findings}
    is_named = set(case.cameras) <= named if case.cameras else bool(checks & set(case.checks))
    return "found" if is_named else "found elsewhere"


def run(root: Path, *, seed: int, count: int, also: Path | None) -> list[dict]:
    """Draw, make wrong and audit; return one record a case."""
    rng = np.random.default_rng([seed, 3])
    rendered = sorted(path.parent for path in also.rglob("baseline.json")) if also else []
    requests = [(request, RAY_CASTING) for request in drawn_requests(seed, count)]
    return run_cases(
        root,
        [*drawn_scenes(root, requests), *rendered],
        cases_of=lambda scene: cases(rng),
        examine=examine,
    )


def examine(case: Case, spoilt: Path) -> dict:
    """Return what is kept of the audit of one spoilt scene."""
    status, document = audited(spoilt)
    (scene,) = document["scenes"] or ({},)
    findings = document["findings"]
    return {
        "sort": case.sort,
        "cameras": case.cameras,
        "frames": scene.get("frames"),
        "outcome": outcome(case, status, document),
        "checks": [f"{each['member']} {each['check']}: {each['found']}" for each in findings],
        "alignment": scene.get("alignment"),
    }


if __name__ == "__main__":
    main(__doc__, run, OUTCOMES, scenes=6)
