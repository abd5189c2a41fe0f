"""The data of the benchmarks: drawn once into a folder, and reused if complete.

Four scenes of two families are drawn. The trees `many` and `eight` hold hard links to their files
under other keys: as many scenes open at a time as in a real epoch, without drawing for hours.

Four of them are encoded again at lower bit rates, with links to their depth: the gain of a faster
depth codec depends on the cost of decoding the pictures, and that on their bit rate.
"""

import json
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import av

from benchmarks.results import Report
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Member, Scene, SceneId
from stereogenbench_data.schema.release import FRAME_RATE_HZ, IMAGE_SIZE_PX, SEEN_MAP_FOLDER
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.plan import DepthCodec
from stereogenbench_data.synthesis import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

FAMILIES: Final = (("IPD_Gaussian", 11), ("Uniform", 12))
"""The families drawn, two scenes each, with their seeds."""

DRAWN_CRF: Final = 18
"""The constant rate factor of the drawn pictures."""

OTHER_CRFS: Final = (26, 34)
"""Those of the trees made here."""

MANY: Final = 64
EIGHT: Final = 8
FOUR: Final = 4

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
    """The folders of the data; `prepared` makes them.

    Attributes:
        root: The folder of all data.
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

    def at_rate(self, crf: int) -> "Material":
        """Return the same pictures at another constant rate factor: four scenes, not eight."""
        return self if crf == DRAWN_CRF else replace(self, root=self.root / f"crf{crf}")

    @property
    def full_index(self) -> Path:
        """An index with as many scenes as the release has."""
        return self.root / "full" / INDEX_NAME


def can_pack_blosc2() -> bool:
    """Return whether depth can be packed as blosc2 frames here."""
    return find_spec("blosc2") is not None


def prepared(
    material: Material,
    *,
    report: Report,
    workers: int | None = None,
    crfs: tuple[int, ...] = OTHER_CRFS,
) -> Material:
    """Draw, link, index and pack what does not exist yet.

    Args:
        material: The data to make.
        report: Called with a line about each step.
        workers: Processes that draw; None is one a core.
        crfs: Further constant rate factors of the pictures.

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
    _draw(material, report=report, workers=workers)
    _link(material.release, material.many, scenes=max(EIGHT, round(MANY * material.scale)))
    _index(material.many, report=report)
    _link(material.release, material.eight, scenes=EIGHT)
    _index_and_pack(material, report=report, workers=workers)
    for crf in crfs:
        other = material.at_rate(crf)
        _reencode_tree(material.release, other.release, crf=crf, workers=workers, report=report)
        _link(other.release, other.eight, scenes=FOUR)
        _index_and_pack(other, report=report, workers=workers)
    if not material.full_index.exists():
        report("writing an index of as many scenes as the release has")
        _write_full_index(material)
    record.write_text(text)
    return material


def _draw(material: Material, *, report: Report, workers: int) -> None:
    for family, seed in FAMILIES:
        request = SynthRequest(
            family=family, scenes=2, size_px=material.size_px, frames=material.frames, seed=seed
        )
        shown = -1

        def progress(done: int, total: int, family: str = family) -> None:
            nonlocal shown
            if done * 20 // total > shown:
                shown = done * 20 // total
                report(f"drawing {family}: {done} of {total} frames")

        synthesise(material.release, request, workers=workers, progress=progress)


def _reencode_tree(release: Path, tree: Path, *, crf: int, workers: int, report: Report) -> None:
    """Make a tree like another, with the pictures at another constant rate factor.

    All other files are hard links. Existing files are kept.

    Args:
        release: The tree to encode again, in the released layout.
        tree: The new tree.
        crf: The constant rate factor; all other settings are x264's defaults, as in the drawn tree.
        workers: Processes that encode, one thread each.
        report: Called with a line about each step.
    """
    todo = []
    for file in sorted(path for path in release.rglob("scene_*/*") if path.is_file()):
        made = tree / file.relative_to(release)
        made.parent.mkdir(parents=True, exist_ok=True)
        if made.exists():
            continue
        if file.suffix == ".mp4":
            todo.append((file, made))
        else:
            os.link(file, made)
    if not todo:
        return
    report(f"encoding {len(todo)} videos at rate factor {crf}")
    with ProcessPoolExecutor(workers) as pool:
        running = [pool.submit(_reencode, file, made, crf=crf) for file, made in todo]
        for encoded in running:
            encoded.result()


