"""The data that is measured on: drawn once into a folder, kept, and used again if whole.

Four scenes of two families are drawn. The trees `many` and `eight` hold hard links to their files
under other keys: as many scenes open at a time as in a real epoch, without drawing for hours.
"""

import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.schema.records import Member, Scene, SceneId
from stereogenbench_data.schema.release import IMAGE_SIZE_PX, SEEN_MAP_FOLDER
from stereogenbench_data.storage.index import INDEX_NAME, SceneIndex
from stereogenbench_data.synthesis import SynthRequest, synthesise

Say = Callable[[str], None]

FAMILIES: Final = (("IPD_Gaussian", 11), ("Uniform", 12))
"""The families drawn, two scenes each, with their seeds."""

MANY: Final = 64
EIGHT: Final = 8

_RELEASED: Final = (
    ("train", None, "IPD_Gaussian", 3289),
    ("train", None, "Uniform", 774),
    ("train", None, "Pairwise_Uniform", 3691),
    ("eval", "seen_map", "IPD_Gaussian", 265),
    ("eval", "seen_map", "Uniform", 281),
    ("eval", "unseen_map", "IPD_Gaussian", 91),
    ("eval", "unseen_map", "Uniform", 102),
)
"""Split, subset, family and number of scenes, as the paper counts them: 8,493 in all."""


@dataclass(frozen=True, slots=True)
class Material:
    """Where the data lie; `prepared` makes them.

    Attributes:
        root: The folder of all of them.
        size_px: Width and height of the pictures.
        frames: Frames of a scene.
        scale: Share of the many scenes, and of the full index's; below 1 for tests.
    """

    root: Path
    size_px: int = IMAGE_SIZE_PX
    frames: int = 81
    scale: float = 1.0

    @property
    def release(self) -> Path:
        """Four drawn scenes in the released layout."""
        return self.root / "release"

    @property
    def many(self) -> Path:
        """64 scenes in the released layout: links, with an index."""
        return self.root / "many"

    @property
    def eight(self) -> Path:
        """Eight scenes in the released layout: links, with an index."""
        return self.root / "eight"

    @property
    def shards(self) -> Path:
        """The eight scenes in shards, one a shard, as released."""
        return self.root / "shards"

    @property
    def blosc2(self) -> Path:
        """The eight scenes in shards with depth as blosc2 frames; absent if that cannot be made."""
        return self.root / "blosc2"

    @property
    def full_index(self) -> Path:
        """An index with as many scenes as the release has."""
        return self.root / "full" / INDEX_NAME


def can_pack_blosc2() -> bool:
    """Return whether this version packs depth as blosc2 frames."""
    from stereogenbench_data.cli.pack import pack

    return "depth_codec" in inspect.signature(pack).parameters


def prepared(material: Material, *, say: Say, workers: int | None = None) -> Material:
    """Draw, link, index and pack what is not there yet.

    Args:
        material: What is wanted, and where.
        say: Is told what is being done.
        workers: Processes that draw; None is one a core.

    Raises:
        RuntimeError: If the folder holds data of another size, or packing failed.
    """
    wanted = {"size_px": material.size_px, "frames": material.frames, "families": FAMILIES}
    note, text = material.root / "material.json", json.dumps(wanted)
    if note.exists() and note.read_text() != text:
        raise RuntimeError(
            f"{material.root}: holds other data ({note.read_text()}) than asked for ({text}): "
            "remove it, or choose another folder with --data."
        )
    _draw(material, say=say, workers=workers or os.cpu_count() or 1)
    _link(material.release, material.many, scenes=max(EIGHT, round(MANY * material.scale)))
    _link(material.release, material.eight, scenes=EIGHT)
    for tree in (material.many, material.eight):
        if not (tree / INDEX_NAME).exists():
            say(f"indexing {tree}")
            SceneIndex.open(tree).write(tree / INDEX_NAME)
    _pack(material.eight, material.shards, say=say)
    if can_pack_blosc2():
        _pack(material.eight, material.blosc2, say=say, options=("--depth-codec", "blosc2"))
    if not material.full_index.exists():
        say("writing an index of as many scenes as the release has")
        _write_full_index(material)
    note.write_text(text)
    return material


