"""The file that depth is packed into: a contiguous frame of blosc2, one chunk a depth frame.

It is blosc2's own format, and any blosc2 opens it. What is needed to read one depth frame stands
in the header, in a metalayer: the size and the checksum of every chunk. So a reader fetches the
header and one chunk, and no index at the end; chunks lie one after another in the order of frames.

A header and a chunk from an untrusted place are let through only if they are what this module
writes: blosc2 would load a library for a codec that it does not know.

Source: C-Blosc2, README_CFRAME_FORMAT.rst and README_CHUNK_FORMAT.rst.
"""

import importlib
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Final

from stereogenbench_data.errors import ExtraError, MediaError

CODEC_NAME: Final = "blosc2"
PACKED_SUFFIX: Final = ".b2frame"
LAYER: Final = "stereogenbench_depth"
UNIT_BYTES: Final = 2
FIXED_BYTES: Final = 4096
"""What a header may have beside 64 bytes a frame; so much is read at first, too."""

_FORMAT: Final = 1
_BYTES_A_FRAME: Final = 64
_BLOCK_BYTES: Final = 256 * 1024
_LEVEL: Final = 6
_TOO_LARGE: Final = 2**31
_TOO_LATE: Final = 2**62
_FIXED: Final = struct.Struct(">2x8sxixQ5xxqxqxixixixhxhx2x16s")
"""Magic, sizes of header and frame, of all units and chunks, of a unit, a block and a chunk."""
_MAGIC: Final = b"b2frame\0"
_NAME_AT: Final = _FIXED.size + len(b"\x93\xcd__\xde__")
_NAME: Final = bytes([0xA0 + len(LAYER)]) + LAYER.encode()
_LAYER_AT: Final = struct.Struct(">xi")

_CHUNK: Final = struct.Struct("<4B3i16s")
"""Versions, flags, size of a unit; bytes of units, of a block, of the chunk; filters and codec."""
_CHUNK_FLAGS: Final = (0x85, 0x87)
"""An extended header and Zstandard; or units that did not get smaller."""
_PIPELINE: Final = bytes((1, 35, 0, 0, 0, 0, 5, 0, 0, 2, 0, 0, 0, 0, 0, 0))
"""Byte shuffle, then byte delta over 2 streams, then Zstandard; nothing special."""


@dataclass(frozen=True, slots=True)
class StoredClip:
    """What a depth video was, so that it can be written anew.

    Attributes:
        width_px: Width of every frame.
        height_px: Height of every frame.
        codec: FFmpeg's name of the codec that it was stored by.
        pixel_format: FFmpeg's name of the pixel format.
        rate: Numerator and denominator of the average frame rate in Hz.
        time_base: Numerator and denominator of a tick in seconds.
        pts: When each frame is shown, in ticks.
        tags: Metadata of the container.
        stream_tags: Metadata of the stream.
    """

    width_px: int
    height_px: int
    codec: str
    pixel_format: str
    rate: tuple[int, int]
    time_base: tuple[int, int]
    pts: tuple[int, ...]
    tags: Mapping[str, str]
    stream_tags: Mapping[str, str]

    @property
    def frame_bytes(self) -> int:
        """How many bytes the stored numbers of a frame have."""
        return self.width_px * self.height_px * UNIT_BYTES


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """What a file's header says: the clip, and where each chunk lies.

    Attributes:
        clip: What the depth video was.
        offsets: The first byte of each chunk.
        sizes: How many bytes each has; 0 for a frame of zeros, which has none.
        crc32s: zlib's checksum of each.
    """

    clip: StoredClip
    offsets: tuple[int, ...]
    sizes: tuple[int, ...]
    crc32s: tuple[int, ...]


def blosc2_module() -> Any:
    """Return blosc2.

    Raises:
        ExtraError: If it is not installed.
    """
    try:
        return importlib.import_module("blosc2")
    except ImportError as error:
        raise ExtraError(
            f"depth that is packed by blosc2 needs it ({error}): "
            f"pip install 'stereogenbench-data[blosc2]'."
        ) from error


