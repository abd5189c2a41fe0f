"""A blind trial of the doctor: fresh scenes, one thing wrong in each, every verdict counted.

    python -m tests.audit.contract_trial FOLDER --seed 7 --scenes 12

draws as many scenes, rewrites their files in ways that the doctor is not told, asks it about each
alone by four frames, and prints a table of verdicts. Each is kept in FOLDER/verdicts.jsonl.
"""

import argparse
import json
import math
import re
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stereogenbench_data.audit.contract import diagnose
from stereogenbench_data.audit.contract_diagnosis import SceneDiagnosis
from stereogenbench_data.audit.contract_verdict import Verdict
from stereogenbench_data.synthesis import ExportContract, SynthRequest, synthesise
from tests.audit.corruption import (
    as_inverse,
    copied,
    edit_baseline,
    exchange,
    rewrite_depth,
    rewrite_rgb,
)

FAMILIES = ("IPD_Gaussian", "Uniform", "Pairwise_Uniform")
SENSORS_MM = ((23.76, 23.76), (36.0, 24.0), (22.3, 14.9), (13.2, 8.8))
SLIGHT = (0.95, 0.97, 0.98, 1.02, 1.03, 1.05)
GROSS = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)
ORDERS = {
    "primary pair swapped": ({0: 1, 1: 0}, ("rgb.mp4", "depth.mkv")),
    "pictures of the primary pair swapped": ({0: 1, 1: 0}, ("rgb.mp4",)),
    "depth of the primary pair swapped": ({0: 1, 1: 0}, ("depth.mkv",)),
    "reversed": ({c: 5 - c for c in range(6)}, ("rgb.mp4", "depth.mkv")),
    "pictures reversed": ({c: 5 - c for c in range(6)}, ("rgb.mp4",)),
    "depth reversed": ({c: 5 - c for c in range(6)}, ("depth.mkv",)),
}
UNIT, KIND, FORM, LAG = "metres a unit", "depth along", "stored is", "frame lag"
ORDER, FLIP, FOCAL, OFFSET = "left and right", "flip of depth", "focal length", "disparity offset"

BY_HEIGHT = "f / sensor height * picture height"


@dataclass(frozen=True)
class Case:
    """A scene with one thing wrong, and what is right to say of it.

    Topics that are ``allowed`` may be called wrong too.
    """

    sort: str
    topic: str | None
    request: SynthRequest
    corrupt: Callable[[Path], None] = lambda folder: None
    is_told: Callable[[Verdict, SceneDiagnosis], bool] = lambda verdict, scene: True
    may_be: Callable[[str], bool] = lambda found: False
    allowed: frozenset[str] = frozenset()
    details: str = ""
    facts: dict[str, float] = field(default_factory=dict)


def drawn_requests(seed: int, count: int) -> list[SynthRequest]:
    """Return scenes of all families, with lenses, sensors, sizes and units drawn at random."""
    rng = np.random.default_rng(seed)
    requests = []
    for number in range(count):
        width = 2 * int(rng.integers(48, 97))
        shape = float(rng.choice([1.0, 3 / 4, 2 / 3]))
        contract = ExportContract(
            sensor_mm=SENSORS_MM[int(rng.integers(len(SENSORS_MM)))],
            depth_unit_m=float(rng.choice([0.0005, 0.001, 0.002, 0.01])),
        )
        requests.append(
            SynthRequest(
                family=FAMILIES[number % 3],
                size_px=width,
                height_px=2 * round(width * shape / 2),
                frames=int(rng.integers(4, 17)),
                seed=seed * 1000 + number,
                focal_mm=round(float(rng.uniform(0.75, 3.4)) * contract.sensor_mm[0], 1),
                contract=contract,
            )
        )
    return requests


