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
from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.records import TrainingFacts
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    PACKED_DEPTH_NAMES,
    rgb_name,
)
from stereogenbench_data.schema.text import shortened

MOST_PSNR_DB: Final = 100.0
"""The PSNR that is stored for pictures without any error, and the largest."""

_FORMAT: Final = 1


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

        def of_pictures(name: str) -> tuple[float, ...]:
            pictures = (self.files.get(rgb_name(camera)) for camera in range(CAMERA_COUNT))
            return tuple(getattr(each, name, math.nan) for each in pictures)

        return TrainingFacts(
            source_digest=self.source_digest,
            quality=self.quality,
            codec=str(self.pictures["codec"]),
            settings=json.dumps(self.pictures, sort_keys=True),
            psnr_db=of_pictures("psnr_db"),
            worst_psnr_db=of_pictures("worst_psnr_db"),
        )

    def text(self) -> bytes:
        """Return the file's bytes."""
        files = {}
        for name, file in sorted(self.files.items()):
            files[name] = {"bytes": file.size, "crc32": f"{file.crc32:08x}"}
            if file.worst_frame >= 0:
                measured = ("psnr_db", "worst_psnr_db", "worst_frame")
                files[name] |= {each: getattr(file, each) for each in measured}
        size = {"quality": self.quality, "key_frames": list(self.key_frames)}
        document = {
            "format": _FORMAT,
            "source": {"key": self.key, "index_digest": self.source_digest,
                       **_size(self.source_size_px)},
            "derived": {**_size(self.size_px), **size},
            "pictures": dict(self.pictures),
            "versions": dict(self.versions),
            "files": files,
        }  # fmt: skip
        return json.dumps(document, allow_nan=False).encode() + b"\n"


def _size(size_px: tuple[int, int]) -> dict[str, int]:
    return {"width_px": size_px[0], "height_px": size_px[1]}


def parse_training(text: bytes, *, where: str) -> TrainingDocument:
    """Return the content of a ``training.json``.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file is not what `TrainingDocument.text` writes.
    """
    document = parse_object(text, where=where)
    try:
        source, derived = document["source"], document["derived"]
        found = TrainingDocument(
            key=source["key"],
            source_digest=source["index_digest"],
            source_size_px=(source["width_px"], source["height_px"]),
            size_px=(derived["width_px"], derived["height_px"]),
            quality=derived["quality"],
            key_frames=tuple(derived["key_frames"]),
            pictures=document["pictures"],
            versions=document["versions"],
            files={
                name: DerivedFile(
                    file["bytes"], int(file["crc32"], 16), file.get("psnr_db", math.nan),
                    file.get("worst_psnr_db", math.nan), file.get("worst_frame", -1),
                )
                for name, file in document["files"].items()
            },
        )  # fmt: skip
        is_ours = json.loads(found.text()) == document
        odd = _odd_value(found) or ("" if is_ours else "one of its keys")
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        odd = f"a value ({error!r})"
    if odd:
        raise SchemaError(
            f"{where}: {shortened(odd, 200)} is not as this package writes it. The file was "
            f"altered: fetch it again, or run `stereogenbench pack` again."
        )
    return found


def _odd_value(found: TrainingDocument) -> str:
    """Return a value that the package does not write, with its name; "" if there is none."""
    frames, sides_px = found.key_frames, (*found.source_size_px, *found.size_px)
    names = (found.quality, *(str(found.pictures[name]) for name in ("codec", "pixel_format")))
    files = found.files.values()
    decibels = [each for file in files for each in (file.worst_psnr_db, file.psnr_db)
                if not math.isnan(each)]  # fmt: skip
    for what, value, is_right in (
        ("width_px or height_px", sides_px, all(0 < side <= 2**16 for side in sides_px)),
        ("key_frames", frames, frames[:1] == (0,) and list(frames) == sorted(set(frames))),
        ("index_digest", found.source_digest, re.fullmatch("[0-9a-f]{64}", found.source_digest)),
        ("quality or codec", names, all(re.fullmatch(r"[\w.+-]{1,40}", name) for name in names)),
        ("files", [*found.files], files and {*found.files} <= _DERIVED),
        ("bytes", "", all(file.size > 0 for file in files)),
        ("psnr_db", decibels, all(0 <= each <= MOST_PSNR_DB for each in decibels)),
    ):
        if not is_right:
            return f"{what} {value}"
    return ""


_DERIVED: Final = {*map(rgb_name, range(CAMERA_COUNT)), *PACKED_DEPTH_NAMES.values()}
