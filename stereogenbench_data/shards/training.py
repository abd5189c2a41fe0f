"""Scenes derived for training: pictures and depth at one size, decoded fast, their error measured.

A derived scene has the released metadata, pictures encoded at training size with short runs between
key frames, depth of the nearest pixels without loss, and ``training.json``, which says all that. It
needs no source any more. The files of a scene are made in a folder beside the shards; its
``training.json`` is written last, so a killed run continues after the last whole scene.
"""

import importlib.metadata
import io
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from PIL import features

from stereogenbench_data.engine import Advance, no_advance
from stereogenbench_data.errors import MediaError, SchemaError, ShardError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.container import VideoFile
from stereogenbench_data.media.depth import packed_depth
from stereogenbench_data.media.depth_frames import blosc2_module
from stereogenbench_data.media.encoder import (
    QUALITIES,
    Quality,
    measured_error,
    require_encodable,
    write_pictures,
)
from stereogenbench_data.media.video import VideoReader, probe, read_rgb, require_indexed_picture
from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    FRAME_RATE_HZ,
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    RELEASED_NAMES,
    TRAINING_JSON,
    depth_name,
    rgb_name,
)
from stereogenbench_data.schema.training import FORMAT
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.members import MemberSource

_LARGEST_DENOMINATOR: Final = 100_000
_DEPTH_BITS_A_PIXEL: Final = 1.5
_FIXED_BYTES: Final = 8192


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """What training shards hold.

    Attributes:
        size: (height, width) of pictures and depth in pixels.
        quality: How pictures are encoded, a name of `QUALITIES`.
        cameras: The cameras to keep; None keeps those that each scene has.
        depth: Whose ``accept`` names what source depth may lack.
    """

    size: tuple[int, int]
    quality: Quality = "balanced"
    cameras: tuple[int, ...] | None = None
    depth: DepthEncoding = field(default_factory=DepthEncoding)

    def __post_init__(self) -> None:
        """Refuse what cannot be stored.

        Raises:
            MediaError: If the quality cannot store the size.
            ShardError: If quality or cameras are unknown.
        """
        if self.quality not in QUALITIES:
            raise ShardError(f"quality {self.quality!r}: must be one of {', '.join(QUALITIES)}.")
        cameras = self.cameras
        if cameras is not None and (
            not cameras or sorted(set(cameras)) != list(cameras)
            or not set(cameras) <= set(range(CAMERA_COUNT))
        ):  # fmt: skip
            raise ShardError(
                f"cameras {cameras!r}: must be ascending numbers of 0 to {CAMERA_COUNT - 1}."
            )
        require_encodable(self.size, self.quality)

    def describe(self) -> dict[str, Any]:
        """Return the settings as JSON, for the plan."""
        cameras = None if self.cameras is None else list(self.cameras)
        return {
            "size": f"{self.size[1]}x{self.size[0]}",
            "quality": self.quality,
            "cameras": cameras,
            "pictures": QUALITIES[self.quality].description(),
        } | ({"accept": sorted(self.depth.accept)} if self.depth.accept else {})


@dataclass(frozen=True, slots=True)
class Derivation:
    """What a worker needs to derive scenes: settings, the source's digest, and its reader."""

    settings: TrainingSettings
    digest: str
    source: MemberSource

    @classmethod
    def of_index(
        cls, index: SceneIndex, settings: TrainingSettings, scenes: Sequence[Scene]
    ) -> "Derivation":
        """Return the derivation of some scenes of an index."""
        used = {member.path for scene in scenes for member in scene.members.values()}
        shards = {path: facts for path, facts in index.shards.items() if path in used}
        source = MemberSource(index.root, shards=shards, check="opened", retry=index.retry)
        return cls(settings, index.digest, source)