def compressed_chunk(units: bytes) -> bytes:
    """Return the stored numbers of a frame as a chunk; the same bytes for the same blosc2."""
    blosc2 = blosc2_module()
    chunk: bytes = blosc2.compress2(units, **_compression(blosc2))
    return chunk


def _compression(blosc2: Any) -> dict[str, Any]:
    return {
        "codec": blosc2.Codec.ZSTD,
        "clevel": _LEVEL,
        "filters": [blosc2.Filter.SHUFFLE, blosc2.Filter.BYTEDELTA],
        "filters_meta": [0, UNIT_BYTES],
        "typesize": UNIT_BYTES,
        "blocksize": _BLOCK_BYTES,
        "splitmode": blosc2.SplitMode.ALWAYS_SPLIT,
        "nthreads": 1,
    }


def is_zeros(chunk: bytes) -> bool:
    """Return whether a chunk, made here, stands for zeros alone: blosc2 keeps no bytes of it."""
    return len(chunk) == _CHUNK.size


def frame_file(clip: StoredClip, chunks: Sequence[bytes]) -> bytes:
    """Return the file that holds these chunks, as `compressed_chunk` made them."""
    blosc2 = blosc2_module()
    kept = [b"" if is_zeros(chunk) else chunk for chunk in chunks]
    told = {
        "format": _FORMAT,
        "clip": asdict(clip),
        "sizes": list(map(len, kept)),
        "crc32s": list(map(zlib.crc32, kept)),
    }
    text = json.dumps(told, separators=(",", ":")).encode()
    schunk = blosc2.SChunk(
        chunksize=clip.frame_bytes,
        contiguous=True,
        cparams=blosc2.CParams(**_compression(blosc2)),
        dparams=blosc2.DParams(nthreads=1),
        meta={LAYER: zlib.crc32(text).to_bytes(4, "big") + text},
    )
    for chunk in chunks:
        schunk.append_chunk(chunk)
    content: bytes = schunk.to_cframe()
    return content


def header_bytes(start: bytes, *, frames: int, name: str) -> int:
    """Return how many bytes a file's header has, from its first ones.

    Raises:
        MediaError: If it is no such file, or the header is larger than so many frames make it.
    """
    if len(start) < _NAME_AT or start[2 : 2 + len(_MAGIC)] != _MAGIC:
        raise _unfit(name, f"its first bytes are {start[:10]!r}, not those of a blosc2 frame")
    size = int(_FIXED.unpack_from(start)[1])
    if not _NAME_AT < size <= FIXED_BYTES + frames * _BYTES_A_FRAME:
        raise _unfit(name, f"its header claims {size} bytes")
    return size


def parse_header(header: bytes, *, file_bytes: int, name: str) -> FrameHeader:
    """Return what a whole header says, once it is known to be one that was written here.

    Args:
        header: All bytes of the header.
        file_bytes: How many bytes the file has.
        name: What messages call the file.

    Raises:
        MediaError: If it was damaged, or is another's.
    """
    _, size, frame_bytes, units, chunks, typesize, _, chunk_bytes, *_ = _FIXED.unpack_from(header)
    if frame_bytes != file_bytes:
        raise _unfit(name, f"its header claims {frame_bytes} bytes, and it has {file_bytes}")
    told = _told(header, name=name)
    try:
        clip = _clip(told["clip"])
        sizes, crc32s = tuple(map(int, told["sizes"])), tuple(map(int, told["crc32s"]))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise _unfit(
            name, f"its description of itself is odd or lacks something ({error!r})"
        ) from error
    offsets = tuple(size + sum(sizes[:number]) for number in range(len(sizes)))
    expected = (len(sizes) * clip.frame_bytes, sum(sizes), UNIT_BYTES, clip.frame_bytes)
    found = (units, chunks, typesize, chunk_bytes)
    counts = {len(sizes), len(crc32s), len(clip.pts)}
    largest = clip.frame_bytes + _CHUNK.size
    if found != expected or len(counts) != 1 or not all(0 <= each <= largest for each in sizes):
        raise _unfit(
            name,
            f"its header claims {found} bytes of units, chunks, unit, frame, not {expected}",
        )
    if size + chunks > file_bytes:
        raise _unfit(name, f"its chunks would end at byte {size + chunks} of {file_bytes}")
    return FrameHeader(clip, offsets, sizes, crc32s)