def _draw(material: Material, *, say: Say, workers: int) -> None:
    for family, seed in FAMILIES:
        request = SynthRequest(
            family=family, scenes=2, size_px=material.size_px, frames=material.frames, seed=seed
        )
        told = -1

        def progress(done: int, total: int, family: str = family) -> None:
            nonlocal told
            if done * 20 // total > told:
                told = done * 20 // total
                say(f"drawing {family}: {done} of {total} frames")

        synthesise(material.release, request, workers=workers, progress=progress)


def _link(release: Path, tree: Path, *, scenes: int) -> None:
    """Make a tree of links to four scenes in turn, families alternating."""
    for number in range(scenes):
        family, _ = FAMILIES[number % 2]
        drawn = release / "train" / family / "SynthStage" / f"scene_{number // 2 % 2:06d}"
        linked = tree / "train" / family / "SynthStage" / f"scene_{number // 2:06d}"
        linked.mkdir(parents=True, exist_ok=True)
        for file in drawn.iterdir():
            if not (linked / file.name).exists():
                os.link(file, linked / file.name)


def _pack(tree: Path, out: Path, *, say: Say, options: tuple[str, ...] = ()) -> None:
    if (out / INDEX_NAME).exists():
        return
    say(f"packing {out}")
    sizes = [
        sum(file.stat().st_size for file in scene.parent.iterdir())
        for scene in tree.rglob("baseline.json")
    ]
    size = f"{max(sizes) * 101 // 100_000_000 + 1}MB"
    command = [sys.executable, "-m", "stereogenbench_data.cli.main", "pack"]
    done = subprocess.run(
        [*command, str(tree), str(out), "--shard-size", size, *options],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"packing {out} failed: {done.stderr[-1000:]}")


def _write_full_index(material: Material) -> None:
    """Write an index of as many scenes as the release has, with the drawn scenes' numbers."""
    index = SceneIndex.open(material.eight)
    drawn = [index.scene(row) for row in range(len(index))]
    scenes = []
    for split, subset, family, count in _RELEASED:
        folder = {"seen_map": SEEN_MAP_FOLDER, "unseen_map": "MapUnseenInTrain", None: ""}[subset]
        for number in range(max(1, round(count * material.scale))):
            place = "/".join(filter(None, (split, folder, family, f"Map_{number % 19:02d}")))
            key = f"{place}/scene_{number:06d}"
            name = SceneId(key, split, subset, family, f"Map_{number % 19:02d}")
            scenes.append(_moved(drawn[number % len(drawn)], name, number=number))
    material.full_index.parent.mkdir(parents=True, exist_ok=True)
    SceneIndex.from_scenes(scenes, material.full_index.parent).write(material.full_index)


def _moved(scene: Scene, name: SceneId, *, number: int) -> Scene:
    """Return a scene under another key, every number slightly its own."""
    members = {
        file: Member(f"{name.key}/{file}", 0, member.size + number)
        for file, member in scene.members.items()
    }
    return replace(
        scene,
        id=name,
        caption=f"{scene.caption} Number {number}.",
        members=members,
        lateral_m=tuple(position * (1 + number * 1e-6) for position in scene.lateral_m),
    )


def facts(material: Material) -> dict[str, Any]:
    """Return what the results say of the data: sizes and bit rates."""
    seconds = material.frames / 15
    scenes = sorted(path.parent for path in material.release.rglob("baseline.json"))
    megabytes: dict[str, float] = {}
    for label, pattern in (("rgb", "*_rgb.mp4"), ("depth", "*_depth.mkv")):
        sizes = [file.stat().st_size for scene in scenes for file in scene.glob(pattern)]
        megabytes[f"{label}_mb_a_frame"] = sum(sizes) / len(sizes) / material.frames / 1e6
        megabytes[f"{label}_mbit_s"] = sum(sizes) / len(sizes) / seconds * 8 / 1e6
    packed = {
        f"{label}_mb_a_scene": sum(file.stat().st_size for file in folder.glob("*.tar"))
        / EIGHT
        / 1e6
        for label, folder in (("shards", material.shards), ("blosc2", material.blosc2))
        if folder.exists()
    }
    sizes = {"size_px": material.size_px, "frames": material.frames, "scenes": len(scenes)}
    return sizes | megabytes | packed