def cases(request: SynthRequest, rng: np.random.Generator) -> Iterator[Case]:
    """Yield what is made wrong with one scene."""
    yield Case("nothing", None, request)
    yield Case("nothing, one frame", None, replace(request, frames=1))
    for sort, factors in (("unit by 2 to 5 %", SLIGHT), ("unit by powers of ten", GROSS)):
        for factor in rng.choice(factors, 2, replace=False):
            yield unit_case(sort, request, float(factor))
    yield contract_case("ray depth", KIND, request, depth_kind="ray")
    yield inverse_case(request)
    for lag in rng.choice([-3, -2, -1, 1, 2, 3], 2, replace=False):
        yield contract_case("frame lag", LAG, request, frame_lag=int(lag))
    for name in rng.choice(list(ORDERS), 2, replace=False):
        yield order_case(request, str(name))
    for flip, axis in (("vertical", 1), ("horizontal", 2)):
        yield flip_case(request, flip, axis)
    for shift in rng.choice([-6, -3, -1, 1, 2, 5], 2, replace=False):
        yield offset_case(request, int(rng.integers(2)), int(shift))
    yield focal_case(request, float(rng.choice([0.75, 0.8, 1.25, 1.4])))
    # Not quite square pixels: the reading of the height differs by 1.6 %.
    oblong = replace(
        request, size_px=128, height_px=84, contract=replace(request.contract, sensor_mm=(36, 24))
    )
    alike = float(rng.choice([0.976, 0.98, 0.984, 0.988]))
    yield unit_case("unit by nearly what a focal length explains", oblong, alike)
    near = focal_case(request, float(rng.choice([0.97, 0.98, 1.02, 1.03])))
    yield replace(near, sort="focal length of the height, off by 2 or 3 %")
    yield Case(
        "control: no texture", None, request,
        lambda folder: [
            rewrite_rgb(folder, camera, lambda p: np.full_like(p, 110)) for camera in range(6)
        ] and None,
    )  # fmt: skip
    yield Case(
        "control: no parallax", None, request,
        lambda folder: exchange(folder, dict.fromkeys(range(6), 2)),
    )  # fmt: skip
    tiny = replace(request, size_px=96, height_px=64, focal_mm=0.5 * request.contract.sensor_mm[0])
    slight = float(rng.choice(SLIGHT))
    yield unit_case("control: little parallax, unit by 2 to 5 %", tiny, slight)
    single = replace(request, frames=1)
    yield unit_case("one frame, unit by 2 to 5 %", single, float(rng.choice(SLIGHT)))
    yield flip_case(single, "vertical", 1, sort="one frame, flip")


def unit_case(sort: str, request: SynthRequest, factor: float) -> Case:
    truth_m = request.contract.depth_unit_m
    return Case(
        sort, UNIT, request,
        lambda folder: rewrite_depth(folder, lambda units: units, unit_factor=factor),
        is_told=lambda verdict, _: is_within(verdict, truth_m),
        details=f"x {factor:g}", facts={"unit_m": truth_m},
    )  # fmt: skip


def is_within(verdict: Verdict, unit_m: float) -> bool:
    """Tell whether a unit is found to 1 %, or to what the verdict says is its error."""
    told = re.search(r"± ([0-9.]+)%", found_for(verdict, UNIT))
    error = float(told[1]) / 100 if told else 0.0
    return abs(verdict.unit_m / unit_m - 1) <= max(0.01, error)


def contract_case(sort: str, topic: str, request: SynthRequest, **changes) -> Case:
    """Return a scene that is written with another contract than the default, which is declared."""
    ((name, value),) = changes.items()
    name = name.removeprefix("depth_")
    return Case(
        sort, topic, replace(request, contract=replace(request.contract, **changes)),
        is_told=lambda verdict, _: getattr(verdict.encoding, name) == value,
        may_be=lambda found: f"{value}" in found.split(" or "),
        details=f"{value}",
    )  # fmt: skip


def inverse_case(request: SynthRequest) -> Case:
    facts: dict[str, float] = {}

    def corrupt(folder: Path) -> None:
        change = as_inverse(folder)
        stored = int(change(np.full((1, 1, 1), 20000)).item())
        facts["unit_m"] = request.contract.depth_unit_m * 2e4 * stored
        rewrite_depth(folder, change)

    return Case(
        "inverse depth", FORM, request, corrupt,
        is_told=lambda verdict, _: verdict.encoding.form == "inverse"
        and is_within(verdict, facts["unit_m"]),
        allowed=frozenset({UNIT}), facts=facts,
    )  # fmt: skip


def order_case(request: SynthRequest, name: str) -> Case:
    cameras, kinds = ORDERS[name]
    return Case(
        "order", ORDER, request,
        lambda folder: exchange(folder, cameras, kinds=kinds),
        is_told=lambda verdict, scene: scene.best.order == name,
        may_be=lambda found: name in found.split(" or "),
        details=name,
    )  # fmt: skip


def flip_case(request: SynthRequest, flip: str, axis: int, *, sort: str = "flip") -> Case:
    return Case(
        sort, FLIP, request,
        lambda folder: rewrite_depth(folder, lambda units: np.flip(units, axis)),
        is_told=lambda verdict, scene: scene.best.flip == flip,
        may_be=lambda found: flip in found.split(" or "),
        details=flip,
    )  # fmt: skip


def offset_case(request: SynthRequest, camera: int, shift: int) -> Case:
    def is_told(verdict: Verdict, scene: SceneDiagnosis) -> bool:
        return all(
            abs(px - shift * ((pair[0] == camera) - (pair[1] == camera))) < 0.35
            for pair, px in scene.offsets_px.items()
        )

    return Case(
        "offset", OFFSET, request,
        lambda folder: rewrite_rgb(folder, camera, lambda p: np.roll(p, shift, axis=2)),
        is_told=is_told, details=f"camera {camera} by {shift} px",
    )  # fmt: skip