def _told(header: bytes, *, name: str) -> dict[str, Any]:
    """Return the metalayer's content."""
    content_at = _NAME_AT + len(_NAME)
    if header[_NAME_AT:content_at] != _NAME or len(header) < content_at + _LAYER_AT.size:
        raise _unfit(name, f"it has no metalayer {LAYER!r} of its own")
    (start,) = _LAYER_AT.unpack_from(header, content_at)
    # Of a layer: a mark and four bytes of size; of its bytes: a mark and one, two or four.
    packed = header[start + 5 :] if 0 < start < len(header) else b""
    width = {0xC4: 1, 0xC5: 2, 0xC6: 4}.get(packed[0] if packed else 0, 0)
    length = int.from_bytes(packed[1 : 1 + width], "big")
    text = packed[1 + width : 1 + width + length]
    if len(text) != length or length < 4 or zlib.crc32(text[4:]).to_bytes(4, "big") != text[:4]:
        raise _unfit(name, "its description of itself fails its checksum")
    try:
        told = json.loads(text[4:])
    except (ValueError, RecursionError):
        told = None
    if not isinstance(told, dict) or told.get("format") != _FORMAT:
        raise _unfit(name, "its description of itself is of another version")
    return told


def _clip(told: Mapping[str, Any]) -> StoredClip:
    tags, stream_tags = (
        {str(key): str(value) for key, value in told[which].items()}
        for which in ("tags", "stream_tags")
    )
    rate, time_base = ((int(told[w][0]), int(told[w][1])) for w in ("rate", "time_base"))
    clip = StoredClip(
        width_px=int(told["width_px"]),
        height_px=int(told["height_px"]),
        codec=str(told["codec"]),
        pixel_format=str(told["pixel_format"]),
        rate=rate,
        time_base=time_base,
        pts=tuple(map(int, told["pts"])),
        tags=tags,
        stream_tags=stream_tags,
    )
    numbers = (clip.width_px, clip.height_px, *rate, *time_base)
    if not 1 <= min(numbers) <= max(numbers) < _TOO_LARGE:
        raise ValueError(f"{clip.width_px}x{clip.height_px}, {rate}, {time_base}")
    if clip.codec != "ffv1" or not clip.pixel_format.startswith("gray"):
        raise ValueError(f"{clip.codec}, {clip.pixel_format}")
    if any(not -_TOO_LATE < here < there < _TOO_LATE for here, there in pairwise(clip.pts)):
        raise ValueError("times of frames that do not ascend")
    return clip


def require_chunk(chunk: bytes, *, clip: StoredClip, crc32: int, name: str) -> None:
    """Refuse a chunk before blosc2 sees it, unless it is one that was written here.

    Raises:
        MediaError: If it was damaged, claims another size, or asks for another codec.
    """
    found = zlib.crc32(chunk)
    if found != crc32:
        raise MediaError(
            f"{name}: has crc32 {found:08x}, and its header says {crc32:08x}. The file is damaged: "
            f"fetch it again."
        )
    if len(chunk) < _CHUNK.size:
        raise _unfit(name, f"it has {len(chunk)} bytes, which is less than a chunk's header")
    version, _, flags, typesize, units, block, size, pipeline = _CHUNK.unpack_from(chunk)
    is_ours = (version, typesize, pipeline) == (5, UNIT_BYTES, _PIPELINE)
    if not is_ours or flags not in _CHUNK_FLAGS:
        raise _unfit(name, f"its header asks for another codec ({chunk[: _CHUNK.size].hex()})")
    if (units, size) != (clip.frame_bytes, len(chunk)) or not 0 < block <= units:
        raise _unfit(
            name,
            f"it claims {units} bytes of units in {size}, in blocks of {block}, and a frame of "
            f"{clip.width_px}x{clip.height_px} has {clip.frame_bytes} in {len(chunk)}",
        )


def _unfit(name: str, why: str) -> MediaError:
    return MediaError(
        f"{name}: is no depth that this package packed by blosc2: {why}. The file is damaged or "
        f"something else: fetch it again, or pack it again."
    )
