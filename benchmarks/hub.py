"""The release on the Hub without an index: ``python -m benchmarks.hub``.

A server of this machine answers as the Hub does, 60 ms away, for a tree of the release's 8,493
scenes: hard links to the files of one drawn scene. Measured are the first batch of the evaluation
scenes of family Uniform, and an epoch of 200 scenes beside one with an index, each with an empty
cache folder; the server counts requests.
"""

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
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
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
_SCENES: Final = 200
"""Scenes of an epoch."""
_DELAY_S: Final = 0.06


def prepare(root: Path) -> None:
    """Write the tree, unless it is there."""
    if (root / "train").is_dir():
        return
    drawn = root.with_name("drawn")
    synthesise(drawn, SynthRequest(family="Uniform", scenes=1, size_px=256, seed=6), workers=1)
    (source,) = drawn.glob("train/Uniform/*/*")
    for family, count in _FAMILIES.items():
        for number in range(count):
            scene = root / family / f"Map_{number % _MAPS:02d}" / f"scene_{number:06d}"
            scene.mkdir(parents=True)
            for file in source.iterdir():
                os.link(file, scene / file.name)


def measured(root: Path) -> None:
    """Print seconds and requests, by what was done."""
    found: dict[str, float] = {}
    with (
        tempfile.TemporaryDirectory() as cache,
        serving(root, network=Network(_DELAY_S), kind="hub") as server,
    ):
        fsspec.config.conf["hf"] = {"endpoint": server.url, "token": False}
        os.environ[CACHE_VARIABLE] = cache

        def run(name: str, data: str | SceneIndex, **selection: Any) -> StereoPairs:
            before, began_s = server.counts().requests, time.monotonic()
            pairs = StereoPairs(data, family="Uniform", split="eval", **selection)
            for number, _ in enumerate(pairs.loader(8, num_workers=2, seed=0)):
                if number == 0:
                    found[f"{name}: s to the first batch"] = time.monotonic() - began_s
                    found[f"{name}: requests to it"] = server.counts().requests - before
            found[f"{name}: s"] = time.monotonic() - began_s
            found[f"{name}: requests"] = server.counts().requests - before
            print(json.dumps(found, indent=2), flush=True)  # noqa: T201 - the command's result
            shutil.rmtree(Path(cache, "trees"), ignore_errors=True)
            return pairs

        pairs = run("eval Uniform, first frames", HUB, frames="first")
        keys = pairs.index.column("key")[:_SCENES].tolist()
        run("epoch without an index", HUB, frames="all", scenes=keys)
        path = Path(cache, "index.parquet")
        report = walk(root, wanted=lambda scene: scene.key in keys, workers=1)
        SceneIndex.from_report(report).write(path)
        run("epoch with an index", SceneIndex.open(path, root=HUB), frames="all")


if __name__ == "__main__":
    place = Path("build", "hub", "release")
    prepare(place)
    measured(place)
