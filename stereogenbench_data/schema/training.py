"""``training.json``: what a scene of training shards was derived from, how, and with what error.

    {"format": 1,
     "source": {"key", "index_digest", "width_px", "height_px"},
     "derived": {"width_px", "height_px", "quality", "key_frames"},
     "pictures": {"codec", "pixel_format", "options", "key_frame_distance"},
     "versions": {name: version},
     "files": {name: {"bytes", "crc32", "psnr_db", "worst_psnr_db", "worst_frame"}}}

Only this package writes the file, so its keys have one spelling and nothing else is accepted. PSNR
is that of a picture against the one that ``size=`` gives of the released video; depth has none,
because it is stored without loss.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import brief, is_number, parse_object
from stereogenbench_data.schema.records import TrainingFacts
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    PACKED_DEPTH_NAMES,
    rgb_name,
)

MOST_PSNR_DB: Final = 100.0
"""The PSNR that is stored for pictures without any error, and the largest."""

_FORMAT: Final = 1
_LARGEST_SIDE_PX: Final = 2**16
_LARGEST_INT: Final = 2**53
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_WORD: Final = re.compile(r"[A-Za-z0-9_.+-]{1,40}")
_CRC32: Final = re.compile(r"[0-9a-f]{8}")


@dataclass(frozen=True, slots=True)
class DerivedFile:
    """One derived file: its size, checksum and, of pictures, PSNR in dB and the worst frame."""

    size: int
    crc32: int
    psnr_db: float = math.nan
    worst_psnr_db: float = math.nan
    worst_frame: int = -1


@dataclass(frozen=True, slots=True)
class TrainingDocument:
    """The content of a ``training.json``.

    Attributes:
        key: The scene's key.
        source_digest: The digest of the index that the scene was read with.
        source_size_px: (width, height) of the released pictures.
        size_px: (width, height) of the derived pictures.
        quality: The name of the settings.
        key_frames: The frames at which decoding can begin.
        pictures: How pictures are encoded: codec, pixel format, options, key frame distance.
        versions: Of the package and of the libraries that encoded.
        files: The derived files by name.
    """

    key: str
    source_digest: str
    source_size_px: tuple[int, int]
    size_px: tuple[int, int]
    quality: str
    key_frames: tuple[int, ...]
    pictures: Mapping[str, Any]
    versions: Mapping[str, str]
    files: Mapping[str, DerivedFile]

    @property
    def facts(self) -> TrainingFacts:
        """What the index keeps of it."""
        pictures = [self.files.get(rgb_name(camera)) for camera in range(CAMERA_COUNT)]
        return TrainingFacts(
            source_digest=self.source_digest,
            quality=self.quality,
            codec=str(self.pictures["codec"]),
            settings=json.dumps(self.pictures, sort_keys=True),
            psnr_db=tuple(math.nan if each is None else each.psnr_db for each in pictures),
            worst_psnr_db=tuple(
                math.nan if each is None else each.worst_psnr_db for each in pictures
            ),
        )

    def text(self) -> bytes:
        """Return the file's bytes."""
        files = {}
        for name, file in sorted(self.files.items()):
            files[name] = {"bytes": file.size, "crc32": f"{file.crc32:08x}"}
            if file.worst_frame >= 0:
                files[name] |= {
                    "psnr_db": file.psnr_db,
                    "worst_psnr_db": file.worst_psnr_db,
                    "worst_frame": file.worst_frame,
                }
        document = {
            "format": _FORMAT,
            "source": {
                "key": self.key,
                "index_digest": self.source_digest,
                **_size(self.source_size_px),
            },
            "derived": {
                **_size(self.size_px),
                "quality": self.quality,
                "key_frames": list(self.key_frames),
            },
            "pictures": dict(self.pictures),
            "versions": dict(self.versions),
            "files": files,
        }
        return json.dumps(document, allow_nan=False).encode() + b"\n"


def _size(size_px: tuple[int, int]) -> dict[str, int]:
    return {"width_px": size_px[0], "height_px": size_px[1]}


