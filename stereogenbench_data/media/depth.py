"""Stored depth: which streams keep it whole, its numbers, what they mean, and how it is packed.

A depth picture is read in the pixel format in which it is stored. FFmpeg converts no number: its
conversion to 8 bits drops the low byte, and one between 10, 12 and 16 bits rescales.

Only FFV1 of one grey plane is packed as it is: of such a video the stored numbers are all there is.
"""

import hashlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Final, Literal, cast, get_args

import av
import numpy as np
from av.video.stream import VideoStream
from jaxtyping import Bool, Float32, Shaped, UInt16

from stereogenbench_data.errors import MediaError, SchemaError
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import planar_from_ray
from stereogenbench_data.media.container import (
    LOSSLESS_SUFFIX,
    StreamFacts,
    VideoFile,
    codec_of,
    depth_coding,
    exact,
    open_container,
    text_tags,
)
from stereogenbench_data.media.depth_frames import (
    PACKED_SUFFIX,
    DepthFrames,
    StoredClip,
    compressed_chunk,
    frame_file,
)
from stereogenbench_data.media.video import RED_GREEN_BLUE, VideoReader, plane_numbers
from stereogenbench_data.schema.depth_contract import Statement, agreed, stated_in_tags
from stereogenbench_data.schema.records import DepthEncoding, DepthRisk
from stereogenbench_data.schema.release import DEFAULT_DEPTH_UNIT_M

ANY_DEPTH: Final = DepthEncoding(accept=frozenset(get_args(DepthRisk)))
"""A contract that takes any stream with one number a pixel."""
_ANY_BITS: Final = DepthEncoding(accept=ANY_DEPTH.accept - {"lossy", "chroma"})
_FFV1_OPTIONS: Final = {"level": "3", "slices": "4", "slicecrc": "1"}

NO_DEPTH_UNIT: Final = "its files do not tell how many metres a stored unit of depth has"
DEPTH_CURES: Final = (
    "State what `stereogenbench doctor ROOT` measures: pass DepthEncoding(unit_m=...), or write "
    "unit_m below [depth] in a file for --conventions. Or correct the files and index them again."
)
"""What to do where no unit is known."""

_NUMBER_FORMAT: Final = re.compile(
    r"(?P<kind>gray|yuvj?\d{3}p)(?P<bits>9|10|12|14|16)?(?P<order>le|be)?"
)
_COLOUR_FORMAT: Final = re.compile(
    r"(?P<planes>gbrp|gbrap)(?P<bits>9|10|12|14|16)?(?P<order>le|be)?|"
    r"(?P<packed>[rgba0]{3,4})(?:24|(?P<wide>48|64)(?:le|be))?"
)


@dataclass(frozen=True, slots=True)
class DepthLayout:
    """How a pixel format stores depth: ``bits`` a number, channels of ``dtype``.

    Attributes:
        bits: Bits of a stored number.
        has_chroma: Whether there are chroma planes, which are not read.
        dtype: The type of a channel in a plane of its own.
        is_colour: Whether there are channels of red, green and blue.
    """

    bits: int
    has_chroma: bool
    dtype: str
    is_colour: bool = False


@cache
def _layout(pixel_format: str) -> DepthLayout | None:
    """Return where a pixel format holds the numbers of a pixel, None if it cannot hold them."""
    match = _NUMBER_FORMAT.fullmatch(pixel_format)
    if match is not None:
        dtype = _dtype(match["bits"], match["order"])
        return DepthLayout(int(match["bits"] or 8), match["kind"] != "gray", dtype)
    match = _COLOUR_FORMAT.fullmatch(pixel_format)
    if match is None:
        return None
    if match["planes"]:
        bits = int(match["bits"] or 16)  # two channels of 8
        dtype = _dtype(match["bits"], match["order"])
        return DepthLayout(bits, has_chroma=False, dtype=dtype, is_colour=True)
    packed = match["packed"]
    if not {"r", "g", "b"} <= set(packed) or len(set(packed)) != len(packed):
        return None
    return DepthLayout(16, has_chroma=False, dtype=_dtype(match["wide"], "le"), is_colour=True)


