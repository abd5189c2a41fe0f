"""The release on the Hub without an index: ``python -m benchmarks.hub``.

A server of this machine answers as the Hub does, 60 ms away, for a tree of the release's 8,493
scenes: hard links to the files of one drawn scene. Measured are the first batch of the evaluation
scenes of family Uniform, and an epoch of 200 scenes beside one with an index, each with an empty
cache folder; requests are counted by the server.
"""

import argparse
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import fsspec

from benchmarks.server import REPOSITORY, Network, serving
from stereogenbench_data import StereoPairs
from stereogenbench_data.index.build import walk
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.index.tree import CACHE_VARIABLE
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

HUB: Final = f"hf://datasets/{REPOSITORY}@main"
_FAMILIES: Final = {
    "train/IPD_Gaussian": 3289,
    "train/Uniform": 774,
    "train/Pairwise_Uniform": 3691,
    "eval/MapSeenInTrain/IPD_Gaussian": 265,
    "eval/MapSeenInTrain/Uniform": 281,
    "eval/MapUnseenInTrain/IPD_Gaussian": 91,
    "eval/MapUnseenInTrain/Uniform": 102,
}
_MAPS: Final = 20
_EPOCH: Final[dict[str, Any]] = {"family": "Uniform", "split": "eval", "frames": "all"}


def prepare(root: Path, *, size_px: int, frames: int) -> None:
    """Write the tree, unless it is there."""
    if (root / "train").is_dir():
        return
    drawn = root.with_name("drawn")
    request = SynthRequest(family="Uniform", scenes=1, size_px=size_px, frames=frames, seed=6)
    synthesise(drawn, request, workers=1)
    (source,) = drawn.glob("train/Uniform/*/*")
    for family, count in _FAMILIES.items():
        for number in range(count):
            scene = root / family / f"Map_{number % _MAPS:02d}" / f"scene_{number:06d}"
            scene.mkdir(parents=True)
            for file in source.iterdir():
                os.link(file, scene / file.name)


def measured(root: Path, *, scenes: int, workers: int, delay_ms: float) -> dict[str, float]:
    """Return seconds and requests, by what was done."""
    found: dict[str, float] = {}
    with (
        tempfile.TemporaryDirectory() as cache,
        serving(root, network=Network(delay_ms / 1e3), kind="hub") as server,
    ):
        fsspec.config.conf["hf"] = {"endpoint": server.url, "token": False}
        os.environ[CACHE_VARIABLE] = cache

        def run(name: str, pairs: StereoPairs, began_s: float) -> None:
            loader = pairs.loader(8, num_workers=workers, seed=0)
            for number, _ in enumerate(loader):
                if number == 0:
                    found[f"{name}: s to the first batch"] = time.monotonic() - began_s
                    found[f"{name}: requests to it"] = server.counts().requests - before
            found[f"{name}: s"] = time.monotonic() - began_s
            found[f"{name}: requests"] = server.counts().requests - before
            print(json.dumps(found), flush=True)  # noqa: T201 - the command's result

        before, began_s = server.counts().requests, time.monotonic()
        run("eval Uniform, first frames", StereoPairs(HUB, **_EPOCH | {"frames": "first"}), began_s)
        shutil.rmtree(Path(cache, "trees"))
        before, began_s = server.counts().requests, time.monotonic()
        pairs = StereoPairs(HUB, **_EPOCH)
        keys = pairs.index.column("key")[:scenes].tolist()
        shutil.rmtree(Path(cache, "trees"))
        before, began_s = server.counts().requests, time.monotonic()
        run("epoch without an index", StereoPairs(HUB, **_EPOCH | {"scenes": keys}), began_s)
        chosen = set(keys)
        report = walk(root, wanted=lambda scene: scene.key in chosen, workers=1)
        path = Path(cache, "index.parquet")
        SceneIndex.from_report(report).write(path)
        index = SceneIndex.open(path, root=HUB)
        before, began_s = server.counts().requests, time.monotonic()
        run("epoch with an index", StereoPairs(index, **_EPOCH), began_s)
    return found


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hub", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("build", "hub", "release"))
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--frames", type=int, default=81)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--delay-ms", type=float, default=60.0)
    options = parser.parse_args()
    prepare(options.data, size_px=options.size, frames=options.frames)
    found = measured(
        options.data, scenes=options.scenes, workers=options.workers, delay_ms=options.delay_ms
    )
    print(json.dumps(found, indent=2))  # noqa: T201 - the command's result


if __name__ == "__main__":
    main()
