"""Results as they come: one JSON file, written whole after every round, and what it says."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

FORMAT: Final = 2

Round = dict[str, dict[str, float]]
"""Of one round: what each entrant measured, by its name and workers as in "ours/2"."""


@dataclass(frozen=True, slots=True)
class Spread:
    """A median with its quartiles, over rounds."""

    median: float
    low: float
    high: float
    rounds: int

    @classmethod
    def of(cls, values: Iterable[float]) -> "Spread | None":
        """Return the spread of some numbers, None of none."""
        found = np.array(list(values), dtype=np.float64)
        if not len(found):
            return None
        low, median, high = np.quantile(found, [0.25, 0.5, 0.75])
        return cls(float(median), float(low), float(high), len(found))


class Results:
    """The results file: a section for each thing that is measured."""

    def __init__(self, path: Path) -> None:
        """Read what is there already; nothing is, of another format."""
        self.path = path
        self.sections: dict[str, Any] = {"format": FORMAT}
        if path.exists():
            found = json.loads(path.read_text())
            if found.get("format") == FORMAT:
                self.sections = found

    def put(self, name: str, section: Any) -> None:
        """Put a section in place of what was there, and write the file."""
        self.sections[name] = section
        self.write()

    def write(self) -> None:
        """Write the file, whole or not at all."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        part.write_text(json.dumps(self.sections, indent=1) + "\n")
        part.replace(self.path)

    def race(self, workload: str) -> dict[str, Any]:
        """Return a workload's section, an empty one if there is none."""
        found: dict[str, Any] = self.sections.get("races", {}).get(workload, {})
        return found or {"settings": {}, "rounds": [], "failed": {}}

    def put_race(self, workload: str, section: dict[str, Any]) -> None:
        """Put a workload's section, and write the file."""
        self.sections.setdefault("races", {})[workload] = section
        self.write()


def entry(name: str, workers: int) -> str:
    """Return how an entrant is called in a round."""
    return f"{name}/{workers}"


def rates(rounds: list[Round], entrant: str) -> Spread | None:
    """Return an entrant's samples a second."""
    return Spread.of(
        found[entrant]["samples"] / found[entrant]["seconds"]
        for found in rounds
        if entrant in found
    )


def ratios(rounds: list[Round], entrant: str, *, to: str) -> Spread | None:
    """Return how many times as fast an entrant is as another: one ratio a round."""
    return Spread.of(
        found[entrant]["samples"] / found[entrant]["seconds"]
        / (found[to]["samples"] / found[to]["seconds"])
        for found in rounds
        if entrant in found and to in found
    )  # fmt: skip


def shares(rounds: list[Round], entrant: str, *, without: str) -> Spread | None:
    """Return the share of an entrant's time that another saves, which leaves out a part of it."""
    return Spread.of(
        1 - (found[entrant]["samples"] / found[entrant]["seconds"])
        / (found[without]["samples"] / found[without]["seconds"])
        for found in rounds
        if entrant in found and without in found
    )  # fmt: skip


def cpu_ratios(rounds: list[Round], entrant: str, *, to: str) -> Spread | None:
    """Return the same by processor time a sample, which other processes disturb less."""
    return Spread.of(
        (found[to]["cpu_s"] / found[to]["samples"])
        / (found[entrant]["cpu_s"] / found[entrant]["samples"])
        for found in rounds
        if entrant in found and to in found
    )
