"""Depth frames by number out of a file that blosc2 packed: the header once, then one chunk each."""

from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, NoReturn

import numpy as np
from jaxtyping import UInt16

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import (
    BinaryFile,
    StreamFacts,
    VideoFile,
    merged_tags,
)
from stereogenbench_data.media.depth_frame_file import (
    CODEC_NAME,
    FIXED_BYTES,
    FrameHeader,
    StoredClip,
    blosc2_module,
    header_bytes,
    parse_header,
    require_chunk,
)

MOST_FRAMES: Final = 2**16
"""Frames that a header may tell of where it is not known how many there should be."""

LARGEST_FRAME_BYTES: Final = 512 * 2**20
"""Stored numbers of one frame that are decompressed at most: 16384 x 16384 pixels."""


class DepthFrames:
    """An open file of packed depth, whose frames are read by number in any order.

    Nothing that the file says is believed before it was checked, and no more is decompressed than
    a frame has. A reader belongs to the thread and the process that opened it.

    Attributes:
        name: What messages call the file.
        frames: How many frames it has.
        facts: What the header says, as of a video; the codec is "blosc2".
    """

    def __init__(
        self, file: VideoFile, *, name: str, frames: int | Literal["any"], threads: int = 1
    ) -> None:
        """Open a file that must hold so many frames.

        Args:
            file: A path, or a seekable binary file; the latter stays the caller's to close.
            name: What messages call the file.
            frames: How many frames it must have; "any" takes the header's word.
            threads: How many blocks of one frame to decompress at once.

        Raises:
            ExtraError: If blosc2 is not installed.
            OSError: If the file cannot be read.
            MediaError: If it is no such file, was damaged or has another number of frames.
        """
        self.name = name
        self._threads = threads
        self._blosc2: Any = blosc2_module()
        self._own = Path(file).open("rb", buffering=0) if isinstance(file, str | Path) else None  # noqa: SIM115
        self._file: BinaryFile = self._own if isinstance(file, str | Path) else file  # type: ignore[assignment]  # its own if a path
        try:
            self._header = self._read_header(frames)
        except MediaError:
            self.close()
            raise
        self.frames = len(self._header.sizes)
        self.facts = _facts(self._header.clip, frames=self.frames)

    @property
    def clip(self) -> StoredClip:
        """What the depth video was."""
        return self._header.clip

    def chunk(self, index: int) -> bytes:
        """Return the compressed bytes of a frame, empty for one of zeros.

        Raises:
            MediaError: If there is no such frame, or its bytes are not those that were packed.
        """
        if not 0 <= index < self.frames:
            raise MediaError(
                f"{self.name}: has no frame {index}: ask for one of 0 to {self.frames - 1}."
            )
        size = self._header.sizes[index]
        if size == 0:
            return b""
        self._file.seek(self._header.offsets[index])
        chunk = self._file.read(size)
        require_chunk(
            chunk,
            clip=self.clip,
            crc32=self._header.crc32s[index],
            name=f"{self.name}: frame {index}",
        )
        return chunk

    def units(self, index: int) -> UInt16[np.ndarray, "h w"]:
        """Return the stored numbers of a frame, in a new array.

        Raises:
            MediaError: If there is no such frame, or it does not decompress.
        """
        shape = (self.clip.height_px, self.clip.width_px)
        chunk = self.chunk(index)
        if not chunk:
            return np.zeros(shape, dtype=np.uint16)
        units = np.empty(shape, dtype=np.uint16)
        try:
            self._blosc2.decompress2(chunk, dst=units, nthreads=self._threads)
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

    def __enter__(self) -> "DepthFrames":
        """Return the reader itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the reader."""
        self.close()

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled: an open file belongs to its process."""
        raise TypeError(
            f"{self.name}: an open DepthFrames cannot be pickled: "
            f"pass the path to the other process and open it there."
        )

    def _read_header(self, frames: int | Literal["any"]) -> FrameHeader:
        file_bytes = self._file.seek(0, 2)
        self._file.seek(0)
        start = self._file.read(FIXED_BYTES)
        size = header_bytes(
            start, frames=MOST_FRAMES if frames == "any" else frames, name=self.name
        )
        if size > len(start):
            start += self._file.read(size - len(start))
        if len(start) < size:
            raise MediaError(
                f"{self.name}: is cut short: its header has {size} bytes, and only {len(start)} "
                f"are there: fetch it again."
            )
        header = parse_header(start[:size], file_bytes=file_bytes, name=self.name)
        if frames not in ("any", len(header.sizes)):
            raise MediaError(
                f"{self.name}: holds {len(header.sizes)} frames where {frames} are expected. "
                f"It belongs to another scene: fetch it again."
            )
        if header.clip.frame_bytes > LARGEST_FRAME_BYTES:
            raise MediaError(
                f"{self.name}: claims frames of {header.clip.width_px}x{header.clip.height_px} "
                f"pixels, {header.clip.frame_bytes:,} bytes each, and at most "
                f"{LARGEST_FRAME_BYTES:,} are read: it is no depth of this release."
            )
        return header


def probe_packed(file: VideoFile, *, name: str) -> StreamFacts:
    """Return what packed depth is, from its header.

    Raises:
        ExtraError: If blosc2 is not installed.
        MediaError: If the header was damaged.
    """
    with DepthFrames(file, name=name, frames="any") as depth:
        return depth.facts


def _facts(clip: StoredClip, *, frames: int) -> StreamFacts:
    return StreamFacts(
        codec=CODEC_NAME,
        pixel_format=clip.pixel_format,
        width_px=clip.width_px,
        height_px=clip.height_px,
        frames=frames,
        frame_rate_hz=clip.rate[0] / clip.rate[1],
        tags=merged_tags(clip.tags, clip.stream_tags),
        is_colour=False,
    )
