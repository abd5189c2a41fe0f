"""Stored depth numbers come back bit for bit, and a stream that cannot keep them is refused."""

import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import depth_coding
from stereogenbench_data.media.depth import ANY_DEPTH, read_depth_units, require_depth_stream
from stereogenbench_data.media.video import VideoReader, probe
from stereogenbench_data.schema.records import DepthEncoding

HEIGHT, WIDTH = 30, 54  # rows that FFmpeg pads
HEVC = ("libx265", "-x265-params")


def noise(bits, dtype):
    values = np.random.default_rng(bits).integers(0, 1 << bits, (3, HEIGHT, WIDTH))
    values[:, 0, :2] = (0, (1 << bits) - 1)
    return values.astype(dtype)


@pytest.mark.parametrize(
    ("bits", "pixel_format", "codec"),
    [(9, "gray9le", "ffv1"), (12, "gray12le", "ffv1"), (16, "gray16le", "ffv1"),
     (16, "gray16be", "png")],
)  # fmt: skip
def test_every_number_survives(clips, bits, pixel_format, codec):
    pictures = noise(bits, ">u2" if pixel_format.endswith("be") else "<u2")
    how = {"pictures": pictures, "pixel_format": pixel_format}
    path = clips.encode(f"survives {pixel_format}.mkv", "-c:v", codec, **how)

    with VideoReader(path, name="clip", frames=3) as reader:
        meant = DepthEncoding(accept=frozenset({f"{bits}-bit"} if bits < 16 else ()))
        units = [read_depth_units(reader, index, encoding=meant) for index in (2, 0, 1)]
        assert reader.facts.pixel_format == pixel_format

    assert all(frame.dtype == np.uint16 and not frame.flags.writeable for frame in units)
    np.testing.assert_array_equal(units, pictures[[2, 0, 1]])


def encoded(clips, name, *codec, bits=8):
    dtype, pixel_format = ("u1", "gray") if bits == 8 else ("<u2", f"gray{bits}le")
    return clips.encode(name, *codec, pictures=noise(bits, dtype), pixel_format=pixel_format)


REFUSED = {
    "ffv1 as gray": (["8-bit"], "-c:v", "ffv1"),
    "ffv1 as gray12le": (["12-bit"], "-c:v", "ffv1", "-pix_fmt", "gray12le"),
    "ffv1 as yuv420p10le": (["10-bit", "chroma"], "-c:v", "ffv1", "-pix_fmt", "yuv420p10le"),
    "hevc as gray10le": (["10-bit", "lossy"], "-pix_fmt", "gray10le", "-c:v", *HEVC, "log-level=0"),
    "mpeg4 as yuv420p": (["8-bit", "lossy", "chroma"], "-c:v", "mpeg4"),
}  # fmt: skip


@pytest.mark.parametrize("stored", REFUSED)
def test_a_stream_that_may_have_lost_depth_is_refused_by_name(clips, stored):
    risks, *codec = REFUSED[stored]
    path = encoded(clips, f"refused {stored}.mkv", *codec)
    accept = ", ".join(repr(risk) for risk in sorted(risks))

    with (
        VideoReader(path, name="a/cam_01_depth.mkv", frames=3) as reader,
        pytest.raises(MediaError) as refusal,
    ):
        read_depth_units(reader, 0, encoding=DepthEncoding(unit_m=0.5))

    message = str(refusal.value)
    assert message.startswith("a/cam_01_depth.mkv: depth is stored by codec ")
    assert f"codec {stored} ({', '.join(risks)})" in message
    assert f"DepthEncoding(accept=frozenset({{{accept}}}))" in message


def test_the_luma_plane_is_read_where_chroma_is_accepted(clips):
    path = encoded(clips, "luma.mkv", "-c:v", "ffv1", "-pix_fmt", "yuv420p12le", bits=12)
    raw = clips.ffmpeg("-i", path, "-f", "rawvideo", "-pix_fmt", "yuv420p12le", "-")
    luma = np.frombuffer(raw, "<u2").reshape(3, -1)[:, : HEIGHT * WIDTH]
    accept = frozenset({"12-bit", "chroma"})

    with VideoReader(path, name="clip", frames=3) as reader:
        units = read_depth_units(reader, 1, encoding=DepthEncoding(accept=accept))

    np.testing.assert_array_equal(units.ravel(), luma[1])


@pytest.mark.parametrize("pixel_format", ["pal8", "grayf32le", "ya8", "nv12"])
def test_formats_that_hold_no_whole_numbers_are_refused_whatever_is_accepted(pixel_format):
    stored = {"codec": "ffv1", "pixel_format": pixel_format}

    with pytest.raises(MediaError, match=f"clip: .* by codec ffv1 as {pixel_format}, which is not"):
        require_depth_stream(**stored, encoding=ANY_DEPTH, name="clip")


