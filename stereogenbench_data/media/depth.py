"""Stored depth: which streams keep it whole, its numbers as stored, and what they mean in metres.

A depth picture is read in the pixel format in which it is stored. No conversion is ever asked of
FFmpeg: its conversion to 8 bits drops the low byte, and one between 10, 12 and 16 bits rescales.
"""

import itertools
import math
import re
from dataclasses import dataclass, replace
from typing import Final, get_args

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt16

from stereogenbench_data.errors import MediaError
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import planar_from_ray
from stereogenbench_data.media.container import StreamFacts, VideoFile
from stereogenbench_data.media.depth_frames import CODEC_NAME, PACKED_SUFFIX, DepthFrames
from stereogenbench_data.media.video import VideoReader, plane_numbers
from stereogenbench_data.schema.records import DepthEncoding, DepthRisk
from stereogenbench_data.schema.release import DEFAULT_DEPTH_UNIT_M
from stereogenbench_data.schema.text import shortened

_LOSSLESS_CODECS: Final = frozenset(
    {CODEC_NAME, "ffv1", "ffvhuff", "huffyuv", "png", "rawvideo", "utvideo"}
)
"""Codecs that return what they were given, whatever their settings."""

_TAGS_SHOWN: Final = 4

ANY_DEPTH: Final = DepthEncoding(accept=frozenset(get_args(DepthRisk)))
"""A contract that takes whatever holds one number a pixel."""

_NUMBER_FORMAT: Final = re.compile(
    r"(?P<kind>gray|yuvj?\d{3}p)(?P<bits>9|10|12|14|16)?(?P<order>le|be)?"
)


def resolve_encoding(
    facts: StreamFacts, *, name: str, override: DepthEncoding | None = None
) -> DepthEncoding:
    """Return how a depth stream's numbers become metres: as the user says, else as it is tagged.

    A tag is one whose key contains "scale", in any case, of the container or of the stream; its
    value is metres in a stored unit. Without such a tag the release's default holds, 0.1 m. If one
    such tag is a number, others that are not numbers are ignored.

    Args:
        facts: What `probe` found.
        name: What messages call the file.
        override: The user's contract, which holds whatever the tags say.

    Raises:
        MediaError: If a tag is not a positive number, or two tags disagree.

    Source: the paper's appendix on the file schema.
    """
    if override is not None and override.unit_m is not None:
        return replace(override, source="user")
    contract = override or DepthEncoding()
    scales = {key: value for key, value in facts.tags.items() if "scale" in key}
    if not scales:
        return contract.with_file_unit(DEFAULT_DEPTH_UNIT_M, source="default")
    units_m = {unit_m for value in scales.values() if (unit_m := _unit_m(value)) is not None}
    if len(units_m) != 1:
        tags = (f"{shortened(key)}={shortened(value)!r}" for key, value in sorted(scales.items()))
        found = ", ".join(itertools.islice(tags, _TAGS_SHOWN))
        raise MediaError(
            f"{name}: its tags must give one positive number of metres for a stored unit of depth, "
            f"found {found}: correct the tags, or pass DepthEncoding(unit_m=...)."
        )
    return contract.with_file_unit(units_m.pop(), source="tag")


def _unit_m(value: str) -> float | None:
    try:
        unit_m = float(value)
    except ValueError:
        return None
    return unit_m if math.isfinite(unit_m) and unit_m > 0 else None


@dataclass(frozen=True, slots=True)
class DepthLayout:
    """How a pixel format stores depth: ``bits`` a number, in a plane of ``dtype``."""

    bits: int
    has_chroma: bool
    dtype: str


def _layout(pixel_format: str) -> DepthLayout | None:
    """Return where a pixel format holds one number a pixel, None where it stores colours."""
    match = _NUMBER_FORMAT.fullmatch(pixel_format)
    if match is None:
        return None
    bits = int(match["bits"] or 8)
    dtype = "u1" if bits == 8 else ">u2" if match["order"] == "be" else "<u2"
    return DepthLayout(bits, has_chroma=match["kind"] != "gray", dtype=dtype)


