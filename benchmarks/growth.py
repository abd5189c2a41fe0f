"""`python -m benchmarks.growth FOLDER`: what grows with the scenes, at the release's size and more.

Rows of an index are drawn from the scenes of a folder, whose files all of them share. Times are of
one call each, memory is what a process holds beyond its interpreter and libraries.
"""

import argparse
import hashlib
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, Final

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.shards.plan import plan_shards

SIZES: Final = (7_754, 100_000)
FIELDS: Final = ("left", "right", "disparity", "valid", "__key__")


def drawn_index(folder: Path, scenes: int) -> SceneIndex:
    """Return an index of so many scenes, which share the files of those in a folder."""
    found = SceneIndex.open(folder)
    originals = [found.indexed_scene(row) for row in range(len(found))]
    rows = []
    for number in range(scenes):
        scene = originals[number % len(originals)]
        key = f"{scene.id.key.rpartition('/')[0]}/scene_{number:06d}"
        # What all rows have in common would be packed to nearly nothing.
        caption = hashlib.shake_256(key.encode()).hexdigest(256)
        rows.append(replace(scene, id=replace(scene.id, key=key), caption=caption))
    return SceneIndex.from_scenes(rows, found.root)


def write_index(folder: Path, scenes: int, path: Path) -> None:
    """Write such an index."""
    drawn_index(folder, scenes).write(path)


def held_mb() -> float:
    """Return the memory of this process in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def timed(what: Callable[[], Any], into: dict[str, float], name: str) -> Any:
    """Return what a call returns, and note its seconds."""
    began_s = time.perf_counter()
    result = what()
    into[name] = time.perf_counter() - began_s
    return result


def measure(folder: Path, scenes: int) -> dict[str, float]:
    """Return what so many scenes cost, in seconds and MB."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as work:
        path = Path(work) / "index.parquet"
        # In a process of its own, whose memory is not this one's.
        writing = get_context("spawn").Process(target=write_index, args=(folder, scenes, path))
        writing.start()
        writing.join()
        root = SceneIndex.open(folder).root
        before_mb = held_mb()
        index = timed(lambda: SceneIndex.open(path, root=root), found, "open the index")
        options: dict[str, Any] = {"frames": "all", "pairs": "all", "fields": FIELDS}
        select = {"baseline_cm": (5, 60), "focal_mm": (18, 85), "split": "train"}
        timed(lambda: StereoPairs(index, **options, **select), found, "filter all pairs")
        pairs = timed(lambda: StereoPairs(index, **options), found, "select all pairs")
        timed(lambda: len(pairs), found, "len")
        loader = timed(lambda: pairs.loader(8, num_workers=2), found, "make a loader")
        batches = iter(loader)
        timed(lambda: next(batches), found, "first batch, 2 workers")
        found["memory of the parent, MB"] = held_mb() - before_mb
        timed(loader.state_dict, found, "state_dict")
        timed(loader.stats, found, "stats")
        batches.close()
        timed(lambda: loader.set_epoch(1), found, "set_epoch")
        batches = iter(loader)
        timed(lambda: next(batches), found, "a second epoch's first batch")
        workers = [process.pid for process in active_children() if process.pid is not None]
        found["memory of a worker of its own, MB"] = max(map(_private_mb, workers))
        batches.close()
        timed(lambda: plan_shards(index), found, "pack's plan")
    return found


def _private_mb(pid: int) -> float:
    """Return the memory that a process shares with no other, in MB."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    lines = [line.split() for line in text.splitlines() if line.startswith("Private_")]
    return sum(int(words[1]) for words in lines) / 1e3


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    columns = [measure(given.folder, scenes) for scenes in SIZES]
    print("| | " + " | ".join(f"{scenes:,} scenes" for scenes in SIZES) + " |")  # noqa: T201
    print("|---|" + "---:|" * len(SIZES))  # noqa: T201
    for name in columns[0]:
        cells = [
            f"{column[name]:.0f}" if "MB" in name else _seconds(column[name]) for column in columns
        ]
        print(f"| {name} | {' | '.join(cells)} |")  # noqa: T201


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if value >= 0.1 else f"{value * 1e3:.1f} ms"


if __name__ == "__main__":
    main()