def _reencode(file: Path, made: Path, *, crf: int) -> None:
    """Encode an H.264 video again at another constant rate factor; leave no partial file."""
    part = made.with_name(f"{made.name}.part")
    options = {"crf": str(crf), "x264-params": "cpu-independent=1"}
    with (
        av.open(file) as source,
        av.open(part, "w", format="mp4", container_options={"fflags": "+bitexact"}) as target,
    ):
        stream = target.add_stream("libx264", rate=int(FRAME_RATE_HZ), options=options)
        video = source.streams.video[0]
        stream.width, stream.height, stream.pix_fmt = video.width, video.height, "yuv420p"
        stream.codec_context.thread_count = 1
        for number, decoded in enumerate(source.decode(video)):
            frame = decoded.reformat(format="yuv420p")
            frame.pts, frame.time_base = number, Fraction(1, int(FRAME_RATE_HZ))
            frame.pict_type = av.video.frame.PictureType.NONE  # the encoder's own choice
            target.mux(stream.encode(frame))
        target.mux(stream.encode(None))
    part.replace(made)


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


def _index(tree: Path, *, report: Report) -> None:
    if not (tree / INDEX_NAME).exists():
        report(f"indexing {tree}")
        SceneIndex.open(tree).write(tree / INDEX_NAME)


def _index_and_pack(material: Material, *, report: Report, workers: int) -> None:
    _index(material.eight, report=report)
    _pack(material.eight, material.shards, report=report, workers=workers)
    if can_pack_blosc2():
        _pack(material.eight, material.blosc2, report=report, workers=workers, depth_codec="blosc2")


def _pack(
    tree: Path, out: Path, *, report: Report, workers: int, depth_codec: DepthCodec = "released"
) -> None:
    """Pack a tree, one scene a shard."""
    if (out / INDEX_NAME).exists():
        return
    report(f"packing {out}")
    sizes = [
        sum(file.stat().st_size for file in scene.parent.iterdir())
        for scene in tree.rglob("baseline.json")
    ]
    target_bytes = (max(sizes) * 101 // 100_000_000 + 1) * 1_000_000
    pack(tree, out, target_bytes=target_bytes, depth_codec=depth_codec, workers=workers)


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
    """Return a scene under another key, with slightly different numbers."""
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
    """Return the sizes and bit rates of the data, for the results."""
    sizes = {"size_px": material.size_px, "frames": material.frames, "scenes": 2 * len(FAMILIES)}
    others = {
        str(crf): _rates(material.at_rate(crf), scenes=FOUR)
        for crf in OTHER_CRFS
        if material.at_rate(crf).release.exists()
    }
    return sizes | _rates(material, scenes=EIGHT) | {"other_rates": others}


def _rates(material: Material, *, scenes: int) -> dict[str, float]:
    """Return megabytes a frame, megabits a second of a camera, and megabytes a packed scene."""
    seconds = material.frames / FRAME_RATE_HZ
    found: dict[str, float] = {}
    for label, name in (("rgb", "*_rgb.mp4"), ("depth", "*_depth.mkv")):
        sizes = [file.stat().st_size for file in material.release.rglob(name)]
        mean = sum(sizes) / len(sizes)
        found[f"{label}_mb_a_frame"] = mean / material.frames / 1e6
        found[f"{label}_mbit_s"] = mean / seconds * 8 / 1e6
    for label, folder in (("shards", material.shards), ("blosc2", material.blosc2)):
        if folder.exists():
            packed = sum(file.stat().st_size for file in folder.glob("*.tar"))
            found[f"{label}_mb_a_scene"] = packed / scenes / 1e6
    return found
