"""Depth packed by blosc2: bit for bit, frame by frame, and nothing that the bytes say believed."""

import io
import json
import zlib
from dataclasses import replace

import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media import depth_frames
from stereogenbench_data.media.depth import packed_depth, stated_unit, write_depth_video
from stereogenbench_data.media.depth_frames import (
    LAYER,
    DepthFrames,
    compressed_chunk,
    require_chunk,
)
from stereogenbench_data.media.video import probe
from tests.media.conftest import flipped
from tests.servers.tools import require_module

SHAPE = (40, 56)


def pictures(largest=65535):
    """Noise, nothing, one number everywhere, the largest number, a slope, noise of few levels."""
    noise = np.random.default_rng(3)
    slope = np.arange(SHAPE[0] * SHAPE[1]).reshape(SHAPE) % (largest + 1)
    flat = [np.full(SHAPE, number) for number in (0, 7, largest)]
    maps = [noise.integers(0, largest + 1, SHAPE), *flat, slope, noise.integers(0, 3, SHAPE)]
    return [each.astype(np.uint16) for each in maps]


def write_depth(clips, name, maps, *, pixel_format="gray16le", codec=("ffv1",), rate="15"):
    pictures = np.stack(maps).astype("u1" if pixel_format == "gray" else "<u2")
    tags = ("-metadata", "DEPTH_SCALE=0.001", "-metadata", "TITLE=Nowhere")
    how = {"pictures": pictures, "pixel_format": pixel_format, "rate": rate}
    return clips.encode(name, "-c:v", *codec, *tags, **how)


@pytest.fixture(scope="module")
def blosc2():
    return require_module("blosc2")


@pytest.fixture(scope="module")
def video(clips):
    return write_depth(clips, "cam_00_depth.mkv", pictures())


@pytest.fixture(scope="module")
def packed(blosc2, video):
    assert blosc2.__version__
    return packed_depth(video, name="cam_00_depth.mkv", frames=6)


def opened(content, frames=6):
    return DepthFrames(io.BytesIO(content), name="cam_00_depth.b2frame", frames=frames)


def test_every_frame_comes_back_bit_for_bit_in_any_order(packed):
    with opened(packed) as depth:
        for index in (5, 0, 3, 3, 1, 2, 4):
            found = depth.units(index)

            assert found.dtype == np.uint16
            np.testing.assert_array_equal(found, pictures()[index])


def test_blosc2_itself_reads_the_file_and_its_description(blosc2, packed):
    schunk = blosc2.schunk_from_cframe(packed)

    assert schunk.nchunks == 6
    for index, units in enumerate(pictures()):
        found = np.frombuffer(schunk.decompress_chunk(index), np.uint16).reshape(SHAPE)
        np.testing.assert_array_equal(found, units)
    clip = json.loads(schunk.meta[LAYER][4:])["clip"]
    assert (clip["width_px"], clip["height_px"]) == (56, 40)
    assert (clip["codec"], clip["pixel_format"]) == ("ffv1", "gray16le")
    assert clip["tags"]["DEPTH_SCALE"] == "0.001"


def test_its_facts_are_those_of_the_video(packed, video):
    found, told = opened(packed).facts, probe(video, name="cam_00_depth.mkv")

    assert found == replace(told, codec="blosc2")
    assert probe(io.BytesIO(packed), name="cam_00_depth.b2frame") == found
    assert stated_unit(found, name="it") == (0.001, "tag")


@pytest.mark.parametrize("index", [0, 2, 5])
def test_a_flipped_byte_of_a_frame_is_reported_with_its_number_and_others_are_read(packed, index):
    with opened(packed) as depth:
        place = packed.index(depth.chunk(index))

    with opened(flipped(packed, place + 40, 0)) as depth:
        with pytest.raises(MediaError, match=f"b2frame: frame {index}: has crc32 .* is damaged"):
            depth.units(index)

        np.testing.assert_array_equal(depth.units(4), pictures()[4])


def test_a_flipped_byte_of_the_header_is_refused_or_changes_nothing(packed):
    facts, told = opened(packed).facts, []

    for at in range(2, 500, 3):
        try:
            depth = opened(flipped(flipped(packed, at, 0), at, 4))
        except MediaError as error:
            told.append(str(error))
            continue
        assert depth.facts == facts
        for index, units in enumerate(pictures()):
            np.testing.assert_array_equal(depth.units(index), units)

    assert len(told) > 130
    assert {line[:22] for line in told} == {"cam_00_depth.b2frame: "}