def require_depth_stream(
    *, codec: str, pixel_format: str, encoding: DepthEncoding, name: str
) -> DepthLayout:
    """Return how a stream stores 16-bit depth whole, or otherwise if the encoding accepts it.

    Raises:
        MediaError: If the stream stores colours, or has a risk (fewer than 16 bits, a lossy codec,
            chroma planes) that ``encoding.accept`` does not name.
    """
    layout = _layout(pixel_format)
    stored = f"{name}: depth is stored by codec {codec} as {pixel_format}"
    if layout is None:
        raise MediaError(
            f"{stored}, which is not one number of 8 to 16 bits a pixel: no DepthEncoding accepts "
            f"it. Store depth as gray16le with FFV1."
        )
    risks = {
        f"{layout.bits}-bit": layout.bits < 16,
        "lossy": codec not in _LOSSLESS_CODECS,
        "chroma": layout.has_chroma,
    }
    refused = [risk for risk, present in risks.items() if present and risk not in encoding.accept]
    if refused:
        accept = ", ".join(repr(risk) for risk in sorted({*encoding.accept, *refused}))
        raise MediaError(
            f"{stored} ({', '.join(refused)}), which does not keep depth whole. Store it as "
            f"gray16le with FFV1; if this is intended, pass "
            f"DepthEncoding(accept=frozenset({{{accept}}})), with unit_m=... if the file does not "
            f"tell its unit."
        )
    return layout


def open_depth(file: VideoFile, *, name: str, frames: int) -> VideoReader | DepthFrames:
    """Open depth that must have so many frames: a video or, by its name, blosc2's frames of one.

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
        encoding: The depth contract, which decides what streams are accepted.

    Returns:
        uint16 (h, w), in stored units; read-only, of the decoded picture's own memory where that
        holds them so.

    Raises:
        MediaError: If the stream is refused (see `require_depth_stream`) or does not decode.
    """
    facts = reader.facts
    layout = require_depth_stream(
        codec=facts.codec, pixel_format=facts.pixel_format, encoding=encoding, name=reader.name
    )
    if isinstance(reader, DepthFrames):
        return reader.units(index)
    numbers = plane_numbers(reader.frame(index), 0, dtype=layout.dtype)
    units: UInt16[np.ndarray, "h w"] = numbers.astype(np.uint16, copy=False)
    units.flags.writeable = False
    return units


def measured(
    units: UInt16[np.ndarray, "*batch h w"], *, encoding: DepthEncoding, pixel_format: str
) -> Bool[np.ndarray, "*batch h w"]:
    """Return where depth was measured: where the stored number is none of ``encoding.no_depth``.

    Args:
        units: Stored numbers.
        encoding: The depth contract.
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
    intrinsics: Intrinsics | None = None,
) -> Float32[np.ndarray, "*batch h w"]:
    """Return depth along the optical axis in metres, 0 where it was not measured.

    Args:
        units: Stored numbers.
        measured: Where depth was measured, see `measured`.
        encoding: The depth contract.
        intrinsics: The camera of this picture; needed and used only for ``kind="ray"``.

    Returns:
        float32, the float64 result rounded once. With ``form="inverse"`` a measured 0 is inf.

    Raises:
        MediaError: If ray lengths are to be converted without intrinsics.
    """
    if encoding.kind == "ray" and intrinsics is None:
        raise MediaError(
            "depth of kind 'ray' becomes depth along the optical axis by the camera's intrinsics, "
            "got None: pass intrinsics=... of this picture."
        )
    unit_m = encoding.known_unit_m
    depth_m = np.empty(units.shape, dtype=np.float32)
    if encoding.form == "depth":
        np.multiply(units, unit_m, out=depth_m, dtype=np.float64, casting="same_kind")
        depth_m *= measured
    else:
        with np.errstate(divide="ignore"):
            np.divide(unit_m, units, out=depth_m, dtype=np.float64, casting="same_kind")
        depth_m[~measured] = 0
    if encoding.kind == "ray" and intrinsics is not None:
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
