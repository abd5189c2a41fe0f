"""Where an epoch's time goes: spans around the package's own functions, timed in one worker.

The package is not changed: in the measuring process, timed functions replace its own. The time of a
span excludes that of the spans inside it. What a worker does beside making batches (handing them
over, waiting for a free buffer) is "queueing".
"""

import functools
import statistics
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import torch

from benchmarks.clock import in_a_fork
from benchmarks.contestants import ours
from benchmarks.material import Material
from benchmarks.results import Report
from benchmarks.workloads import WORKLOADS, Job

Label = Callable[..., str]

PROFILED: Final = ("all-frames", "all-pairs-832")

LABELS: Final = (
    "opening", "reading", "demuxing", "decoding depth", "decoding colour", "checking",
    "colour conversion", "depth to units", "geometry", "glue", "collation", "queueing",
)  # fmt: skip


def _decoding(decoder: Any, *_: Any) -> str:
    is_depth = decoder._context.codec.canonical_name == "ffv1"
    return "decoding depth" if is_depth else "decoding colour"


def _depth(reader: Any, *_: Any) -> str:
    return "decoding depth" if type(reader).__name__ == "DepthFrames" else "depth to units"


_SPANS: Final[tuple[tuple[str, str, str | Label], ...]] = (
    ("stereogenbench_data.media.video", "VideoReader.__init__", "opening"),
    ("stereogenbench_data.sources.ranged_file", "FileSlice.read", "reading"),
    ("stereogenbench_data.media.decoder", "Decoder._pull", "demuxing"),
    ("stereogenbench_data.media.decoder", "Decoder._feed", _decoding),
    ("stereogenbench_data.media.decoder", "Decoder._register", "checking"),
    ("stereogenbench_data.samples.streams", "read_rgb", "colour conversion"),
    ("stereogenbench_data.samples.streams", "read_depth_units", _depth),
    ("stereogenbench_data.samples.writer", "SampleWriter.write", "geometry"),
    ("stereogenbench_data.datasets.batch_buffers", "collate", "collation"),
    ("torch.utils.data._utils.fetch", "_MapDatasetFetcher.fetch", "glue"),
)
"""Module, name, and what its time is called: what is replaced."""


class Spans:
    """Time by label, in memory that a worker process shares."""

    def __init__(self) -> None:
        """Start at zero."""
        self.totals_s = torch.zeros(len(LABELS), dtype=torch.float64).share_memory_()
        self._inside: list[float] = []

    def around(self, work: Callable[..., Any], label: str | Label) -> Callable[..., Any]:
        """Return a function that does the same and records its time."""

        @functools.wraps(work, updated=())
        def timed(*values: Any, **named: Any) -> Any:
            self._inside.append(0.0)
            began = time.perf_counter()
            try:
                return work(*values, **named)
            finally:
                took = time.perf_counter() - began
                name = label if isinstance(label, str) else label(*values)
                self.totals_s[LABELS.index(name)] += took - self._inside.pop()
                if self._inside:
                    self._inside[-1] += took

        return timed

    def install(self) -> list[str]:
        """Replace the functions; return the names of those that do not exist."""
        missing = []
        for module, path, label in _SPANS:
            owner: Any = import_module(module)
            *outer, name = path.split(".")
            for part in outer:
                owner = getattr(owner, part, None)
            if getattr(owner, name, None) is None:
                missing.append(f"{module}.{path}")
            else:
                setattr(owner, name, self.around(getattr(owner, name), label))
        return missing


def measure_profile(material: Material, *, rounds: int, report: Report) -> dict[str, Any]:
    """Return the section of the results: milliseconds a sample by label, for some workloads."""
    found = {}
    for workload in WORKLOADS:
        if workload.name in PROFILED:
            job = Job(workload, material)
            sources = {
                "files": job.tree, "shards": material.shards, "blosc2 shards": material.blosc2,
            }  # fmt: skip
            for source, data in sources.items():
                if not data.exists():
                    continue
                report(f"profile: {workload.name} from {source}")
                runs = [in_a_fork(functools.partial(profiled, job, data)) for _ in range(rounds)]
                found[f"{workload.name} from {source}"] = {
                    "title": workload.title,
                    "missing": runs[0]["missing"],
                    "ms_a_sample": {
                        label: statistics.median(run["ms"][label] for run in runs)
                        for label in LABELS
                    },
                }
    return found


def profiled(job: Job, data: Path) -> dict[str, Any]:
    """Return milliseconds a sample by label for a workload in one worker, and missing functions."""
    torch.set_num_threads(1)
    spans = Spans()
    missing = spans.install()
    started = torch.zeros(1, dtype=torch.float64).share_memory_()

    def note_start(_: int) -> None:
        torch.set_num_threads(1)
        started[0] = time.perf_counter()

    loader = ours.mapped(job, data, num_workers=1, worker_init_fn=note_start)
    samples = sum(len(batch["scene"]) for batch in loader)
    total_s = time.perf_counter() - float(started[0])
    ms = dict(zip(LABELS, (spans.totals_s / samples * 1000).tolist(), strict=True))
    ms["queueing"] = total_s / samples * 1000 - sum(ms.values())
    return {"ms": ms, "missing": missing}