def _dtype(bits: str | None, order: str | None) -> str:
    return "u1" if bits is None else ">u2" if order == "be" else "<u2"


def grey_format(pixel_format: str) -> str:
    """Return the pixel format of one grey plane that holds the numbers of a depth stream.

    >>> grey_format("gray12be"), grey_format("yuv420p10le"), grey_format("bgr0")
    ('gray12be', 'gray10le', 'gray16le')
    """
    layout = _layout(pixel_format)
    if layout is None or not (layout.is_colour or layout.has_chroma):
        return pixel_format
    return "gray" if layout.bits == 8 else f"gray{layout.bits}le"


def require_depth_stream(
    *, codec: str, pixel_format: str, encoding: DepthEncoding, name: str
) -> DepthLayout:
    """Return how a stream stores 16-bit depth whole, or otherwise if the encoding accepts it.

    Args:
        codec: What `depth_coding` returns.
        pixel_format: FFmpeg's name of the stored pixel format.
        encoding: The depth encoding.
        name: What messages call the file.

    Raises:
        MediaError: If the stream cannot hold numbers, or has a risk (fewer than 16 bits, a lossy
            codec, chroma planes) that ``encoding.accept`` does not name.
    """
    layout = _layout(pixel_format)
    stored = f"{name}: depth is stored by codec {codec} as {pixel_format}"
    is_lossy = not codec_of(codec).is_lossless and not codec.endswith(LOSSLESS_SUFFIX)
    if layout is None or (layout.is_colour and is_lossy):
        why = "which is not one number of 8 to 16 bits a pixel"
        if layout is not None:
            why = "lossy, and depth in channels of colours survives only without loss"
        raise MediaError(
            f"{stored}, {why}: no DepthEncoding accepts it. Store depth as gray16le with FFV1."
        )
    if layout.is_colour and layout.dtype == "u1" and not encoding.channels and (
        encoding is not ANY_DEPTH
    ):  # fmt: skip
        raise MediaError(
            f"{stored}, channels of colours with 8 bits each: if two of them hold the high and the "
            f'low byte of a number, say which: DepthEncoding(channels="rg"), or channels = "rg" '
            f"below [depth] in a file for --conventions. Else store depth as gray16le with FFV1."
        )
    risks = {
        f"{layout.bits}-bit": layout.bits < 16,
        "lossy": is_lossy,
        "chroma": layout.has_chroma,
    }
    refused = [risk for risk, present in risks.items() if present and risk not in encoding.accept]
    if refused:
        accept = ", ".join(repr(risk) for risk in sorted({*encoding.accept, *refused}))
        rescaled = (
            f" If it was 16-bit before, its numbers were divided by {1 << (16 - layout.bits)}, and "
            f"a stated unit no longer holds: `stereogenbench doctor ROOT` measures it."
            if layout.bits < 16
            else ""
        )
        raise MediaError(
            f"{stored} ({', '.join(refused)}), which does not keep depth whole. Store it as "
            f"gray16le with FFV1; if this is intended, pass "
            f"DepthEncoding(accept=frozenset({{{accept}}})), by command --accept, with "
            f"unit_m=... if the file does not tell its unit; or write both below [depth] in a file "
            f"for --conventions.{rescaled}"
        )
    return layout


def open_video(file: VideoFile, *, name: str, frames: int) -> VideoReader | DepthFrames:
    """Open a video that must have so many frames; by its name it may be depth packed by blosc2.

    Raises:
        StorageError: If the file cannot be read.
        MediaError: If it is not what its name says, or has another number of frames.
        ExtraError: If blosc2 is needed and not installed.
    """
    reader = DepthFrames if name.endswith(PACKED_SUFFIX) else VideoReader
    return reader(file, name=name, frames=frames)


