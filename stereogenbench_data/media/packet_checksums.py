"""Checksums that a video holds of its own packets, so that a single frame is checked as it is read.

A decoder of H.264 or JPEG shows something for most damaged packets, without a word. So videos of
training shards hold, in the tag ``comment``, the CRC-32 of what their header says of the pictures
and of each packet in the order of the file. Videos without that tag are read unchecked.
"""

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from av.container import InputContainer

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import open_container

TAG: Final = "comment"
_BEGIN: Final = "CRC-32 of header and packets: "
_DIGITS: Final = 8


def reserved_checksums(packets: int) -> str:
    """Return the tag of a video that is about to be written: as long as the one it will have."""
    return _BEGIN + "-" * (packets + 1) * _DIGITS


def write_checksums(video: Path, *, packets: int) -> None:
    """Put the checksums of a video that was just written into the place reserved for them.

    Raises:
        MediaError: If it has another number of packets, or no place is reserved.
        OSError: If it cannot be read or written.
    """
    with open_container(video, name=str(video), pixel_format="later") as container:
        found = [_header_crc32(container)]
        stream = container.streams.video[0]
        found += [zlib.crc32(bytes(packet)) for packet in container.demux(stream) if packet.size]
    content, reserved = video.read_bytes(), reserved_checksums(packets).encode()
    if len(found) != packets + 1 or content.count(reserved) != 1:
        raise MediaError(
            f"{video}: {len(found) - 1} packets were written where {packets} are expected, or "
            f"their checksums have no place. Check the version of PyAV, then write it again."
        )
    tag = _BEGIN + "".join(f"{crc32:0{_DIGITS}x}" for crc32 in found)
    video.write_bytes(content.replace(reserved, tag.encode()))


def packet_checksums(container: InputContainer, *, frames: int, name: str) -> Sequence[int]:
    """Return the CRC-32 of each packet that an open video holds; empty if it holds none.

    Raises:
        MediaError: If the header of the video is not the one that was written, or is of another
            number of frames.
    """
    digits = container.metadata.get(TAG, "").removeprefix(_BEGIN)
    if digits == container.metadata.get(TAG, ""):
        return ()
    try:
        crc32s: list[int] = np.frombuffer(bytes.fromhex(digits), dtype=">u4").tolist()
        header, *packets = crc32s
    except ValueError:
        header, packets = -1, []
    if header != _header_crc32(container):
        raise MediaError(
            f"{name}: its header is not the one that was written with it. The file is damaged: "
            f"compare it with its checksum, or fetch it again."
        )
    if len(packets) != frames:
        raise MediaError(
            f"{name}: holds {len(packets)} frames where {frames} are expected. It belongs to "
            f"another scene: fetch it again."
        )
    return packets


def _header_crc32(container: InputContainer) -> int:
    """Return a checksum of what a header says of the pictures, read without decoding one."""
    context = container.streams.video[0].codec_context
    said = (context.codec.canonical_name, context.width, context.height)
    return zlib.crc32(bytes(context.extradata or b""), zlib.crc32(repr(said).encode()))