def derived_names(scene: Scene, settings: TrainingSettings) -> list[str]:
    """Return the names of a scene's derived files, in the order of shards.

    Raises:
        ShardError: If the scene is derived already, lacks a wanted camera, has none at all, or is
            smaller than the wanted size.
    """
    key, rig = scene.id.key, scene.rig
    if scene.training is not None:
        raise ShardError(
            f"{key}: is a scene of training shards already, derived at {rig.image_width_px}x"
            f"{rig.image_height_px}. Derive from the released data, so that errors do not add up."
        )
    height, width = settings.size
    if height > rig.image_height_px or width > rig.image_width_px:
        raise ShardError(
            f"{key}: its pictures have {rig.image_width_px}x{rig.image_height_px} pixels, and "
            f"{width}x{height} are asked for. Choose a size that is not larger."
        )
    names = [name for name in METADATA_FILES if name in scene.members]
    names.append(TRAINING_JSON)
    wanted = range(CAMERA_COUNT) if settings.cameras is None else settings.cameras
    videos = []
    for camera in wanted:
        videos += [name for name in (rgb_name(camera), depth_name(camera)) if _has(scene, name)]
        if settings.cameras is not None and not _has(scene, rgb_name(camera)):
            raise ShardError(
                f"{key}: has no {rgb_name(camera)}. Choose other --cameras, or fetch it."
            )
    if not any(name.endswith("_rgb.mp4") for name in videos):
        raise ShardError(f"{key}: has no video of pictures. Fetch some, or leave the scene out.")
    return [*names, *(PACKED_DEPTH_NAMES.get(name, name) for name in videos)]


def _has(scene: Scene, name: str) -> bool:
    return scene.held_name(name) in scene.members


def source_bytes(scene: Scene, names: Sequence[str]) -> int:
    """Return the size of the source files that some derived files are made from."""
    held = [scene.held_name(RELEASED_NAMES.get(name, name)) for name in names]
    return sum(scene.members[name].size for name in held if name in scene.members)


def expected_bytes(scene: Scene, name: str, settings: TrainingSettings) -> int:
    """Return about how many bytes a derived file has: plans are made by it."""
    pixels = settings.size[0] * settings.size[1] * scene.frames
    if name == TRAINING_JSON:
        return _FIXED_BYTES
    if name in METADATA_FILES:
        return scene.members[name].size
    picture = QUALITIES[settings.quality].bits_a_pixel
    bits = picture if name.endswith("_rgb.mp4") else _DEPTH_BITS_A_PIXEL
    return _FIXED_BYTES + round(pixels * bits / 8)


def derive_scene(
    derivation: Derivation, scene: Scene, folder: Path, *, advance: Advance = no_advance
) -> None:
    """Make the derived files of a scene in a folder, unless they are there and whole.

    ``training.json`` is the last of them.

    Args:
        derivation: What to make of which source.
        scene: The scene's row of the source's index.
        folder: Where to write; created if it does not exist.
        advance: Called with how many bytes of the source were done since the last call.

    Raises:
        ShardError: If a source file is missing, damaged or cannot be derived from, or what was
            written does not read back as it must.
        OSError: If a file cannot be written.
    """
    settings = derivation.settings
    names = derived_names(scene, settings)
    if _is_finished(derivation, scene, folder, names):
        advance(source_bytes(scene, names))
        return
    folder.mkdir(parents=True, exist_ok=True)
    (folder / TRAINING_JSON).unlink(missing_ok=True)
    source = derivation.source
    files: dict[str, dict[str, Any]] = {}
    key_frames: set[int] | None = None
    try:
        for name in names:
            if name in METADATA_FILES:
                write_atomic(folder / name, source.read(scene, name))
                advance(scene.members[name].size)
                continue
            if name == TRAINING_JSON:
                continue
            video = RELEASED_NAMES.get(name, name)
            content, where = _open_source(source, scene, video), source.label(scene, video)
            target, measured = folder / name, {}
            if name.endswith("_rgb.mp4"):
                pictures = _source_pictures(content, scene, settings, name=where)
                advance(0)
                rate = Fraction(scene.frame_rate_hz or FRAME_RATE_HZ)
                write_pictures(
                    pictures,
                    target,
                    quality=settings.quality,
                    rate_hz=rate.limit_denominator(_LARGEST_DENOMINATOR),
                )
                advance(0)
                measured = asdict(measured_error(pictures, target, name=str(target)))
                found_keys = probe(target, name=str(target), pixel_format="later").key_frames
                key_frames = set(found_keys) & (key_frames or set(found_keys))
            else:
                target.write_bytes(
                    packed_depth(
                        content,
                        name=where,
                        frames=scene.frames,
                        size=settings.size,
                        encoding=settings.depth,
                    )
                )
            files[name] = _size_and_crc32(target) | measured
            advance(source_bytes(scene, [name]))
    except ShardError:
        raise
    except (MediaError, SchemaError, StorageError) as error:
        raise ShardError(f"{scene.id.key}: {error}") from error
    document = _document(derivation, scene, files, sorted(key_frames or {0}))
    text = json.dumps(document, allow_nan=False).encode() + b"\n"
    write_atomic(folder / TRAINING_JSON, text)