def read_depth_units(
    reader: VideoReader | DepthFrames, index: int, *, encoding: DepthEncoding
) -> UInt16[np.ndarray, "h w"]:
    """Return the numbers of a depth frame as they are stored, bit for bit.

    Args:
        reader: An open depth video, or depth packed by blosc2.
        index: Which frame of the file, from 0; `depth_frame_index` tells which an RGB frame needs.
        encoding: The depth encoding, which decides what streams are accepted.

    Returns:
        uint16 (h, w), in stored units; read-only, of the decoded picture's own memory where that
        holds them so.

    Raises:
        MediaError: If the stream is refused (see `require_depth_stream`) or does not decode.
    """
    facts = reader.facts
    layout = require_depth_stream(
        codec=depth_coding(facts),
        pixel_format=facts.pixel_format,
        encoding=encoding,
        name=reader.name,
    )
    if isinstance(reader, DepthFrames):
        return reader.units(index)
    if layout.is_colour:
        units = _units_of_channels(reader, index, layout, encoding)
    else:
        numbers = plane_numbers(reader.frame(index), 0, dtype=layout.dtype)
        units = numbers.astype(np.uint16, copy=False)
    units.flags.writeable = False
    return units


def _units_of_channels(
    reader: VideoReader, index: int, layout: DepthLayout, encoding: DepthEncoding
) -> UInt16[np.ndarray, "h w"]:
    """Return depth of three equal channels, or of its high and low byte in two of them."""
    red, green, blue = channels = _channels(reader, index, layout)
    if layout.dtype == "u1":
        high, low = ("rgb".index(each) for each in encoding.channels or "rg")
        other = channels[3 - high - low]
        if encoding is not ANY_DEPTH and not (other == other.flat[0]).all():
            raise _not_numbers(reader.name, f"frame {index} has a third channel with numbers")
        both: UInt16[np.ndarray, "h w"] = channels[high].astype(np.uint16) << 8 | channels[low]
        return both
    if not (np.array_equal(red, green) and np.array_equal(green, blue)):
        raise _not_numbers(reader.name, f"frame {index} has different numbers in its channels")
    return red.astype(np.uint16)


def _channels(
    reader: VideoReader, index: int, layout: DepthLayout
) -> tuple[Shaped[np.ndarray, "h w"], ...]:
    """Return the red, green and blue channel of a frame."""
    frame = reader.frame(index)
    if len(frame.planes) == 1:  # the numbers are moved to planes, and stay as they are
        planar = "gbrp" if layout.dtype == "u1" else "gbrp16le"
        frame = reader.scaler.reformat(frame, format=planar, threads=1)
    return tuple(plane_numbers(frame, plane, dtype=layout.dtype) for plane in RED_GREEN_BLUE)


def _not_numbers(name: str, why: str) -> MediaError:
    return MediaError(
        f"{name}: depth is stored in channels of colours, and {why}: they are neither three equal "
        f"channels nor the high and the low byte of a number. Store depth as gray16le with FFV1."
    )


def stated_unit(
    facts: StreamFacts, *, name: str, stated: Sequence[Statement] = ()
) -> tuple[float, Literal["tag", "metadata", "default"]]:
    """Return the metres in a stored unit of a depth stream, and what states it.

    Tags of the container and the stream and the scene's JSON are read as `depth_contract` reads
    them; all must agree. Where nothing is stated the release's default holds, 0.1 m.

    Args:
        facts: What `probe` found.
        name: What messages call the file.
        stated: What the scene's JSON says.

    Raises:
        MediaError: If what is stated is not understood, or contradicts itself.

    Source: the paper's appendix on the file schema.
    """
    try:
        found = agreed([*stated_in_tags(facts.tags, name=name), *stated])
    except SchemaError as error:
        raise MediaError(f"{error}. {DEPTH_CURES}") from error
    return found or (DEFAULT_DEPTH_UNIT_M, "default")


def measured(
    units: UInt16[np.ndarray, "*batch h w"], *, encoding: DepthEncoding, pixel_format: str
) -> Bool[np.ndarray, "*batch h w"]:
    """Return where depth was measured: where the stored number is none of ``encoding.no_depth``.

    Args:
        units: Stored numbers.
        encoding: The depth encoding.
        pixel_format: FFmpeg's name of the stored pixel format: "max" is its largest number.
    """
    layout = _layout(pixel_format)
    largest = None if layout is None else (1 << layout.bits) - 1
    answer = np.ones(units.shape, dtype=np.bool_)
    for number in encoding.no_depth:
        answer &= units != (largest if number == "max" else number)
    return answer


