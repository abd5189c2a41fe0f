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
from typing import Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.records import TrainingFacts
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    PACKED_DEPTH_NAMES,
    rgb_name,
)
from stereogenbench_data.schema.text import shortened

FORMAT: Final = 1

MOST_PSNR_DB: Final = 100.0
"""The PSNR that is stored for pictures without any error, and the largest."""

_DIGEST: Final = re.compile("[0-9a-f]{64}")
_NAME: Final = re.compile(r"[\w.+-]{1,40}")
_DERIVED: Final = {*map(rgb_name, range(CAMERA_COUNT)), *PACKED_DEPTH_NAMES.values()}


@dataclass(frozen=True, slots=True)
class TrainingDocument:
    """What is read of a ``training.json``.

    Attributes:
        key: The scene's key.
        source_size_px: (width, height) of the released pictures.
        size_px: (width, height) of the derived pictures.
        key_frames: The frames at which decoding can begin.
        files: Size in bytes and crc32 of each derived file, by name.
        facts: What the index keeps of it.
    """

    key: str
    source_size_px: tuple[int, int]
    size_px: tuple[int, int]
    key_frames: tuple[int, ...]
    files: Mapping[str, tuple[int, int]]
    facts: TrainingFacts


def parse_training(text: bytes, *, where: str) -> TrainingDocument:
    """Return the content of a ``training.json``.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file lacks a value, or has one that is never written.
    """
    document = parse_object(text, where=where)
    try:
        source, derived, files = document["source"], document["derived"], document["files"]
        sizes_px = [(each["width_px"], each["height_px"]) for each in (source, derived)]
        key_frames, pictures = tuple(derived["key_frames"]), document["pictures"]
        psnr_db, worst_psnr_db = (
            tuple(
                files.get(rgb_name(camera), {}).get(name, math.nan)
                for camera in range(CAMERA_COUNT)
            )
            for name in ("psnr_db", "worst_psnr_db")
        )
        decibels = [each for each in psnr_db + worst_psnr_db if each is not math.nan]
        found = TrainingDocument(
            key=source["key"],
            source_size_px=sizes_px[0],
            size_px=sizes_px[1],
            key_frames=key_frames,
            files={name: (file["bytes"], int(file["crc32"], 16)) for name, file in files.items()},
            facts=TrainingFacts(
                source_digest=source["index_digest"],
                quality=derived["quality"],
                codec=pictures["codec"],
                settings=json.dumps(pictures, sort_keys=True),
                psnr_db=psnr_db,
                worst_psnr_db=worst_psnr_db,
            ),
        )
        is_ordered = key_frames[:1] == (0,) and list(key_frames) == sorted({*key_frames})
        sides_px, facts = [side for size in sizes_px for side in size], found.facts
        digest, names = facts.source_digest, [facts.quality, facts.codec, pictures["pixel_format"]]
        odd = [
            f"{what} {value}"
            for what, value, is_right in (
                ("format", document["format"], document["format"] == FORMAT),
                ("width_px or height_px", sides_px,
                 all(type(side) is int and 0 < side <= 2**16 for side in sides_px)),
                ("index_digest", digest, _DIGEST.fullmatch(digest)),
                ("quality, codec or pixel_format", names, all(map(_NAME.fullmatch, names))),
                ("key_frames", key_frames, is_ordered),
                ("files", [*files], files and {*files} <= _DERIVED),
                ("psnr_db", decibels, all(0 <= each <= MOST_PSNR_DB for each in decibels)),
            )
            if not is_right
        ]  # fmt: skip
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        odd = [f"a value ({error!r})"]
    if odd:
        raise SchemaError(
            f"{where}: {shortened(odd[0], 200)} is not as this package writes it. The file was "
            f"altered: fetch it again, or run `stereogenbench pack` again."
        )
    return found
