"""The results file: rewritten after every round, with a description of the machine."""

import json
import os
import platform
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, Literal

import av
import numpy as np

Report = Callable[[str], None]
"""What reports progress."""

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
    """The results file: one section per measurement."""

    def __init__(self, path: Path) -> None:
        """Read an existing file, unless its format is another."""
        self.path = path
        self.sections: dict[str, Any] = {"format": FORMAT}
        if path.exists():
            found = json.loads(path.read_text())
            if found.get("format") == FORMAT:
                self.sections = found

    def put(self, name: str, section: Any) -> None:
        """Replace a section, and write the file."""
        self.sections[name] = section
        self.write()

    def write(self) -> None:
        """Write the file atomically."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        part.write_text(json.dumps(self.sections, indent=1) + "\n")
        part.replace(self.path)

    def race(self, workload: str) -> dict[str, Any]:
        """Return the section of a workload, empty if there is none."""
        found: dict[str, Any] = self.sections.get("races", {}).get(workload, {})
        return found or {"settings": {}, "rounds": [], "failed": {}}

    def put_race(self, workload: str, section: dict[str, Any]) -> None:
        """Replace the section of a workload, and write the file."""
        self.sections.setdefault("races", {})[workload] = section
        self.write()


def entry(name: str, workers: int) -> str:
    """Return the name of an entrant in a round."""
    return f"{name}/{workers}"


def _speed(run: dict[str, float], *, by: str = "seconds") -> float:
    return run["samples"] / run[by]


def rates(rounds: list[Round], entrant: str) -> Spread | None:
    """Return an entrant's samples a second."""
    return Spread.of(_speed(found[entrant]) for found in rounds if entrant in found)


def ratios(
    rounds: list[Round], entrant: str, *, to: str, by: Literal["seconds", "cpu_s"] = "seconds"
) -> Spread | None:
    """Return the ratio of the speeds of two entrants, one per round.

    Speeds by processor time are disturbed less by other processes.
    """
    return Spread.of(
        _speed(found[entrant], by=by) / _speed(found[to], by=by)
        for found in rounds
        if entrant in found and to in found
    )


_PACKAGES: Final = (
    "stereogenbench-data", "av", "numpy", "torch", "pyarrow", "webdataset", "datasets",
    "torchcodec", "decord", "blosc2", "mosaicml-streaming",
)  # fmt: skip


def machine() -> dict[str, Any]:
    """Return the versions and the machine that results depend on."""
    model = re.search(r"model name\s*: (.*)", _read("/proc/cpuinfo"))
    memory = re.search(r"MemTotal:\s*(\d+)", _read("/proc/meminfo"))
    return {
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": model[1] if model else platform.processor(),
        "cores": os.cpu_count(),
        "memory_gb": round(int(memory[1]) / 1e6, 1) if memory else None,
        "system": f"{platform.system()} {'.'.join(platform.release().split('.')[:2])}",
        "python": platform.python_version(),
        "ffmpeg of PyAV": av.ffmpeg_version_info,
        "load before": os.getloadavg()[0],
        "versions": {name: _version(name) for name in _PACKAGES},
    }


def _read(path: str) -> str:
    return Path(path).read_text() if Path(path).exists() else ""


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
