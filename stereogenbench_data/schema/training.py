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
from collections.abc import Callable, Mapping
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
    document = parse_object(text, where=where)
    _require(document, _FORM, "$", where)
    source, derived, pictures = document["source"], document["derived"], document["pictures"]
    for name, file in document["files"].items():
        is_picture = name in _PICTURES
        _require(file, _PICTURE if is_picture else _FILE, f"$.files.{name}", where)
        if is_picture and file["worst_psnr_db"] > file["psnr_db"]:
            path = f"$.files.{name}.worst_psnr_db"
            raise _wrong(file["worst_psnr_db"], "must not exceed psnr_db", path, where)
    return TrainingDocument(
        key=source["key"],
        source_digest=source["index_digest"],
        source_size_px=(source["width_px"], source["height_px"]),
        size_px=(derived["width_px"], derived["height_px"]),
        quality=derived["quality"],
        key_frames=tuple(derived["key_frames"]),
        pictures=pictures,
        versions=document["versions"],
        files={
            name: DerivedFile(
                file["bytes"], int(file["crc32"], 16), float(file.get("psnr_db", math.nan)),
                float(file.get("worst_psnr_db", math.nan)), file.get("worst_frame", -1),
            )
            for name, file in document["files"].items()
        },
    )  # fmt: skip


_Check = tuple[Callable[[Any], bool], str]
_Form = dict[str, Any]


def _whole(least: int, most: int = 2**53) -> _Check:
    what = f"must be a whole number of at least {least}"
    return lambda value: type(value) is int and least <= value <= most, what


def _like(pattern: str, what: str) -> _Check:
    return lambda value: isinstance(value, str) and bool(re.fullmatch(pattern, value)), what


def _are_texts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_text, value.values()))


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable()


def _is_ascending(value: Any) -> bool:
    return (
        isinstance(value, list)
        and all(type(each) is int and each < 2**53 for each in value)
        and value[:1] == [0]
        and value == sorted(set(value))
    )


_PICTURES: Final = {rgb_name(camera) for camera in range(CAMERA_COUNT)}
_DERIVED: Final = _PICTURES | set(PACKED_DEPTH_NAMES.values())
_SIZE: Final = {name: _whole(1, 2**16) for name in ("width_px", "height_px")}
_WORD: Final = _like(r"[A-Za-z0-9_.+-]{1,40}", "must be a name of letters, digits and _ . + -")
_TEXTS: Final = (_are_texts, "must be an object of printable texts")
_DECIBELS: Final = (
    lambda value: is_number(value) and 0 <= value <= MOST_PSNR_DB,
    f"must be 0 to {MOST_PSNR_DB:g} dB",
)
_FORM: Final[_Form] = {
    "format": (lambda value: type(value) is int and value == _FORMAT, f"must be {_FORMAT}"),
    "source": {
        "key": (_is_text, "must be a printable text"),
        "index_digest": _like("[0-9a-f]{64}", "must be a sha256 in hex"),
        **_SIZE,
    },
    "derived": {
        **_SIZE,
        "quality": _WORD,
        "key_frames": (_is_ascending, "must be frames ascending from 0"),
    },
    "pictures": {
        "codec": _WORD, "pixel_format": _WORD, "options": _TEXTS, "key_frame_distance": _whole(1),
    },
    "versions": _TEXTS,
    "files": (
        lambda value: isinstance(value, dict) and bool(value) and set(value) <= _DERIVED,
        f"must name some of {', '.join(sorted(_DERIVED))}",
    ),
}  # fmt: skip
"""What each value must be: a form of its own, or a check and what it asks for."""
_FILE: Final[_Form] = {"bytes": _whole(1), "crc32": _like("[0-9a-f]{8}", "must be 8 hex digits")}
_PICTURE: Final = _FILE | {
    "psnr_db": _DECIBELS, "worst_psnr_db": _DECIBELS, "worst_frame": _whole(0),
}  # fmt: skip


def _require(value: Any, form: _Form | _Check, path: str, where: str) -> None:
    """Refuse a value that does not have a form."""
    if not isinstance(form, dict):
        fits, what = form
        if not fits(value):
            raise _wrong(value, what, path, where)
    elif not isinstance(value, dict):
        raise _wrong(value, "must be an object", path, where)
    elif odd := sorted(set(value) ^ set(form)):
        what = f"must be there, and only {', '.join(form)}"
        raise _wrong(value.get(odd[0]), what, f"{path}.{odd[0]}", where)
    else:
        for name, inner in form.items():
            _require(value[name], inner, f"{path}.{name}", where)


def _wrong(value: Any, what: str, path: str, where: str) -> SchemaError:
    return SchemaError(
        f"{where}: {path} {what}, found {brief(value)}. The file was altered: fetch it again, or "
        f"run `stereogenbench pack` again."
    )
