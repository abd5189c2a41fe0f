"""Where the chroma samples of a video lie between its pixels, and conversions that respect it.

Subsampled chroma is read as lying in the middle of its pixels ("center") unless the file says
otherwise: that is what FFmpeg's conversion at the stored size does. FFmpeg's decoders of H.264 and
HEVC report "left" for files that say nothing, so for these the sequence parameter set is read.

Source: ITU-T H.264 (08/2021), 7.3.2.1.1 and annex E; ITU-T H.265 (08/2021), 7.3.2.2 and annex E.
"""

from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np
from av.filter import Graph
from av.filter.context import FilterContext
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation

CENTRE: Final = "center"
_SITINGS: Final = ("left", CENTRE, "topleft", "top", "bottomleft", "bottom")
"""FFmpeg's names, in the order of chroma_sample_loc_type."""

_SAYS_NOTHING: Final = frozenset(
    {"flv1", "h261", "h263", "h263p", "mpeg1video", "mpeg2video", "mpeg4", "msmpeg4v3", "wmv2"}
)
"""Codecs with no field for the siting, to which FFmpeg's decoders give one of their own."""

_HIGH_PROFILES: Final = frozenset({44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244})
_EXTENDED_ASPECT: Final = 255
_GREY: Final = 0
_SEPARATE_PLANES: Final = 3
_PROFILE_BITS: Final = 88
_H264_SEQUENCE: Final = 7
_HEVC_SEQUENCE: Final = 33
_HEVC_PICTURE: Final = 34


class Converter:
    """FFmpeg's scale filter for pictures of one kind after another; its tables are kept."""

    def __init__(self) -> None:
        """Begin without tables."""
        self._key: tuple[object, ...] = ()
        self._graph = Graph()
        self._ends: tuple[FilterContext, FilterContext] | None = None

    def convert(
        self,
        frame: VideoFrame,
        *,
        size: tuple[int, int],
        pixel_format: str,
        flags: str,
        siting: str,
    ) -> VideoFrame:
        """Return a picture at another (height, width) and in another pixel format.

        Args:
            frame: Any picture.
            size: (height, width).
            pixel_format: FFmpeg's name.
            flags: What the scaler does, such as "area" or "bicubic+accurate_rnd".
            siting: Where the picture's chroma lies: "center", "left", "topleft", ...
        """
        key = (
            frame.width, frame.height, frame.format.name, frame.colorspace, frame.color_range,
            size, pixel_format, flags, siting,
        )  # fmt: skip
        if self._ends is None or key != self._key:
            graph = Graph()
            graph.threads = 1
            first = graph.add(
                "buffer",
                video_size=f"{frame.width}x{frame.height}",
                pix_fmt=frame.format.name,
                time_base=str(Fraction(1, 1000)),
                colorspace=str(int(frame.colorspace)),
                range=str(int(frame.color_range)),
            )
            scale = graph.add(
                "scale", f"w={size[1]}:h={size[0]}:flags={flags}:in_chroma_loc={siting}"
            )
            last = graph.add("buffersink")
            graph.link_nodes(first, scale, graph.add("format", pixel_format), last).configure()
            self._key, self._graph, self._ends = key, graph, (first, last)
        self._ends[0].push(frame)
        picture = self._ends[1].pull()
        assert isinstance(picture, VideoFrame)
        return picture


def is_subsampled(frame: VideoFrame) -> bool:
    """Return whether a picture has fewer chroma samples than pixels."""
    planes = frame.format
    return planes.chroma_width(16) < 16 or planes.chroma_height(16) < 16


def picture_siting(frame: VideoFrame) -> str:
    """Return where a picture's chroma lies by its own tag, "center" for one without.

    PyAV does not show the tag, but its reformatter follows it. So a small picture with the same
    tag is converted by the reformatter, and compared with conversions for each place.
    """
    small = frame.reformat(width=16, height=16, format="yuv420p", threads=1)
    ramp = np.arange(64, dtype=np.uint8).reshape(8, 8)
    for number, plane in enumerate(small.planes):
        rows = np.full((plane.height, plane.line_size), 128, dtype=np.uint8)
        if number:
            rows[:, :8] = 64 + 2 * ramp
        plane.update(rows.tobytes())
    tagged = small.reformat(
        width=32, height=32, format="yuv444p", interpolation=Interpolation.BILINEAR, threads=1
    ).to_ndarray()
    for siting in _SITINGS:
        converted = Converter().convert(
            small, size=(32, 32), pixel_format="yuv444p", flags="bilinear", siting=siting
        )
        if np.array_equal(converted.to_ndarray(), tagged):
            return siting
    return CENTRE