def focal_case(request: SynthRequest, factor: float) -> Case:
    """Return a scene whose sensor's recorded width is wrong, so that its height is the one to use.

    The sensor's height is recorded as that which square pixels have.
    """

    def corrupt(folder: Path) -> None:
        def change(document: dict) -> None:
            camera = document["camera_intrinsics"]
            by_width = document["image_width"] / camera["sensor_width_mm"]
            camera["sensor_height_mm"] = document["image_height"] / by_width
            camera["sensor_width_mm"] *= factor

        edit_baseline(folder, change)

    return Case(
        "focal length of the height", FOCAL, request, corrupt,
        is_told=lambda verdict, _: found_for(verdict, FOCAL) == BY_HEIGHT,
        details=f"width x {factor:g}",
    )  # fmt: skip


def found_for(verdict: Verdict, topic: str) -> str:
    return next(answer.found for answer in verdict.answers if answer.topic == topic)


def outcome(case: Case, verdict: Verdict, scene: SceneDiagnosis) -> str:
    """Return how good a verdict is, in a word."""
    status = {answer.topic: answer.status for answer in verdict.answers}
    blamed = {topic for topic, said in status.items() if said == "wrong"}
    either = {topic for topic, said in status.items() if said == "one is wrong"}
    if case.topic is None:
        return "wrong" if verdict.is_wrong else "right"
    if blamed - {case.topic} - case.allowed:
        return "wrong"
    if case.topic in blamed:
        found = found_for(verdict, case.topic)
        if " or " in found:
            return "narrowed" if case.may_be(found) else "wrong"
        return "right" if case.is_told(verdict, scene) else "wrong"
    if case.topic in either:
        return "one of two" if case.is_told(verdict, scene) else "wrong"
    if either or status[case.topic] in ("confirmed", "does not matter"):
        return "wrong"
    return "cannot tell"


def run(root: Path, *, seed: int, count: int) -> list[dict]:
    """Draw, spoil and ask; return one record a case."""
    rng = np.random.default_rng([seed, 1])
    drawn: dict[SynthRequest, Path] = {}
    records = []
    with (root / "verdicts.jsonl").open("w") as log:
        for request in drawn_requests(seed, count):
            for case in cases(request, rng):
                if case.request not in drawn:
                    place = root / f"drawn_{len(drawn)}"
                    (key,) = synthesise(place, case.request, workers=1)
                    drawn[case.request] = place / key
                spoilt = root / "spoilt"
                shutil.rmtree(spoilt, ignore_errors=True)
                case.corrupt(copied(drawn[case.request], spoilt))
                report = diagnose(spoilt, frames=4, workers=1)
                record = recorded(case, report.verdicts[0], report.scenes[0])
                records.append(record)
                log.write(json.dumps(record) + "\n")
                log.flush()
    return records


def recorded(case: Case, verdict: Verdict, scene: SceneDiagnosis) -> dict:
    """Return what is kept of a verdict."""
    truth_m = case.facts.get("unit_m", math.nan)
    return {
        "sort": case.sort,
        "details": case.details,
        "outcome": outcome(case, verdict, scene),
        "unit_off": verdict.unit_m / truth_m - 1,
        "status": {answer.topic: answer.status for answer in verdict.answers},
        "found": {answer.topic: answer.found for answer in verdict.answers},
        "notes": {answer.topic: answer.note for answer in verdict.answers if answer.note},
        "offsets_px": list(scene.offsets_px.values()),
        "disparity_px": scene.disparity_px,
        "agreement": verdict.agreement,
        "request": f"{case.request}",
    }


def table(records: list[dict]) -> str:
    """Return a row a sort of mistake: how many were told, left open, or wrong."""
    words = ("right", "one of two", "narrowed", "cannot tell", "wrong")
    lines = ["| made wrong | " + " | ".join(words) + " |", "|---" * (len(words) + 1) + "|"]
    for sort in dict.fromkeys(record["sort"] for record in records):
        told = Counter(record["outcome"] for record in records if record["sort"] == sort)
        lines.append(f"| {sort} | " + " | ".join(str(told[word] or "") for word in words) + " |")
    sharp = [abs(r["unit_off"]) for r in records if r["outcome"] in ("right", "one of two")
             and math.isfinite(r["unit_off"])]  # fmt: skip
    lines.append(f"units told: {len(sharp)}, to 0.5 %: {sum(off <= 0.005 for off in sharp)}")
    controls = [r for r in records if r["sort"].startswith(("nothing", "control"))]
    for sort in dict.fromkeys(record["sort"] for record in controls):
        said = Counter(
            (topic, status)
            for r in controls
            if r["sort"] == sort
            for topic, status in r["status"].items()
        )
        lines.append(f"{sort}: " + ", ".join(f"{t} {s} {n}" for (t, s), n in sorted(said.items())))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--scenes", type=int, default=12)
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    sys.stdout.write(table(run(options.folder, seed=options.seed, count=options.scenes)) + "\n")


if __name__ == "__main__":
    main()