def smooth_depth():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    numbers = 300 + 37 * columns + 11 * rows + np.random.default_rng(0).integers(0, 4, rows.shape)
    return numbers.astype(np.uint16)


def written_colours(clips, name, channels, pixel_format, *codec):
    """Write one picture of red, green and blue planes."""
    red, green, blue = channels
    if pixel_format.startswith("gbrp"):
        pictures = np.stack([green, blue, red])
    else:
        order = {"r": red, "g": green, "b": blue, "0": 0 * red}
        letters = pixel_format.removesuffix("24").removesuffix("48be")
        pictures = np.stack([order[each] for each in letters], -1)[None]
        pictures = pictures.astype(">u2") if pixel_format.endswith("be") else pictures
    return clips.encode(name, "-c:v", *codec, pictures=pictures, pixel_format=pixel_format)


def read_first(path, accept=(), frames=1, channels=""):
    encoding = DepthEncoding(accept=frozenset(accept), channels=channels)
    with VideoReader(path, name="clip", frames=frames) as reader:
        return read_depth_units(reader, 0, encoding=encoding)


BYTES = {
    "red and green": (("high", "low", "none"), "bgr0", "ffv1"),
    "blue and green": (("none", "low", "high"), "bgr0", "ffv1"),
    "three equal ones of 16 bits": (("both", "both", "both"), "gbrp16le", "ffv1"),
    "three equal ones of 16 bits by pixel": (("both", "both", "both"), "rgb48be", "png"),
    "lossless H.264": (("high", "low", "none"), "bgr24", "libx264rgb", "-qp", "0"),
    "lossless HEVC": (("none", "high", "low"), "gbrp", *HEVC, "lossless=1:log-level=0"),
}  # fmt: skip


@pytest.mark.parametrize("case", BYTES)
def test_depth_is_found_in_channels_of_colours(clips, case):
    places, *stored = BYTES[case]
    depth = smooth_depth()
    parts = {"high": depth >> 8, "low": depth & 255, "none": 0 * depth, "both": depth}
    channels = [parts[each].astype(np.uint16 if each == "both" else np.uint8) for each in places]

    path = written_colours(clips, f"bytes {case}.mkv", channels, *stored)
    named = "".join("rgb"[places.index(each)] for each in ("high", "low") if each in places)

    found = read_first(path, channels=named)

    np.testing.assert_array_equal(found, depth)
    if named:
        with pytest.raises(MediaError, match=r'clip: .*channels = "rg" below \[depth\]'):
            read_first(path)


@pytest.mark.parametrize("case", ["other numbers", "colours", "grey"])
def test_channels_that_are_no_number_are_refused(clips, case):
    depth = smooth_depth()
    busy = noise(8, "u1")
    channels, pixel_format = {
        "other numbers": ([depth, depth, depth // 2], "gbrp16le"),
        "colours": (busy, "bgr0"),
        "grey": ([busy[0]] * 3, "bgr0"),
    }[case]
    path = written_colours(clips, f"no number {case}.mkv", channels, pixel_format, "ffv1")

    with pytest.raises(MediaError, match=r"clip: depth is stored in channels of colours, and"):
        read_first(path, channels="rg")


@pytest.mark.parametrize(
    ("bits", "codec", "options", "coding"),
    [
        (10, "libx264", ("-qp", "0"), "h264 lossless"),
        (10, "libx264", ("-crf", "1"), "h264"),
        (12, "libx265", ("-x265-params", "lossless=1:log-level=0"), "hevc lossless"),
        (12, "libx265", ("-x265-params", "cu-lossless=1:crf=20:log-level=0"), "hevc"),
    ],
)
def test_h264_and_hevc_are_lossless_where_their_headers_say_so(clips, bits, codec, options, coding):
    path = encoded(clips, f"{codec} {options[-1][:6]}.mkv", "-c:v", codec, *options, bits=bits)

    assert depth_coding(probe(path, name="clip")) == coding
    if coding.endswith("lossless"):
        found = read_first(path, frames=3, accept=[f"{bits}-bit", "chroma"])
        np.testing.assert_array_equal(found, noise(bits, "<u2")[0])


def test_the_rendered_scene_is_read_as_ffmpeg_reads_it(clips, shared_scenes):
    path = next(shared_scenes.rglob("cam_04_depth.mkv"))
    raw = clips.ffmpeg(
        "-i", path, "-vf", "select='eq(n,57)'", "-fps_mode", "passthrough",
        "-f", "rawvideo", "-pix_fmt", "gray16le", "-",
    )  # fmt: skip

    with VideoReader(path, name="clip", frames=probe(path, name="clip").frames) as reader:
        units = read_depth_units(reader, 57, encoding=DepthEncoding())

    np.testing.assert_array_equal(units, np.frombuffer(raw, "<u2").reshape(320, 320))