@dataclass(slots=True)
class CodedPicture:
    """What a codec's header says of its pictures.

    Attributes:
        siting: Where their chroma lies, "center" if the header does not say; None for codecs whose
            pictures carry it (`picture_siting`).
        has_chroma: Whether they have chroma, None where it does not say: FFmpeg decodes grey H.264
            to yuv420p whose chroma it makes up.
        is_lossless: Whether H.264 or HEVC is coded without loss. In H.264 that is the sequence's
            flag for transform bypass, which encoders set where they code with a quantiser of 0; in
            HEVC the pictures' flag for transquant bypass, unless the encoder writes that it chooses
            for each block.
    """

    siting: str | None
    has_chroma: bool | None = None
    is_lossless: bool = False


def coded_picture(codec: str, extradata: bytes | None) -> CodedPicture:
    """Return what a codec's header says as far as it can be read, by FFmpeg's name of the codec."""
    if codec not in ("h264", "hevc"):
        return CodedPicture(CENTRE if codec in _SAYS_NOTHING else None)
    found = CodedPicture(CENTRE)
    units = _units(codec, extradata or b"")
    if codec == "h264":
        sequences = [unit for unit in units if unit[0] & 31 == _H264_SEQUENCE]
        walk = _read_h264_sequence
    else:
        sequences = [unit for unit in units if unit[0] >> 1 & 63 == _HEVC_SEQUENCE]
        walk = _read_hevc_sequence
        pictures = [unit for unit in units if unit[0] >> 1 & 63 == _HEVC_PICTURE]
        chooses = any(b" cu-lossless" in unit for unit in units)
        with suppress(EOFError):
            found.is_lossless = (
                bool(pictures) and not chooses and all(map(_has_hevc_bypass, map(_Bits, pictures)))
            )
    with suppress(EOFError):
        for sequence in sequences[:1]:
            place = walk(_Bits(sequence), found)
            if place is not None and place < len(_SITINGS):
                found.siting = _SITINGS[place]
    return found


def _has_hevc_bypass(bits: "_Bits") -> bool:
    bits.skip(16, 0, 0, 1, 1, 3, 1, 1, 0, 0, 0, 1, 1)
    if bits.take():
        bits.skip(0)
    bits.skip(0, 0, 1, 1, 1)
    return bool(bits.take())


def _units(codec: str, extradata: bytes) -> list[bytes]:
    """Return the units (NAL) of a codec's header, as MP4 and Matroska or a raw stream keep them."""
    if extradata[:1] != b"\1":
        parts = extradata.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")
        return [part for part in parts if part]
    units = []
    if codec == "h264":
        at, arrays = 6, [extradata[5] & 31 if len(extradata) > 5 else 0]
    else:
        at, arrays = 23, [0] * (extradata[22] if len(extradata) > 22 else 0)
    for known in arrays:
        count = known
        if codec == "hevc":
            count, at = int.from_bytes(extradata[at + 1 : at + 3], "big"), at + 3
        for _ in range(count):
            size = int.from_bytes(extradata[at : at + 2], "big")
            unit = extradata[at + 2 : at + 2 + size]
            at += 2 + size
            if unit:
                units.append(unit)
    return units


class _Bits:
    """The bits of a unit, from the most significant on."""

    def __init__(self, unit: bytes) -> None:
        content = unit.replace(b"\0\0\3", b"\0\0")
        self._bits = int.from_bytes(content, "big")
        self._left = len(content) * 8

    def take(self, count: int = 1) -> int:
        """Return the next bits as a number."""
        self._left -= count
        if self._left < 0:
            raise EOFError
        return self._bits >> self._left & ((1 << count) - 1)

    def golomb(self) -> int:
        """Return an Exp-Golomb number, ue(v) or, as far as its length matters, se(v)."""
        zeros = 0
        while not self.take():
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)

    def signed(self) -> int:
        """Return a signed Exp-Golomb number, se(v)."""
        number = self.golomb()
        return (number + 1) // 2 if number % 2 else -(number // 2)

    def skip(self, *counts: int) -> None:
        """Pass over numbers by their widths in bits; a width of 0 is an Exp-Golomb number."""
        for count in counts:
            _ = self.take(count) if count else self.golomb()