def _open_source(source: MemberSource, scene: Scene, name: str) -> VideoFile:
    """Return a source video, whose checksum was compared: its path, or its bytes in memory."""
    opened = source.open(scene, name)
    if isinstance(opened, Path):
        return opened
    with opened:
        return io.BytesIO(opened.read())


def _source_pictures(
    video: VideoFile, scene: Scene, settings: TrainingSettings, *, name: str
) -> np.ndarray:
    """Return what ``size=`` gives of a video on the fly, (t, 3, h, w) uint8."""
    with VideoReader(video, name=name, frames=scene.frames) as reader:
        require_indexed_picture(reader, scene.rig)
        pictures = np.empty((scene.frames, 3, *settings.size), dtype=np.uint8)
        for index in range(scene.frames):
            read_rgb(reader, index, size=settings.size, out=pictures[index], content="colour")
    return pictures


def _document(
    derivation: Derivation,
    scene: Scene,
    files: Mapping[str, Mapping[str, Any]],
    key_frames: Sequence[int],
) -> dict[str, Any]:
    """Return what ``training.json`` says, as `schema.training` describes it."""
    settings, rig = derivation.settings, scene.rig
    height, width = settings.size
    return {
        "format": FORMAT,
        "source": {
            "key": scene.id.key,
            "index_digest": derivation.digest,
            "width_px": rig.image_width_px,
            "height_px": rig.image_height_px,
        },
        "derived": {
            "width_px": width,
            "height_px": height,
            "quality": settings.quality,
            "key_frames": key_frames,
        },
        "pictures": QUALITIES[settings.quality].description(),
        "versions": _versions(settings.quality),
        "files": dict(sorted(files.items())),
    }


def _size_and_crc32(path: Path) -> dict[str, Any]:
    content = path.read_bytes() if path.exists() else b""
    return {"bytes": len(content), "crc32": f"{zlib.crc32(content):08x}"}


def _versions(quality: Quality) -> dict[str, str]:
    """Return the versions that the derived bytes depend on."""
    versions = {
        "stereogenbench-data": importlib.metadata.version("stereogenbench-data"),
        "av": av.__version__,
        "libavcodec": ".".join(map(str, av.library_versions["libavcodec"])),
        "libswscale": ".".join(map(str, av.library_versions["libswscale"])),
        "blosc2": str(blosc2_module().__version__),
    }
    if QUALITIES[quality].codec == "mjpeg":
        versions["pillow"] = importlib.metadata.version("pillow")
        versions["libjpeg"] = str(features.version("libjpeg_turbo") or features.version("jpg"))
    return versions


def _is_finished(derivation: Derivation, scene: Scene, folder: Path, names: Sequence[str]) -> bool:
    """Return whether an earlier run made the files, and this run would make the same.

    What ``training.json``, the last of the files, says of the others is compared, as the system may
    have gone down before it wrote them to the disk.
    """
    videos = {name for name in names if name not in (*METADATA_FILES, TRAINING_JSON)}
    try:
        text = (folder / TRAINING_JSON).read_bytes()
        found = parse_object(text, where=TRAINING_JSON)
        files, key_frames = found["files"], found["derived"]["key_frames"]
        return (
            found == _document(derivation, scene, files, key_frames)
            and {*files} == videos
            and all(file.items() >= _size_and_crc32(folder / name).items()
                    for name, file in files.items())
        )  # fmt: skip
    except (OSError, SchemaError, AttributeError, KeyError, TypeError):
        return False
