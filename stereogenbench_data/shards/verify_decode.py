"""Decoding every video of packed scenes, and holding what comes against the index."""

import io
from dataclasses import dataclass
from pathlib import Path

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import MediaError, cure_of
from stereogenbench_data.media.container import StreamFacts
from stereogenbench_data.media.depth import require_depth_stream, resolve_encoding
from stereogenbench_data.media.depth_frames import DepthFrames
from stereogenbench_data.media.video import VideoReader, probe, require_pixel_aspect
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import CAMERA_COUNT, PACKED_DEPTH_NAMES, depth_name


@dataclass(frozen=True, slots=True)
class Problem:
    """What is wrong, and what to do; texts that do not apply are empty."""

    shard: str
    scene: str
    member: str
    found: str
    cure: str

    def __str__(self) -> str:
        """Return it as one line."""
        where = ": ".join(part for part in (self.shard, self.scene, self.member) if part)
        return f"{where}: {self.found}. {self.cure}".replace("\n", " ")


@dataclass(frozen=True, slots=True)
class DecodeTask:
    """Videos of one scene that are to be decoded."""

    root: str
    scene: Scene
    names: tuple[str, ...]


def video_bytes(scene: Scene) -> int:
    """Return how many bytes a scene's videos have."""
    return sum(scene.members[name].size for name in scene.held_videos)


def decode_tasks(scenes: list[Scene], root: str, sound: set[str]) -> list[DecodeTask]:
    """Return what to decode: all videos whose bytes are those that were packed."""
    tasks = []
    for scene in scenes:
        names = tuple(name for name in scene.held_videos if f"{scene.id.key}.{name}" in sound)
        if names:
            tasks.append(DecodeTask(root, scene, names))
    return tasks


def decode_scene(task: DecodeTask, after_bytes: Advance) -> list[Problem]:
    """Decode all frames of a scene's videos; return what is wrong with any."""
    problems = []
    for name in task.names:
        member = task.scene.members[name]
        try:
            _decode(task, name)
        except (MediaError, OSError) as error:
            told = str(error).removeprefix(f"{name}: ").rstrip(".")
            cure = "Pack the scene again from a video that is whole."
            if isinstance(error, OSError):
                cure = cure_of(error, cure)
            problems.append(Problem(member.path, task.scene.id.key, name, told, cure))
        after_bytes(member.size)
    return problems


def _decode(task: DecodeTask, name: str) -> None:
    """Decode all frames of a video from its place in the shard, and hold it against the index."""
    scene, member = task.scene, task.scene.members[name]
    with Path(task.root, member.path).open("rb") as shard:
        shard.seek(member.offset)
        file = io.BytesIO(shard.read(member.size))
    if name in PACKED_DEPTH_NAMES.values():
        with DepthFrames(file, name=name, frames=scene.frames) as depth:
            _require_indexed(scene, name, depth.facts)
            for index in range(scene.frames):
                depth.units(index)
        return
    _require_indexed(scene, name, probe(file, name=name))
    with VideoReader(file, name=name, frames=scene.frames) as reader:
        for index in range(scene.frames):
            _ = reader.colour_frame(index) if name.endswith("_rgb.mp4") else reader.frame(index)


def _require_indexed(scene: Scene, name: str, facts: StreamFacts) -> None:
    """Hold a video's header against the index."""
    size = (scene.rig.image_width_px, scene.rig.image_height_px)
    if (facts.frames, (facts.width_px, facts.height_px)) != (scene.frames, size):
        raise MediaError(
            f"{name}: has {facts.frames} frames of {facts.width_px}x{facts.height_px} pixels, and "
            f"by the index {scene.frames} of {size[0]}x{size[1]}."
        )
    require_pixel_aspect(facts.pixel_aspect, scene.rig, name=name)
    depth_names = [scene.held_name(depth_name(camera)) for camera in range(CAMERA_COUNT)]
    if name not in depth_names:
        return
    camera = depth_names.index(name)
    encoding = resolve_encoding(facts, name=name)
    found = (facts.codec, facts.pixel_format, encoding.known_unit_m)
    told = (
        scene.depth_codec[camera],
        scene.depth_pixel_format[camera],
        scene.depth_unit_m[camera],
    )
    if found != told:
        raise MediaError(f"{name}: is stored as {found}, and by the index as {told}.")
    require_depth_stream(
        codec=facts.codec, pixel_format=facts.pixel_format, encoding=encoding, name=name
    )