def _vui_siting(bits: _Bits) -> int | None:
    """Return chroma_sample_loc_type of the top field from usability information."""
    if bits.take() and bits.take(8) == _EXTENDED_ASPECT:
        bits.skip(16, 16)
    if bits.take():
        bits.skip(1)
    if bits.take():
        bits.skip(3, 1)
        if bits.take():
            bits.skip(8, 8, 8)
    return bits.golomb() if bits.take() else None


def _read_h264_sequence(bits: _Bits, found: CodedPicture) -> int | None:
    """Read what `CodedPicture` holds; return the number of the siting, None without one."""
    bits.skip(8)
    profile = bits.take(8)
    bits.skip(8, 8, 0)
    if profile not in _HIGH_PROFILES:
        found.has_chroma = True
    else:
        chroma = bits.golomb()
        found.has_chroma = chroma != _GREY
        bits.skip(*([1] if chroma == _SEPARATE_PLANES else []), 0, 0)
        found.is_lossless = bool(bits.take())
        if bits.take():
            for number in range(12 if chroma == _SEPARATE_PLANES else 8):
                if bits.take():
                    _skip_scaling_list(bits, 16 if number < 6 else 64)
    bits.skip(0)
    order = bits.golomb()
    if order == 0:
        bits.skip(0)
    elif order == 1:
        bits.skip(1, 0, 0)
        bits.skip(*[0] * min(bits.golomb(), 255))
    bits.skip(0, 1, 0, 0)
    if not bits.take():
        bits.skip(1)
    bits.skip(1)
    if bits.take():
        bits.skip(0, 0, 0, 0)
    return _vui_siting(bits) if bits.take() else None


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last, following = 8, 8
    for _ in range(size):
        if following:
            following = (last + bits.signed()) % 256
        last = following or last


def _read_hevc_sequence(bits: _Bits, found: CodedPicture) -> int | None:
    """Read what `CodedPicture` holds; return the number of the siting, None without one."""
    layers = _skip_hevc_profiles(bits)
    chroma = bits.golomb()
    found.has_chroma = chroma != _GREY
    if chroma == _SEPARATE_PLANES:
        bits.skip(1)
    bits.skip(0, 0)
    if bits.take():
        bits.skip(0, 0, 0, 0)
    bits.skip(0, 0)
    order_bits = bits.golomb() + 4
    for _ in range(0 if bits.take() else layers, layers + 1):
        bits.skip(0, 0, 0)
    bits.skip(0, 0, 0, 0, 0, 0)
    if bits.take() and bits.take():
        _skip_hevc_scaling_lists(bits)
    bits.skip(1, 1)
    if bits.take():
        bits.skip(4, 4, 0, 0, 1)
    deltas = 0
    for number in range(min(bits.golomb(), 64)):
        deltas = _skip_reference_set(bits, deltas, is_first=number == 0)
    if bits.take():
        for _ in range(min(bits.golomb(), 32)):
            bits.skip(order_bits, 1)
    bits.skip(1, 1)
    return _vui_siting(bits) if bits.take() else None


def _skip_hevc_profiles(bits: _Bits) -> int:
    """Pass over all before chroma_format_idc; return how many layers there are beside the first."""
    bits.skip(16, 4)
    layers = bits.take(3)
    # Profile, tier and level, of the whole and of each layer.
    bits.skip(1, _PROFILE_BITS, 8)
    present = [(bits.take(), bits.take()) for _ in range(layers)]
    if layers:
        bits.skip(2 * (8 - layers))
    for has_profile, has_level in present:
        bits.skip(*[_PROFILE_BITS] * has_profile, *[8] * has_level)
    bits.skip(0)
    return layers


def _skip_hevc_scaling_lists(bits: _Bits) -> None:
    for size in range(4):
        for _ in range(0, 6, 3 if size == 3 else 1):
            if not bits.take():
                bits.skip(0)
            else:
                bits.skip(*[0] * ((size > 1) + min(64, 1 << (4 + (size << 1)))))


def _skip_reference_set(bits: _Bits, deltas: int, *, is_first: bool) -> int:
    """Pass over a set of reference pictures; return how many it has."""
    if not is_first and bits.take():
        bits.skip(1, 0)
        return sum(bits.take() or bits.take() for _ in range(deltas + 1))
    count = bits.golomb() + bits.golomb()
    for _ in range(min(count, 32)):
        bits.skip(0, 1)
    return count
