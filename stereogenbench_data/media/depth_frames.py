"""Depth packed by blosc2: the format of the file, and a reader of single frames.

The file is a contiguous frame of blosc2 with one chunk for each depth frame; any blosc2 opens it.
A metalayer in its header holds the size and the checksum of every chunk. A reader therefore fetches
the header and one chunk, and needs no index at the end of the file.

A header or chunk from an untrusted place is refused unless it is what this module writes: blosc2
would load a library for a codec that it does not know.

Source: C-Blosc2, README_CFRAME_FORMAT.rst and README_CHUNK_FORMAT.rst.
"""

import importlib
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from io import FileIO
from itertools import accumulate, pairwise
from pathlib import Path
from time import perf_counter
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import UInt16

from stereogenbench_data.errors import MediaError, missing_extra
from stereogenbench_data.media.container import (
    Effort,
    FrameReader,
    FrameTimes,
    StreamFacts,
    VideoFile,
    merged_tags,
)
from stereogenbench_data.schema.text import shortened

CODEC_NAME: Final = "blosc2"
PACKED_SUFFIX: Final = ".b2frame"
LAYER: Final = "stereogenbench_depth"
UNIT_BYTES: Final = 2
FIXED_BYTES: Final = 4096
"""How much a header may have beside 64 bytes a frame; also how much is read at first."""

