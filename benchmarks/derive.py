"""All pairs of a moment: made where it is decoded, or shipped as views and made where they train.

Processor time and bytes are of one moment of six cameras, with all its 15 pairs and every mask. The
rate on a GPU stands beside the rate at which its memory could be read and written once: the views
in, the pairs out. That limit is measured, by copying as many bytes.
"""

import functools
import resource
import time
from collections.abc import Callable, Iterable
from typing import Any, Final

import torch

from benchmarks.clock import in_a_fork
from benchmarks.material import Material
from benchmarks.results import Report
from stereogenbench_data import DERIVE_FIELDS, SceneViews, StereoPairs, derive
from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.samples.decoder import SampleDecoder
from stereogenbench_data.samples.request import parse_request

MAPS: Final = (
    "disparity", "disparity_right", "valid", "valid_right", "visible", "visible_right",
    "warped_right", "hole",
)  # fmt: skip
PICTURES: Final = ("left", "right")

SIZES: Final[dict[str, tuple[int, int] | None]] = {"as stored": None, "832x480": (480, 832)}

MARK: Final = 1.1
"""The processor time of shipping views, as a multiple of decoding them."""

_FRAMES: Final = (0, 1, 2, 3)
_ROUNDS: Final = 20


def measure_derive(material: Material, *, rounds: int, report: Report) -> dict[str, Any]:
    """Return the section of the results: seconds and bytes a moment, by size and way."""
    found: dict[str, Any] = {}
    for title, size in SIZES.items():
        ways: dict[str, Callable[[], dict[str, float]]] = {
            "decoding alone": functools.partial(_decoded, material.shards, size),
            "views and stored depth": functools.partial(_shipped, material.shards, size),
            "15 pairs in the loader": functools.partial(_paired, material.shards, size),
            "15 pairs of views, on the processor": functools.partial(_derived, material, size),
        }
        rows: dict[str, dict[str, float]] = {}
        for name, way in ways.items():
            report(f"derive: {name}, {title}")
            runs = [in_a_fork(way) for _ in range(rounds)]
            rows[name] = min(runs, key=lambda run: run["cpu_s"])
        found[title] = {"ways": rows, "gpu": None}
        if torch.cuda.is_available():
            report(f"derive: on the GPU, {title}")
            # Not in a fork: CUDA does not survive one. No measurement above has touched it.
            found[title]["gpu"] = on_gpu(_batch(material, size), report=report)
    return found


def _decoded(data: Data, size: tuple[int, int] | None) -> dict[str, float]:
    """Return the cost of decoding the views of a moment, and nothing else."""
    moments = SceneViews(data, frames=_FRAMES, size=size, fields=("image", "stored_depth"))
    request = parse_request(
        "views", "stacked", fields=("image", "stored_depth"), size=size, depth=None, transform=None
    )
    decoder = SampleDecoder(moments.index, request)
    addresses = [moments.plan.locate(number, epoch=0) for number in range(len(moments))]

    def decode_all() -> Iterable[dict[str, Any]]:
        for address in addresses:
            views, _ = decoder.decode(address, frames=slice(0, 1), out={})
            depths = [depth.units for depth in views.depths.values()]
            yield dict(enumerate([*views.pictures.values(), *depths]))

    return _cost(decode_all(), moments=len(moments))


def _shipped(data: Data, size: tuple[int, int] | None) -> dict[str, float]:
    """Return the cost of loading moments as views with stored depth."""
    moments = SceneViews(data, frames=_FRAMES, size=size, fields=DERIVE_FIELDS)
    return _cost(moments.loader(1, order="sequential"), moments=len(moments))


def _paired(data: Data, size: tuple[int, int] | None) -> dict[str, float]:
    """Return the cost of loading all pairs of moments, with every map."""
    pairs = StereoPairs(data, pairs="all", frames=_FRAMES, size=size, fields=(*PICTURES, *MAPS))
    return _cost(pairs.loader(15, order="sequential"), moments=len(pairs) // 15)


def _derived(material: Material, size: tuple[int, int] | None) -> dict[str, float]:
    """Return the cost of deriving all pairs of a moment with one thread of a processor."""
    batch = _batch(material, size)
    return _cost((derive(batch, fields=(*PICTURES, *MAPS)) for _ in range(3)), moments=3)


def _batch(material: Material, size: tuple[int, int] | None) -> dict[str, Any]:
    moments = SceneViews(material.shards, frames=_FRAMES, size=size, fields=DERIVE_FIELDS)
    return next(iter(moments.loader(1, order="sequential")))


def _cost(batches: Iterable[dict[Any, Any]], *, moments: int) -> dict[str, float]:
    """Return processor seconds and bytes of arrays a moment."""
    torch.set_num_threads(1)
    size_bytes = 0
    before = resource.getrusage(resource.RUSAGE_SELF)
    for batch in batches:
        size_bytes += _bytes(batch)
    after = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu_s": cpu_s / moments, "bytes": size_bytes / moments}


def _bytes(batch: dict[Any, Any]) -> int:
    return sum(getattr(value, "nbytes", 0) for value in batch.values())


def on_gpu(batch: dict[str, Any], *, report: Report) -> dict[str, Any]:
    """Return moments a second on a GPU, eager and compiled, and the limit of its memory.

    Args:
        batch: Views of moments.
        report: Takes a line about a failure.
    """
    moved = {
        name: value.cuda() if isinstance(value, torch.Tensor) else value
        for name, value in batch.items()
    }
    work = functools.partial(derive, fields=MAPS)
    made = work(moved)
    traffic_bytes = _bytes(moved) + _bytes(made)
    source = torch.empty(traffic_bytes // 2, dtype=torch.uint8, device="cuda")
    target = torch.empty_like(source)
    count = len(moved["camera"])
    rates = {
        "device": torch.cuda.get_device_name(),
        "bytes": traffic_bytes / count,
        "limit": count / _gpu_s(lambda: target.copy_(source)),
        "eager": count / _gpu_s(lambda: work(moved)),
    }
    try:
        compiled = torch.compile(work, fullgraph=True)
        rates["compiled"] = count / _gpu_s(lambda: compiled(moved))
    except RuntimeError as error:
        report(f"derive: torch.compile failed: {error}")
    return rates


def _gpu_s(work: Callable[[], object]) -> float:
    """Return the seconds of a run on a GPU, the mean of several after warming up."""
    for _ in range(3):
        work()
    torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(_ROUNDS):
        work()
    torch.cuda.synchronize()
    return (time.perf_counter() - began) / _ROUNDS
