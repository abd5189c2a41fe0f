"""The data of the benchmarks: drawn once into a folder, and reused if complete.

Four scenes of two families are drawn. The trees `whole`, `many` and `eight` hold hard links to
their files under other keys: as many scenes as the release has, or as are open at a time in a real
epoch, without drawing for hours.
"""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from benchmarks.results import Report
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import FRAME_RATE_HZ, IMAGE_SIZE_PX
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

FAMILIES: Final = (("IPD_Gaussian", 11), ("Uniform", 12))
"""The families drawn, two scenes each, with their seeds."""

WHOLE: Final = 7754
"""The scenes of the release to train on."""
MANY: Final = 24
EIGHT: Final = 8


@dataclass(frozen=True, slots=True)
class Material:
    """The folders of the data; `prepared` makes them.

    Attributes:
        root: The folder of all data.
        size_px: Width and height of the pictures.
        frames: Frames of a scene.
        scenes: Scenes of the tree `whole`.
    """

    root: Path
    size_px: int = IMAGE_SIZE_PX
    frames: int = 81
    scenes: int = WHOLE

    @property
    def release(self) -> Path:
        """Four drawn scenes in the released layout."""
        return self.root / "release"

    @property
    def whole(self) -> Path:
        """As many scenes as the release has to train on: links, with an index."""
        return self.root / "whole"

    @property
    def many(self) -> Path:
        """24 scenes in the released layout: links, with an index."""
        return self.root / "many"

    @property
    def eight(self) -> Path:
        """Eight scenes in the released layout: links, with an index."""
        return self.root / "eight"

    @property
    def shards(self) -> Path:
        """The eight scenes in shards, one a shard, as released."""
        return self.root / "shards"


def prepared(material: Material, *, report: Report, workers: int | None = None) -> Material:
    """Draw, link, index and pack what does not exist yet.

    Args:
        material: The data to make.
        report: Called with a line about each step.
        workers: Processes that draw; None is one a core.

    Raises:
        RuntimeError: If the folder holds data of another size.
    """
    wanted = {"size_px": material.size_px, "frames": material.frames, "families": FAMILIES}
    record, text = material.root / "material.json", json.dumps(wanted)
    if record.exists() and record.read_text() != text:
        raise RuntimeError(
            f"{material.root}: holds other data ({record.read_text()}) than requested ({text}): "
            "remove it, or choose another folder with --data."
        )
    workers = workers or os.cpu_count() or 1
    for family, seed in FAMILIES:
        request = SynthRequest(
            family=family, scenes=2, size_px=material.size_px, frames=material.frames, seed=seed
        )
        report(f"drawing {family}")
        synthesise(material.release, request, workers=workers)
    for tree, scenes in ((material.many, MANY), (material.eight, EIGHT)):
        if not (tree / INDEX_NAME).exists():
            report(f"linking and indexing {tree}")
            _link(material.release, tree, scenes=scenes)
            SceneIndex.open(tree).write(tree / INDEX_NAME)
    if not (material.whole / INDEX_NAME).exists():
        report(f"linking {material.whole}")
        _link(material.release, material.whole, scenes=material.scenes)
        _index_links(material.release, material.whole, scenes=material.scenes)
    if not (material.shards / INDEX_NAME).exists():
        report(f"packing {material.shards}")
        # Each scene is larger than a byte, so it has a shard of its own.
        pack(material.eight, material.shards, target_bytes=1, workers=workers)
    record.write_text(text)
    return material


def _link(release: Path, tree: Path, *, scenes: int) -> None:
    """Make a tree of links to four scenes in turn, families alternating."""
    for number in range(scenes):
        drawn, linked = (
            root / key for root, key in zip((release, tree), _keys(number), strict=True)
        )
        linked.mkdir(parents=True, exist_ok=True)
        for file in drawn.iterdir():
            if not (linked / file.name).exists():
                os.link(file, linked / file.name)


def _keys(number: int) -> tuple[str, str]:
    """Return the keys of a drawn scene, and of the scene of links to it."""
    folder = f"train/{FAMILIES[number % 2][0]}/SynthStage"
    return f"{folder}/scene_{number // 2 % 2:06d}", f"{folder}/scene_{number // 2:06d}"


def _index_links(release: Path, tree: Path, *, scenes: int) -> None:
    """Index a tree of links: what is known of four scenes, under other keys."""
    index = SceneIndex.open(release)
    index.load_seek_tables()
    drawn = {
        str(key): replace(index.scene(row), seek_tables=index.seek_tables(row))
        for row, key in enumerate(index.column("key"))
    }

    def linked(number: int) -> Scene:
        old, key = _keys(number)
        members = {
            name: replace(member, path=member.path.replace(old, key))
            for name, member in drawn[old].members.items()
        }
        return replace(drawn[old], id=replace(drawn[old].id, key=key), members=members)

    SceneIndex.from_scenes(map(linked, range(scenes)), tree).write(tree / INDEX_NAME)


def facts(material: Material) -> dict[str, Any]:
    """Return the sizes and bit rates of the data, for the results."""
    found: dict[str, float] = {
        "size_px": material.size_px, "frames": material.frames, "scenes": 2 * len(FAMILIES),
    }  # fmt: skip
    for label, name in (("rgb", "*_rgb.mp4"), ("depth", "*_depth.mkv")):
        sizes = [file.stat().st_size for file in material.release.rglob(name)]
        mean = sum(sizes) / len(sizes)
        found[f"{label}_mb_a_frame"] = mean / material.frames / 1e6
        found[f"{label}_mbit_s"] = mean * FRAME_RATE_HZ / material.frames * 8 / 1e6
    packed = sum(file.stat().st_size for file in material.shards.glob("*.tar"))
    return found | {"shards_mb_a_scene": packed / EIGHT / 1e6}