@pytest.mark.parametrize("left", [0, 100, 3000])
def test_a_file_that_was_cut_short_is_refused(packed, left):
    with pytest.raises(MediaError, match=r"cam_00_depth\.b2frame: is (not depth|cut short)"):
        opened(packed[:left])


def test_another_number_of_frames_or_frames_too_large_are_refused(packed, monkeypatch):
    with pytest.raises(MediaError, match="holds 6 frames where 7 are expected"):
        opened(packed, frames=7)
    monkeypatch.setattr(depth_frames, "LARGEST_FRAME_BYTES", 56 * 40 * 2 - 1)
    with pytest.raises(MediaError, match="claims frames of 56x40 pixels, 4,480 bytes each"):
        opened(packed)


@pytest.mark.usefixtures("blosc2")
@pytest.mark.parametrize(
    ("at", "value"),
    [
        pytest.param(4, (2**31 - 16).to_bytes(4, "little"), id="a bomb"),
        pytest.param(12, (10**6).to_bytes(4, "little"), id="a size"),
        pytest.param(8, bytes(4), id="no blocks"),
        pytest.param(2, b"\xc5", id="a codec"),
        pytest.param(31, b"\x08", id="a lazy chunk"),
    ],
)
def test_a_chunk_that_blosc2_would_take_otherwise_is_refused_before_it_does(packed, at, value):
    chunk = bytearray(compressed_chunk(pictures()[0].tobytes()))
    chunk[at : at + len(value)] = value
    clip = opened(packed).clip

    with pytest.raises(MediaError, match=f"frame 3: .* its header .{chunk[:32].hex()}. is not"):
        require_chunk(bytes(chunk), clip=clip, crc32=zlib.crc32(chunk), name="frame 3")


def parse_text(content):
    start = content.index(b'{"format":1')
    return content[start : content.index(b"]}", content.index(b'"crc32s"', start)) + 2]


@pytest.mark.usefixtures("blosc2")
@pytest.mark.parametrize(("pixel_format", "largest"), [("gray16le", 65535), ("gray", 255)])
def test_packed_depth_becomes_the_same_video_again(clips, tmp_path, pixel_format, largest):
    how = {"pixel_format": pixel_format, "rate": "7.5"}
    first = write_depth(clips, f"first {pixel_format}.mkv", pictures(largest), **how)
    content = packed_depth(first, name="first.mkv", frames=6)

    write_depth_video(opened(content), tmp_path / "second.mkv")

    one, other = (probe(path, name="depth") for path in (first, tmp_path / "second.mkv"))
    assert other.tags.pop("encoder", "") != ""
    one.tags.pop("encoder")
    assert one == other
    again = packed_depth(tmp_path / "second.mkv", name="second.mkv", frames=6)
    clips = [opened(each).clip for each in (content, again)]  # with times and checksums of frames
    for clip in clips:
        del clip.tags[next(key for key in clip.tags if key.lower() == "encoder")]
    assert clips[0] == clips[1]


@pytest.mark.parametrize(
    ("encoder", "codec", "form"), [("libx264", "h264", "yuv420p"), ("ffv1", "ffv1", "yuv420p10le")]
)
def test_what_cannot_come_back_whole_is_not_packed(clips, encoder, codec, form):
    how = (encoder, "-pix_fmt", form)
    path = write_depth(clips, f"unpackable {encoder}.mkv", pictures(1000)[:2], codec=how)

    with pytest.raises(MediaError, match=f"depth is stored by codec {codec} as {form}"):
        packed_depth(path, name="x.mkv", frames=2)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        (b'"codec":"ffv1"', b'"codec":"h264"', "h264, gray16le"),
        (b'"width_px":56', b'"width_px":{}', "malformed or incomplete"),
        (b'"tags":{', b'"tagz":{', "malformed or incomplete"),
        (b'"pts":[0,67', b'"pts":[99,0', "times of frames that do not ascend"),
    ],
)
def test_a_header_that_describes_no_packed_depth_is_refused(packed, old, new, found):
    told = parse_text(packed)
    altered = told.replace(old, new)
    content = packed.replace(
        zlib.crc32(told).to_bytes(4, "big") + told, zlib.crc32(altered).to_bytes(4, "big") + altered
    )
    assert altered != told

    with pytest.raises(MediaError, match=found):
        opened(content)


def test_what_blosc2_does_not_give_back_is_an_error(blosc2, video, monkeypatch):
    def forgetful(chunk, dst, **how):
        dst[...] = 1

    monkeypatch.setattr(blosc2, "decompress2", forgetful)

    with pytest.raises(MediaError, match="frame 0 does not come back from blosc2 as it was"):
        packed_depth(video, name="x.mkv", frames=6)
