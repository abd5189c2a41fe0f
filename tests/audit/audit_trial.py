"""A trial of the audit: scenes with one thing made wrong, and whether the command tells it.

    python -m tests.audit.audit_trial FOLDER --seed 7 --scenes 6 --also SCENES

draws as many scenes of all families (and takes those below SCENES beside), makes one thing wrong at
a time, runs ``stereogenbench audit`` on each, and prints a table of verdicts. Each is kept in
FOLDER/verdicts.jsonl.
"""

import argparse
import json
import re
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer
from typer.testing import CliRunner

from stereogenbench_data.cli.audit import audit
from stereogenbench_data.synthesis import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.audit.corruption import (
    as_inverse,
    as_ray,
    copied,
    edit_baseline,
    exchange,
    read_depth,
    rewrite_depth,
    rewrite_rgb,
    write_depth,
)

FAMILIES = ("IPD_Gaussian", "Uniform", "Pairwise_Uniform")
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
        ("1 frame late", lambda p: _late(p, 1)),
        ("2 frames late", lambda p: _late(p, 2)),
        ("5 frames late", lambda p: _late(p, 5)),
        ("15 frames late", lambda p: _late(p, 15)),
        ("reversed in time", lambda p: p[::-1]),
        ("mirrored", lambda p: p[:, :, ::-1]),
    ):
        yield _of_pictures(sort, one(), change)
    for sort, change in (
        ("1 px aside", lambda u: np.roll(u, 1, 2)),
        ("scaled by 2 %", lambda u: _times(u, 1.02)),
        ("halved", lambda u: _times(u, 0.5)),
        ("1 frame late", lambda u: _late(u, 1)),
        ("5 frames late", lambda u: _late(u, 5)),
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
        focal = _changed("focal_length_mm", factor)
        told_by = ("depth fit", "motion fit", "pictures fit")
        yield Case(f"focal length off by {percent} %", focal, checks=told_by)
    height = _changed("sensor_height_mm", 3 / 4)
    yield Case("sensor height of 4:3", height, checks=("motion fit",))
    yield Case("a baseline's label 0.5 mm off", _longer, checks=("pose/baseline",))
    yield _tagged(one())


def _of_pictures(sort: str, camera: int, change: Callable) -> Case:
    told_by = ("pictures fit",) if "px" in sort else ("picture time",)
    return Case(
        f"pictures of one camera {sort}", lambda f: _pictures(f, camera, change), (camera,), told_by
    )


def _of_depth(sort: str, camera: int, change: Callable) -> Case:
    return Case(
        f"depth of one camera {sort}",
        lambda f: _depth(f, camera, change),
        (camera,),
        ("depth fit",),
    )


def _ray_of_one(camera: int) -> Case:
    return Case(
        "depth of one camera along the ray", lambda f: _depth(f, camera, as_ray(f)), (camera,)
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


def _depth(folder: Path, camera: int, change: Callable) -> None:
    units, tags = read_depth(folder, camera)
    write_depth(
        folder, camera, change(units), {k: v for k, v in tags.items() if "scale" in k.lower()}
    )


def _late(frames: np.ndarray, lag: int) -> np.ndarray:
    return frames[np.maximum(np.arange(len(frames)) - lag, 0)]


def _times(units: np.ndarray, factor: float) -> np.ndarray:
    known = (units > 0) & (units < 65535)
    return np.where(known, np.clip(np.rint(units * factor), 1, 65534), units)


def _changed(name: str, factor: float) -> Callable[[Path], None]:
    def change(document: dict) -> None:
        document["camera_intrinsics"][name] *= factor

    return lambda folder: edit_baseline(folder, change)


def _longer(folder: Path) -> None:
    def change(document: dict) -> None:
        for pairs in ("adjacent_pairs", "pairwise_pairs"):
            for pair in document[pairs]:
                if (pair["camera_index_a"], pair["camera_index_b"]) == (1, 2):
                    pair["baseline_cm"] += 0.05

    edit_baseline(folder, change)


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
    scenes = []
    for number, request in enumerate(drawn_requests(seed, count)):
        place = root / f"drawn_{number}"
        (key,) = synthesise(place, request, workers=1)
        scenes.append(place / key)
    if also is not None:
        scenes += sorted(path.parent for path in also.rglob("baseline.json"))
    records = []
    with (root / "verdicts.jsonl").open("w") as log:
        for scene in scenes:
            for case in cases(rng):
                spoilt = root / "spoilt"
                shutil.rmtree(spoilt, ignore_errors=True)
                case.corrupt(copied(scene, spoilt))
                status, document = audited(spoilt)
                (audited_scene,) = document["scenes"] or ({},)
                record = {
                    "sort": case.sort,
                    "cameras": case.cameras,
                    "scene": str(scene),
                    "frames": audited_scene.get("frames"),
                    "outcome": outcome(case, status, document),
                    "checks": [f"{each['member']} {each['check']}: {each['found']}"
                               for each in document["findings"]],
                    "alignment": audited_scene.get("alignment"),
                }  # fmt: skip
                records.append(record)
                log.write(json.dumps(record) + "\n")
                log.flush()
    return records


def table(records: list[dict]) -> str:
    """Return a row a sort of mistake: how many were found, not testable, missed."""
    others = {record["outcome"] for record in records} - set(OUTCOMES)
    words = (*OUTCOMES, *sorted(others))
    lines = ["| made wrong | " + " | ".join(words) + " |", "|---" * (len(words) + 1) + "|"]
    for sort in dict.fromkeys(record["sort"] for record in records):
        told = Counter(record["outcome"] for record in records if record["sort"] == sort)
        lines.append(f"| {sort} | " + " | ".join(str(told[word] or "") for word in words) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--also", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    records = run(options.folder, seed=options.seed, count=options.scenes, also=options.also)
    sys.stdout.write(table(records) + "\n")


if __name__ == "__main__":
    main()
