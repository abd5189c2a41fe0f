"""Starting and memory: imports, the command, a large index, the first batch, resuming, a worker."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.clock import in_a_fork
from benchmarks.contestants import limit
from benchmarks.material import Material
from benchmarks.results import Report, spread_of
from benchmarks.workloads import WORKLOADS, Job, Wanted
from stereogenbench_data import StereoPairs
from stereogenbench_data.index.table import SceneIndex

IMPORTS: Final = {
    "python alone": "pass",
    "import numpy": "import numpy",
    "import stereogenbench_data": "import stereogenbench_data",
    "from stereogenbench_data import SceneIndex": "from stereogenbench_data import SceneIndex",
    "import torch": "import torch",
    "from stereogenbench_data import StereoPairs": "from stereogenbench_data import StereoPairs",
}

_FIRST_BATCH: Final = """
import sys, time
began = time.time()
from pathlib import Path
from benchmarks.material import Material
from benchmarks.workloads import WORKLOADS, Job
material = Material(Path(sys.argv[1]), size_px=int(sys.argv[2]), frames=int(sys.argv[3]))
workload = next(workload for workload in WORKLOADS if workload.name == "first")
job = Job(workload, material, reading="forwards")
{choose}
batch = next(iter(loader))
print(time.time() - began)
"""
_CHOOSE: Final = {
    "ours": "from benchmarks.contestants import ours\nloader = ours.mapped(job, job.tree)",
    "naive": (
        "from torch.utils.data import DataLoader\n"
        "from benchmarks.contestants.naive import NaivePairs\n"
        "job.wanted\n"
        "began = time.time() - {torch_s}\n"
        "loader = DataLoader(NaivePairs(job), batch_size=workload.batch)"
    ),
}


def measure_start(material: Material, *, rounds: int, report: Report) -> dict[str, Any]:
    """Return the section of the results on starting."""
    report("start: imports and commands")
    imports = {name: _python("-c", code, rounds=rounds) for name, code in IMPORTS.items()}
    helps = {
        " ".join(["stereogenbench", *words]): _python(
            "-m", "stereogenbench_data.cli.main", *words, rounds=rounds
        )
        for words in (["--help"], ["index", "--help"], ["pack", "--help"])
    }
    torch_free = subprocess.run(
        [sys.executable, "-c", "import sys, stereogenbench_data; sys.exit('torch' in sys.modules)"],
        check=False,
    )
    report("start: index of 8,493 scenes")
    index = [in_a_fork(lambda: open_and_select(material)) for _ in range(rounds)]
    report("start: first batch, cold")
    first = _first_batches(material, rounds=rounds)
    report("start: resuming at half an epoch")
    resumed = [in_a_fork(lambda: _resume(material)) for _ in range(rounds)]
    return {
        "imports_s": imports,
        "commands_s": helps,
        "imports_torch": bool(torch_free.returncode),
        "index_scenes": index[0]["scenes"],
        "index_pairs": index[0]["pairs"],
        "index_open_s": spread_of(found["open_s"] for found in index),
        "index_select_s": spread_of(found["select_s"] for found in index),
        "index_both_s": spread_of(found["open_s"] + found["select_s"] for found in index),
        "first_batch_s": {name: spread_of(times) for name, times in first.items()},
        "first_batch_ratio": spread_of(
            theirs / own for own, theirs in zip(first["ours"], first["naive"], strict=True)
        ),
        "resuming": {name: spread_of(found[name] for found in resumed) for name in resumed[0]},
        "resuming_to_bare": {
            name: spread_of(found[name] / found[f"bare_{name}"] for found in resumed)
            for name in ("start_s", "resume_s")
        },
        "rounds": rounds,
    }


def _python(*words: str, rounds: int) -> dict[str, float]:
    """Return the wall time of a fresh interpreter, in seconds."""
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        times.append(time.perf_counter() - began)
    return spread_of(times)


def open_and_select(material: Material) -> dict[str, float]:
    """Return the seconds to open the full index and to select from it."""
    began = time.perf_counter()
    index = SceneIndex.open(material.full_index)
    opened = time.perf_counter()
    pairs = StereoPairs(index, split="train", family="Uniform", pairs="all")
    selected = time.perf_counter()
    return {
        "scenes": len(index), "pairs": len(pairs),
        "open_s": opened - began, "select_s": selected - opened,
    }  # fmt: skip


def _first_batches(material: Material, *, rounds: int) -> dict[str, list[float]]:
    """Return seconds from a fresh interpreter to its first batch, no file in the page cache.

    Ours opens its index. The naive loader gets its list of scenes; its time includes importing
    torch and its own modules, and not making the list.
    """
    torch_s = min(
        float(
            _printed(
                "import time; b = time.time(); import torch, av, numpy; print(time.time() - b)"
            )
        )
        for _ in range(2)
    )
    times: dict[str, list[float]] = {name: [] for name in _CHOOSE}
    for _ in range(rounds):
        for name, choose in _CHOOSE.items():
            forget_files(material.release)
            code = _FIRST_BATCH.format(choose=choose.format(torch_s=torch_s))
            words = (str(material.root), str(material.size_px), str(material.frames))
            times[name].append(float(_printed(code, *words)))
    return times


def _printed(code: str, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *words], check=True, capture_output=True, text=True
    )
    return done.stdout


def forget_files(folder: Path) -> None:
    """Ask the system to drop a folder's files from its page cache."""
    for path in folder.rglob("*"):
        if path.is_file() and hasattr(os, "posix_fadvise"):
            with path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _resume(material: Material) -> dict[str, float]:
    """Return seconds to a first batch, at the start and resumed at half an epoch.

    The epoch has the primary pairs of eight scenes. ``seek_s`` is the time to load the state.
    ``rest_from_start_s`` and ``rest_from_half_s`` are the mean times of a batch over 17 batches
    from there on. ``bare_start_s`` and ``bare_resume_s`` are the times of a bare loop that opens
    the same videos and decodes once to the frames of the same first batch.
    """
    workload = next(workload for workload in WORKLOADS if workload.name == "all-frames")
    job = Job(workload, material)
    chosen = job.selection | {"frames": "all"}

    def timed(state: dict[str, Any] | None) -> dict[str, float]:
        pairs = StereoPairs(job.tree, **chosen)
        loader = pairs.loader(workload.batch, seed=0)
        began = time.perf_counter()
        if state is not None:
            loader.load_state_dict(state)
        loaded = time.perf_counter()
        batches = iter(loader)
        batch = next(batches)
        first = time.perf_counter()
        count = 1 + sum(1 for _, _ in zip(range(16), batches, strict=False))
        ended = time.perf_counter()
        pairs.close()
        return {
            "load": loaded - began, "first": first - began, "mean": (ended - began) / count,
            "bare": _bare_s(job, _samples(batch)),
        }  # fmt: skip

    pairs = StereoPairs(job.tree, **chosen)
    loader = pairs.loader(workload.batch, seed=0)
    half = loader.batches.state_at(0, len(loader) // 2)
    next(iter(loader))  # whatever is done once a process
    pairs.close()
    start, resumed = timed(None), timed(half)
    return {
        "seek_s": resumed["load"],
        "start_s": start["first"], "bare_start_s": start["bare"],
        "resume_s": resumed["first"], "bare_resume_s": resumed["bare"],
        "rest_from_start_s": start["mean"], "rest_from_half_s": resumed["mean"],
    }  # fmt: skip


def _samples(batch: dict[str, Any]) -> list[Wanted]:
    """Return the samples of a batch."""
    return [
        Wanted(scene, int(left), int(right), (int(frame),))
        for scene, (left, right), frame in zip(
            batch["scene"], batch["pair"].tolist(), batch["frame_index"].tolist(), strict=True
        )
    ]


def _bare_s(job: Job, wanted: list[Wanted]) -> float:
    """Return the time of a bare loop that decodes each stream once, as far as needed."""
    scenes: dict[str, list[Wanted]] = {}
    for sample in sorted(wanted, key=lambda sample: sample.frames):
        scenes.setdefault(sample.scene, []).append(sample)
    began = time.perf_counter()
    for _ in limit.samples(job, scenes):
        pass
    return time.perf_counter() - began


def measure_memory(material: Material, *, batches: int, report: Report) -> dict[str, Any]:
    """Return the section of the results on a worker's memory: all pairs, default settings."""
    report(f"memory: {batches} batches")
    return in_a_fork(lambda: watch_memory(material, batches=batches, report=report))


def watch_memory(material: Material, *, batches: int, report: Report) -> dict[str, Any]:
    """Return the memory of workers in this process's loader, in megabytes after every batch."""
    workers, size = 2, 4
    pairs = StereoPairs(material.many, pairs="all", frames="all")
    loader = pairs.loader(size, num_workers=workers, seed=0)
    megabytes: list[float] = []
    private: list[float] = []
    began = time.perf_counter()
    iterator = iter(loader)
    for number, _ in zip(range(batches), iterator, strict=False):
        found = [_resident(pid) for pid in children(os.getpid())]
        megabytes.append(max(total for total, _ in found))
        private.append(max(own for _, own in found))
        if number % 100 == 99:
            seconds = (time.perf_counter() - began) / (number + 1) * (batches - number - 1)
            report(f"memory: batch {number + 1}, {megabytes[-1]:.0f} MB, {seconds:.0f} s left")
    quarter = max(1, len(megabytes) // 4)
    third, last = megabytes[-2 * quarter : -quarter] or megabytes, megabytes[-quarter:]
    growth_mb = float(np.mean(last) - np.mean(third)) / quarter * 1000
    return {
        "workers": workers, "batch": size, "batches": len(megabytes),
        "open_scenes": loader.batches.rule.open_scenes,
        "lanes": loader.batches.rule.shuffle_groups,
        "scenes": len(pairs.plan.scene_rows), "epoch_batches": len(loader),
        "peak_mb": max(megabytes), "peak_private_mb": max(private),
        "growth_mb_per_1000": growth_mb,
        "resident_mb": [round(value, 1) for value in megabytes],
        "private_mb": [round(value, 1) for value in private],
    }  # fmt: skip


def _resident(pid: int) -> tuple[float, float]:
    """Return megabytes of a process: resident memory, and the same without shared memory."""
    found = {}
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        name, _, value = line.partition(":")
        if name in ("VmRSS", "RssShmem"):
            found[name] = int(value.split()[0]) / 1000
    return found["VmRSS"], found["VmRSS"] - found["RssShmem"]


def children(pid: int) -> list[int]:
    """Return the processes that a process started."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