def depth_m_from_units(
    units: UInt16[np.ndarray, "*batch h w"],
    *,
    measured: Bool[np.ndarray, "*batch h w"],
    encoding: DepthEncoding,
    intrinsics: Intrinsics,
) -> Float32[np.ndarray, "*batch h w"]:
    """Return depth along the optical axis in metres, 0 where it was not measured.

    Args:
        units: Stored numbers.
        measured: Where depth was measured, see `measured`.
        encoding: The depth encoding.
        intrinsics: The camera of this picture, used for ``kind="ray"``.

    Returns:
        float32, the float64 result rounded once. With ``form="inverse"`` a measured 0 is inf.
    """
    unit_m = encoding.known_unit_m
    depth_m = np.empty(units.shape, dtype=np.float32)
    if encoding.form == "depth" and encoding.offset_m:
        np.add(units * np.float64(unit_m), encoding.offset_m, out=depth_m, casting="same_kind")
        depth_m *= measured
    elif encoding.form == "depth":
        np.multiply(units, unit_m, out=depth_m, dtype=np.float64, casting="same_kind")
        depth_m *= measured
    else:
        with np.errstate(divide="ignore"):
            np.divide(unit_m, units, out=depth_m, dtype=np.float64, casting="same_kind")
        depth_m[~measured] = 0
    if encoding.kind == "ray":
        planar_m: Float32[np.ndarray, "*batch h w"] = planar_from_ray(depth_m, intrinsics)
        return planar_m
    return depth_m


def depth_frame_index(index: int, *, encoding: DepthEncoding, frames: int) -> int | None:
    """Return which depth frame belongs to an RGB frame, None where the video has no such frame."""
    lagged = index + encoding.frame_lag
    return lagged if 0 <= lagged < frames else None


def resized_nearest(
    maps: Shaped[np.ndarray, "*batch h w"], *, size: tuple[int, int]
) -> Shaped[np.ndarray, "*batch h2 w2"]:
    """Return maps at another size by the nearest pixel centre, never averaged across an edge.

    Pixel i of n takes the source pixel that holds the centre (i + 0.5) * source / n: what torch
    calls nearest-exact. Maps of that size are returned as they are.
    """
    if maps.shape[-2:] == size:
        return maps
    rows, columns = (
        np.minimum((np.arange(wanted) + 0.5) * found / wanted, found - 1).astype(np.intp)
        for wanted, found in zip(size, maps.shape[-2:], strict=True)
    )
    return np.ascontiguousarray(maps[..., rows[:, None], columns])


# Packed by blosc2, and back.


def packed_depth(
    video: VideoFile,
    *,
    name: str,
    frames: int,
    size: tuple[int, int] | None = None,
    encoding: DepthEncoding = _ANY_BITS,
) -> bytes:
    """Return a depth video as a file of blosc2's frames.

    Args:
        video: A path, or a seekable binary file; the latter stays the caller's to close.
        name: What messages call it. With a size, it may name depth that is packed already.
        frames: How many frames it must have.
        size: (height, width) to take the nearest pixels of, as `resized_nearest` does; None for
            the stored size.
        encoding: What streams are accepted (``accept``) beside those of any bits, whose numbers
            are kept.

    Raises:
        ExtraError: If blosc2 is not installed.
        MediaError: If the video cannot be decoded or is not FFV1 of one grey plane, or what was
            packed does not read back as it was.
    """
    accept = _ANY_BITS.accept | encoding.accept
    accepted = replace(_ANY_BITS, accept=accept, channels=encoding.channels)
    chunks, digests, pts = [], [], []
    with open_video(video, name=name, frames=frames) as reader:
        facts = reader.facts
        if size is None and (facts.codec != "ffv1" or not facts.pixel_format.startswith("gray")):
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
    """Return depth in stored units as a frame of one grey plane."""
    numbers = units.astype(np.uint8) if pixel_format == "gray" else units
    return av.VideoFrame.from_ndarray(numbers, format=pixel_format)