_FORMAT: Final = 1
_BYTES_A_FRAME: Final = 64
_BLOCK_BYTES: Final = 256 * 1024
_LEVEL: Final = 6
_TAGS: Final = ("tags", "stream_tags")
_TOO_LARGE: Final = 2**31
_TOO_LATE: Final = 2**62
_FIXED: Final = struct.Struct(">2x8sxixQ")
"""Magic, size of the header and of the whole file."""
_MAGIC: Final = b"b2frame\0"
_HEADER_ERRORS: Final = (
    ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip

_CHUNK: Final = struct.Struct("<4B3i16s")
"""Versions, flags, size of a unit; bytes of units, of a block, of the chunk; filters and codec."""
_CHUNK_FLAGS: Final = (0x85, 0x87)
"""An extended header and Zstandard; or units that did not get smaller."""
_PIPELINE: Final = bytes((1, 35, 0, 0, 0, 0, 5, 0, 0, 2, 0, 0, 0, 0, 0, 0))
"""Byte shuffle, then byte delta over 2 streams, then Zstandard; nothing special."""

MOST_FRAMES: Final = 2**16
"""Most frames that a header may claim if the caller does not know how many there should be."""

LARGEST_FRAME_BYTES: Final = 512 * 2**20
"""Stored numbers of one frame that are decompressed at most: 16384 x 16384 pixels."""


@dataclass(frozen=True, slots=True)
class StoredClip:
    """Facts of a depth video, from which it can be written again.

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


def blosc2_module() -> Any:
    """Return blosc2.

    Raises:
        ExtraError: If it is not installed.
    """
    try:
        return importlib.import_module("blosc2")
    except ImportError as error:
        raise missing_extra("depth that blosc2 packed", "blosc2", error) from error


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


def compressed_chunk(units: bytes) -> bytes:
    """Return the stored numbers of a frame as a chunk; the same bytes for the same blosc2."""
    blosc2 = blosc2_module()
    chunk: bytes = blosc2.compress2(units, **_compression(blosc2))
    return chunk


def frame_file(clip: StoredClip, chunks: Sequence[bytes]) -> bytes:
    """Return the file that holds these chunks, as `compressed_chunk` made them."""
    blosc2 = blosc2_module()
    # A chunk of nothing but zeros is a header, for which blosc2 stores no bytes.
    kept = [chunk if len(chunk) > _CHUNK.size else b"" for chunk in chunks]
    description = {
        "format": _FORMAT,
        "clip": asdict(clip),
        "sizes": list(map(len, kept)),
        "crc32s": list(map(zlib.crc32, kept)),
    }
    text = json.dumps(description, separators=(",", ":")).encode()
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


def _described(header: bytes) -> tuple[StoredClip, list[int], list[int]]:
    """Return what the end of a header describes: the clip, and sizes and checksums of its chunks.

    What is not so described raises one of `_HEADER_ERRORS`.
    """
    start = header.find(b'{"format":')
    text = header[start:]
    if start < 4 or zlib.crc32(text).to_bytes(4, "big") != header[start - 4 : start]:
        raise ValueError("no description that fits its checksum")
    description = json.loads(text)
    told = description["clip"]
    lists = {name: tuple(told[name]) for name in ("rate", "time_base", "pts")}
    tags = {name: {str(k): str(v) for k, v in told[name].items()} for name in _TAGS}
    clip = StoredClip(**{**told, **lists, **tags})
    sizes, crc32s = (list(map(int, description[key])) for key in ("sizes", "crc32s"))
    numbers = (clip.width_px, clip.height_px, *clip.rate, *clip.time_base)
    are_whole = len(numbers) == 6 and all(type(each) is int for each in (*numbers, *clip.pts))
    if not are_whole or not 1 <= min(numbers) <= max(numbers) < _TOO_LARGE:
        raise ValueError(f"{clip.width_px}x{clip.height_px}, {clip.rate}, {clip.time_base}")
    stored = (description["format"], clip.codec, clip.pixel_format[:4])
    if stored != (_FORMAT, "ffv1", "gray"):
        raise ValueError(f"format {stored[0]}, {clip.codec}, {clip.pixel_format}")
    if any(not -_TOO_LATE < here < there < _TOO_LATE for here, there in pairwise(clip.pts)):
        raise ValueError("times of frames that do not ascend")
    largest = clip.frame_bytes + _CHUNK.size
    if (
        not len(sizes) == len(crc32s) == len(clip.pts)
        or not 0 <= min(sizes) <= max(sizes) <= largest
    ):
        raise ValueError(f"{len(clip.pts)} times, {len(crc32s)} checksums, sizes {sizes}")
    return clip, sizes, crc32s


def require_chunk(chunk: bytes, *, clip: StoredClip, crc32: int, name: str) -> None:
    """Refuse a chunk that this module did not write, before blosc2 sees it.

    Raises:
        MediaError: If it was damaged, claims another size, or asks for another codec.
    """
    found = zlib.crc32(chunk)
    if found != crc32:
        raise MediaError(
            f"{name}: has crc32 {found:08x}, and its header says {crc32:08x}. The file is damaged: "
            f"fetch it again."
        )
    header = chunk[: _CHUNK.size].ljust(_CHUNK.size, b"\0")
    version, _, flags, typesize, units, block, size, pipeline = _CHUNK.unpack(header)
    is_ours = (version, typesize, pipeline) == (5, UNIT_BYTES, _PIPELINE) and flags in _CHUNK_FLAGS
    if not is_ours or (units, size) != (clip.frame_bytes, len(chunk)) or not 0 < block <= units:
        raise _unfit(
            name,
            f"its header ({header.hex()}) is not that of {clip.frame_bytes} bytes of units in "
            f"{len(chunk)}, compressed as this package does",
        )


def _unfit(name: str, why: str) -> MediaError:
    return MediaError(
        f"{name}: is not depth that this package packed with blosc2: {why}. The file is damaged or "
        f"something else: fetch it again, or pack it again."
    )


class DepthFrames(FrameReader):
    """An open file of packed depth, whose frames are read by number in any order.

    Whatever the file claims is checked before it is used, and no more is decompressed than a
    frame has.

    Attributes:
        facts: What the header says, as of a video; the codec is "blosc2".
        clip: Facts of the depth video that was packed.
        chunk_bounds: Where each frame's bytes begin, and the end of the file, which belongs to the
            last.
    """

    def __init__(self, file: VideoFile, *, name: str, frames: int | Literal["any"]) -> None:
        """Open a file that must hold ``frames`` frames.

        Args:
            file: A path, or a seekable binary file; the latter stays the caller's to close.
            name: What messages call the file.
            frames: How many frames it must have; "any" trusts the header.

        Raises:
            OSError: If the file cannot be read.
            MediaError: If it is not such a file, is damaged or has another number of frames.
        """
        self.name = name
        self.effort = Effort()
        self._own = FileIO(file) if isinstance(file, str | Path) else None
        self._file: Any = self._own or file
        try:
            self._read_header(frames)
        except MediaError:
            self.close()
            raise

    def chunk(self, index: int) -> bytes:
        """Return the compressed bytes of a frame, empty for a frame of zeros.

        Raises:
            MediaError: If there is no such frame, or its bytes are not those that were packed.
        """
        self.require_frame(index)
        size = self._sizes[index]
        if size == 0:
            return b""
        began_s = perf_counter()
        self._file.seek(self.chunk_bounds[index])
        chunk = self._read(size)
        self.effort.reading_s += perf_counter() - began_s
        self.effort.packets += 1
        where = f"{self.name}: frame {index}"
        require_chunk(chunk, clip=self.clip, crc32=self._crc32s[index], name=where)
        return chunk

    def units(self, index: int) -> UInt16[np.ndarray, "h w"]:
        """Return the stored numbers of a frame, in a new array.

        Raises:
            ExtraError: If blosc2 is not installed.
            MediaError: If there is no such frame, or it does not decompress.
        """
        blosc2 = blosc2_module()
        shape = (self.clip.height_px, self.clip.width_px)
        chunk = self.chunk(index)
        if not chunk:
            return np.zeros(shape, dtype=np.uint16)
        units = np.empty(shape, dtype=np.uint16)
        try:
            blosc2.decompress2(chunk, dst=units, nthreads=1)
        except (RuntimeError, ValueError) as error:
            raise MediaError(
                f"{self.name}: frame {index} does not decompress ({error}). The file is damaged: "
                f"fetch it again."
            ) from error
        return units

    def close(self) -> None:
        """Close the file, if it was opened here; closing twice does nothing."""
        if self._own is not None:
            self._own.close()

    def _read(self, size: int) -> bytes:
        """Return the next bytes, fewer only at the end: a file may give them in pieces."""
        data: bytes = self._file.read(size)
        while 0 < len(data) < size and (more := self._file.read(size - len(data))):
            data += more
        return data

    def _read_header(self, frames: int | Literal["any"]) -> None:
        """Read where each chunk lies, after checking that this module wrote the header."""
        name = self.name
        file_bytes = self._file.seek(0, 2)
        self._file.seek(0)
        header = self._file.read(FIXED_BYTES)
        if len(header) < _FIXED.size or header[2 : 2 + len(_MAGIC)] != _MAGIC:
            raise _unfit(name, f"its first bytes are {header[:10]!r}, not those of a blosc2 frame")
        _, size, told_bytes = _FIXED.unpack_from(header)
        most_frames = MOST_FRAMES if frames == "any" else frames
        if not _FIXED.size < size <= FIXED_BYTES + most_frames * _BYTES_A_FRAME:
            raise _unfit(name, f"its header claims {size} bytes")
        header += self._read(size - len(header)) if size > len(header) else b""
        if len(header) < size or told_bytes != file_bytes:
            raise MediaError(
                f"{name}: is cut short or damaged: its header has {size} bytes of {told_bytes}, "
                f"and the file {file_bytes}: fetch it again."
            )
        try:
            self.clip, self._sizes, self._crc32s = _described(header[:size])
        except _HEADER_ERRORS as error:
            reason = shortened(str(error))
            raise _unfit(name, f"its description is malformed or incomplete ({reason})") from error
        clip, self.frames = self.clip, len(self._sizes)
        *offsets, end = accumulate(self._sizes, initial=size)
        self.chunk_bounds = (*offsets, file_bytes)
        if end > file_bytes:
            raise _unfit(name, f"its chunks end at byte {end} of {file_bytes}")
        if frames not in ("any", self.frames):
            raise MediaError(
                f"{name}: holds {self.frames} frames where {frames} are expected. "
                f"It belongs to another scene: fetch it again."
            )
        if clip.frame_bytes > LARGEST_FRAME_BYTES:
            raise MediaError(
                f"{name}: claims frames of {clip.width_px}x{clip.height_px} pixels, "
                f"{clip.frame_bytes:,} bytes each, and at most {LARGEST_FRAME_BYTES:,} are read: "
                f"it is not depth of this release."
            )
        self.header = self.facts = StreamFacts(
            codec=CODEC_NAME,
            pixel_format=clip.pixel_format,
            width_px=clip.width_px,
            height_px=clip.height_px,
            frames=self.frames,
            frame_rate_hz=clip.rate[0] / clip.rate[1],
            tags=merged_tags(clip.tags, clip.stream_tags),
            is_colour=False,
            times=FrameTimes(clip.pts, Fraction(*clip.time_base)),
        )