def parse_training(text: bytes, *, where: str) -> TrainingDocument:
    """Return the content of a ``training.json``.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file is not what `TrainingDocument.text` writes; it names the place.
    """
    root = _Object(parse_object(text, where=where), "$", where)
    root.require_keys("format", "source", "derived", "pictures", "versions", "files")
    if root.integer("format") != _FORMAT:
        raise root.wrong("format", f"must be {_FORMAT}")
    source, derived, pictures = (root.object(each) for each in ("source", "derived", "pictures"))
    source.require_keys("key", "index_digest", "width_px", "height_px")
    derived.require_keys("width_px", "height_px", "quality", "key_frames")
    pictures.require_keys("codec", "pixel_format", "options", "key_frame_distance")
    for place, name in ((pictures, "codec"), (pictures, "pixel_format"), (derived, "quality")):
        if not _WORD.fullmatch(place.text(name)):
            raise place.wrong(name, "must be a name of letters, digits and _ . + -")
    pictures.integer("key_frame_distance", least=1)
    for each in (pictures.object("options"), root.object("versions")):
        for name in each.value:
            each.text(name)
    key_frames = derived.value["key_frames"]
    is_ascending = (
        isinstance(key_frames, list)
        and all(type(each) is int and each < _LARGEST_INT for each in key_frames)
        and key_frames[:1] == [0]
        and key_frames == sorted(set(key_frames))
    )
    if not is_ascending:
        raise derived.wrong("key_frames", "must be frames ascending from 0")
    digest = source.text("index_digest")
    if not _DIGEST.fullmatch(digest):
        raise source.wrong("index_digest", "must be a sha256 in hex")
    files = root.object("files")
    known = {rgb_name(camera) for camera in range(CAMERA_COUNT)}
    allowed = known | set(PACKED_DEPTH_NAMES.values())
    if not files.value or not set(files.value) <= allowed:
        raise root.wrong("files", f"must name some of {', '.join(sorted(allowed))}")
    return TrainingDocument(
        key=source.text("key"),
        source_digest=digest,
        source_size_px=source.size(),
        size_px=derived.size(),
        quality=derived.text("quality"),
        key_frames=tuple(key_frames),
        pictures=pictures.value,
        versions=root.object("versions").value,
        files={
            name: _parse_file(files.object(name), is_picture=name in known) for name in files.value
        },
    )


def _parse_file(file: "_Object", *, is_picture: bool) -> DerivedFile:
    measured = ("psnr_db", "worst_psnr_db", "worst_frame") if is_picture else ()
    file.require_keys("bytes", "crc32", *measured)
    crc32 = file.text("crc32")
    if not _CRC32.fullmatch(crc32):
        raise file.wrong("crc32", "must be 8 hex digits")
    size = file.integer("bytes", least=1)
    if not is_picture:
        return DerivedFile(size, int(crc32, 16))
    mean_db, worst_db = (file.decibels(name) for name in measured[:2])
    if worst_db > mean_db:
        raise file.wrong("worst_psnr_db", "must not exceed psnr_db")
    return DerivedFile(
        size, int(crc32, 16), mean_db, worst_db, file.integer("worst_frame", least=0)
    )


@dataclass(frozen=True, slots=True)
class _Object:
    """An object of the file with its JSON path; each reader refuses what is not of its kind."""

    value: dict[str, Any]
    path: str
    where: str

    def wrong(self, name: str, what: str) -> SchemaError:
        found = brief(self.value.get(name))
        return SchemaError(
            f"{self.where}: {self.path}.{name} {what}, found {found}. The file was altered: fetch "
            f"it again, or run `stereogenbench pack` again."
        )

    def require_keys(self, *names: str) -> None:
        if set(self.value) != set(names):
            odd = sorted(set(self.value) ^ set(names))[0]
            raise self.wrong(odd, f"must be there, and only {', '.join(names)}")

    def object(self, name: str) -> "_Object":
        value = self.value.get(name)
        if not isinstance(value, dict):
            raise self.wrong(name, "must be an object")
        return _Object(value, f"{self.path}.{name}", self.where)

    def text(self, name: str) -> str:
        value = self.value[name]
        if not isinstance(value, str) or not value.isprintable():
            raise self.wrong(name, "must be a printable text")
        return value

    def integer(self, name: str, *, least: int = -_LARGEST_INT, most: int = _LARGEST_INT) -> int:
        value = self.value[name]
        if type(value) is not int or not least <= value <= most:
            raise self.wrong(name, f"must be a whole number of at least {least}")
        return int(value)

    def decibels(self, name: str) -> float:
        value = self.value[name]
        if not is_number(value) or not 0 <= value <= MOST_PSNR_DB:
            raise self.wrong(name, f"must be 0 to {MOST_PSNR_DB:g} dB")
        return float(value)

    def size(self) -> tuple[int, int]:
        width_px, height_px = (
            self.integer(name, least=1, most=_LARGEST_SIDE_PX) for name in ("width_px", "height_px")
        )
        return width_px, height_px
