"""Depth videos to blosc2's frames, each of which is read again and compared, and back.

Only FFV1 of one grey plane is packed: of such a video the stored numbers are all there is.
"""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Final, cast

import av
import numpy as np
from av.video.stream import VideoStream
from jaxtyping import UInt16

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import (
    StreamFacts,
    VideoFile,
    depth_coding,
    exact,
    open_container,
    text_tags,
)
from stereogenbench_data.media.depth import (
    ANY_DEPTH,
    grey_format,
    open_video,
    read_depth_units,
    require_depth_stream,
    resized_nearest,
)
from stereogenbench_data.media.depth_frames import (
    DepthFrames,
    StoredClip,
    compressed_chunk,
    frame_file,
)
from stereogenbench_data.media.video import VideoReader
from stereogenbench_data.schema.records import DepthEncoding

_ANY_BITS: Final = DepthEncoding(accept=ANY_DEPTH.accept - {"lossy", "chroma"})
_FFV1_OPTIONS: Final = {"level": "3", "slices": "4", "slicecrc": "1"}


def packed_depth(
    video: VideoFile,
    *,
    name: str,
    frames: int,
    size: tuple[int, int] | None = None,
    encoding: DepthEncoding | None = None,
) -> bytes:
    """Return a depth video as a file of blosc2's frames.

    Args:
        video: A path, or a seekable binary file; the latter stays the caller's to close.
        name: What messages call it. With a size, it may name depth that is packed already.
        frames: How many frames it must have.
        size: (height, width) to take the nearest pixels of, as `resized_nearest` does; None for
            the stored size.
        encoding: With a size, what streams are accepted (``accept``); those of any bits always
            are, as their numbers are kept.

    Raises:
        ExtraError: If blosc2 is not installed.
        MediaError: If the video cannot be decoded or is not FFV1 of one grey plane, or what was
            packed does not read back as it was.
    """
    accepted = _ANY_BITS
    if size is not None and encoding is not None:
        accepted = replace(_ANY_BITS, accept=_ANY_BITS.accept | encoding.accept)
    chunks, digests, pts = [], [], []
    with open_video(video, name=name, frames=frames) as reader:
        facts = reader.facts
        layout = require_depth_stream(
            codec=depth_coding(facts),
            pixel_format=facts.pixel_format,
            encoding=accepted,
            name=name,
        )
        if size is None and (facts.codec != "ffv1" or layout.channels):
            raise MediaError(
                f"{name}: its depth is stored by codec {facts.codec} as {facts.pixel_format}, and "
                f"blosc2 packs only FFV1 of one grey plane. Pack with --depth-codec released."
            )
        for index in range(frames):
            units = read_depth_units(reader, index, encoding=accepted)
            if size is not None:
                units = resized_nearest(units, size=size)
            chunks.append(compressed_chunk(units.tobytes()))
            digests.append(_digest(units))
            if isinstance(reader, VideoReader):
                pts.append(reader.frame(index).pts or 0)
        clip = reader.clip if isinstance(reader, DepthFrames) else _clip_of(video, facts, pts=pts)
    if size is not None:
        height_px, width_px = size
        clip = replace(
            clip,
            width_px=width_px,
            height_px=height_px,
            codec="ffv1",
            pixel_format=grey_format(facts.pixel_format),
        )
    content = frame_file(clip, chunks)
    with DepthFrames(io.BytesIO(content), name=name, frames=frames) as packed:
        for index, digest in enumerate(digests):
            if _digest(packed.units(index)) != digest:
                raise MediaError(
                    f"{name}: frame {index} does not come back from blosc2 as it was. Check the "
                    f"memory of this machine and the version of blosc2, then pack again."
                )
    return content


def _digest(units: UInt16[np.ndarray, "h w"]) -> bytes:
    return hashlib.sha256(units.tobytes()).digest()


def _clip_of(video: VideoFile, facts: StreamFacts, *, pts: Sequence[int]) -> StoredClip:
    with open_container(video, name="") as container:
        stream = container.streams.video[0]
        time_base = exact(stream.time_base) or Fraction(1)
        rate = exact(stream.average_rate) or 1 / (time_base * max(pts[-1], 1))
        return StoredClip(
            width_px=facts.width_px,
            height_px=facts.height_px,
            codec=facts.codec,
            pixel_format=facts.pixel_format,
            rate=(rate.numerator, rate.denominator),
            time_base=(time_base.numerator, time_base.denominator),
            pts=tuple(pts),
            tags=text_tags(container.metadata),
            stream_tags=text_tags(stream.metadata),
        )


def write_depth_video(packed: DepthFrames, target: Path) -> None:
    """Write packed depth as a Matroska video by FFV1, with the tags and the times that it had.

    Its bytes are not those of the first: another encoder's name and settings stand in it.

    Raises:
        MediaError: If a frame cannot be read.
        OSError: If it cannot be written.
    """
    clip = packed.clip
    time_base = Fraction(*clip.time_base)
    options = {"fflags": "+bitexact"}
    with av.open(target, "w", format="matroska", container_options=options) as container:
        container.metadata.update(clip.tags)
        stream = cast(
            VideoStream,
            container.add_stream(clip.codec, rate=Fraction(*clip.rate), options=_FFV1_OPTIONS),
        )
        stream.metadata.update(clip.stream_tags)
        stream.width, stream.height = clip.width_px, clip.height_px
        stream.pix_fmt = clip.pixel_format
        stream.codec_context.thread_count = 1
        stream.codec_context.time_base = time_base
        stream.time_base = time_base
        for index, pts in enumerate(clip.pts):
            frame = grey_frame(packed.units(index), pixel_format=clip.pixel_format)
            frame.pts, frame.time_base = pts, time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def grey_frame(units: UInt16[np.ndarray, "h w"], *, pixel_format: str) -> av.VideoFrame:
    """Return depth in stored units as a frame, whose rows may be longer than the array's."""
    height, width = units.shape
    frame = av.VideoFrame(width, height, pixel_format)
    plane = frame.planes[0]
    numbers = units.astype("u1" if pixel_format == "gray" else "<u2")
    rows = np.zeros((height, plane.line_size // numbers.itemsize), numbers.dtype)
    rows[:, :width] = numbers
    plane.update(rows.tobytes())
    return frame
