"""What the trials of the doctor and of the audit share: scenes to spoil, records, the table."""

import argparse
import json
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.ray_renderer import RayCasting
from stereogenbench_data.synthesis.request import SynthRequest
from tests.audit.corruption import copied

FAMILIES = ("IPD_Gaussian", "Uniform", "Pairwise_Uniform")


def drawn_scenes(root: Path, requests: Iterable[tuple[SynthRequest, RayCasting]]) -> list[Path]:
    """Draw one scene for each request; return the folders."""
    scenes = []
    for number, (request, renderer) in enumerate(requests):
        place = root / f"drawn_{number}"
        (key,) = synthesise(place, request, renderer=renderer, workers=1)
        scenes.append(place / key)
    return scenes


def run_cases(
    root: Path,
    scenes: Iterable[Path],
    *,
    cases_of: Callable[[Path], Iterable[Any]],
    examine: Callable[[Any, Path], dict],
) -> list[dict]:
    """Spoil a copy of each scene in each way; return and keep what examine(case, root) records."""
    records = []
    with (root / "verdicts.jsonl").open("w") as log:
        for scene in scenes:
            for case in cases_of(scene):
                spoilt = root / "spoilt"
                shutil.rmtree(spoilt, ignore_errors=True)
                case.corrupt(copied(scene, spoilt))
                record = examine(case, spoilt) | {"scene": f"{scene}"}
                records.append(record)
                log.write(json.dumps(record) + "\n")
                log.flush()
    return records


def table(records: Sequence[dict], outcomes: Sequence[str]) -> str:
    """Return a row for each sort of mistake: how many records had each outcome."""
    others = {record["outcome"] for record in records} - set(outcomes)
    words = (*outcomes, *sorted(others))
    lines = ["| made wrong | " + " | ".join(words) + " |", "|---" * (len(words) + 1) + "|"]
    for sort in dict.fromkeys(record["sort"] for record in records):
        counts = Counter(record["outcome"] for record in records if record["sort"] == sort)
        lines.append(f"| {sort} | " + " | ".join(str(counts[word] or "") for word in words) + " |")
    return "\n".join(lines)


def main(
    description: str | None,
    run: Callable[..., list[dict]],
    outcomes: Sequence[str],
    *,
    scenes: int,
) -> None:
    """Run a trial from the command line, and print its table."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--scenes", type=int, default=scenes)
    parser.add_argument("--also", type=Path, help="Spoil copies of the scenes below this, too.")
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    records = run(options.folder, seed=options.seed, count=options.scenes, also=options.also)
    sys.stdout.write(table(records, outcomes) + "\n")
