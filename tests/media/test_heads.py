"""A video without its packets is to FFmpeg what the video is, from a few kB of it."""

import io
import random
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.media.container import open_container, stream_facts
from stereogenbench_data.media.heads import Heads, heads_of
from stereogenbench_data.media.seek_table import read_seek_table
from stereogenbench_data.media.video import probe
from tests.media.conftest import flipped

X264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p")
X265 = ("-c:v", "libx265", "-x265-params")
GREY = ("-pix_fmt", "gray16le")
KINDS = {
    "rgb.mp4": X264,
    "fast.mp4": (*X264, "-bf", "0", "-movflags", "+faststart"),
    "open groups.mp4": (*X264, "-g", "12", "-x264-params", "open-gop=1"),
    "no edit list.mp4": (*X264, "-use_editlist", "0"),
    "fragments.mp4": (*X264, "-g", "12", "-movflags", "frag_keyframe+empty_moov"),
    "dash.mp4": (*X264, "-g", "12", "-movflags", "dash"),
    "odd ticks.mp4": (*X264, "-video_track_timescale", "1001"),
    "rgb.mkv": (*X264, "-g", "12"),
    "hevc.mp4": (*X265, "log-level=none"),
    "hevc.mkv": (*X265, "lossless=1:log-level=none", "-pix_fmt", "gray12le"),
    "mpeg4.mp4": ("-c:v", "mpeg4", "-bf", "2"),
    "vp9.mp4": ("-c:v", "libvpx-vp9", "-deadline", "realtime", "-cpu-used", "8"),
    "jpeg.mp4": ("-c:v", "mjpeg", "-pix_fmt", "yuvj420p"),
    "ffv1.mkv": ("-c:v", "ffv1", "-g", "12", *GREY),
    "old ffv1.mkv": ("-c:v", "ffv1", "-level", "1", *GREY),
    "clusters.mkv": ("-c:v", "ffv1", "-cluster_time_limit", "300", *GREY),
    "no list.mkv": ("-c:v", "ffv1", "-live", "1", *GREY),
    "list first.mkv": ("-c:v", "ffv1", "-reserve_index_space", "2000", *GREY),
    "old ffv1 behind a list.mkv": (
        "-c:v", "ffv1", "-level", "1", "-reserve_index_space", "9000", *GREY
    ),
    "fast vp9.mp4": (
        "-c:v", "libvpx-vp9", "-deadline", "realtime", "-cpu-used", "8", "-movflags", "+faststart"
    ),
    "png.mkv": ("-c:v", "png", "-pix_fmt", "gray16be"),
    "vfw.mkv": ("-c:v", "utvideo", "-pix_fmt", "yuv420p"),
}  # fmt: skip


@pytest.fixture(params=KINDS)
def path(request, clips):
    pictures = clips.pictures.repeat(3, axis=1).repeat(3, axis=2)
    return clips.encode(f"heads of {request.param}", *KINDS[request.param], pictures=pictures)


def told(file):
    """What FFmpeg tells of a video: its header, and of each packet all but its bytes."""
    with open_container(file, name="clip") as container:
        facts = stream_facts(container, name="clip", frames=0)
        packets = container.demux(video=0)
        return facts, [(p.pos, p.size, p.pts, p.is_keyframe) for p in packets if p.size]


def test_ffmpeg_tells_the_same_without_the_packets(path, clips):
    file = clips.counting(path)
    with heads_of(file, name="clip") as heads:
        assert isinstance(heads, Heads)
        found = told(heads)
        shown = probe(heads, name="clip").times.ticks
        table = read_seek_table(heads, name="clip")
        assert file.reads <= 3 * clips.frames

    facts, packets = told(path)
    assert found == (facts, packets)
    assert list(shown) == sorted(pts for _, _, pts, _ in packets)
    assert len(shown) == clips.frames
    if table is not None:
        assert [*table.bounds[1:-1]] >= [pos + size for pos, size, _, _ in packets][:-1]


def test_at_most_40_kb_of_a_file_are_asked_for(path, clips):
    file = clips.counting(path)

    needed = "later" if path.suffix == ".mp4" or "rgb" in path.name else "needed"
    with heads_of(file, name="clip") as heads:
        probe(heads, name="clip", pixel_format=needed)
        read_seek_table(heads, name="clip")

    assert path.stat().st_size > 40_000
    assert file.bytes_read < 20_000


@pytest.mark.parametrize(("found", "other"), [(b"\x9c\x81\x00", b"\x6d\x80\x80")])
def test_a_track_whose_packets_are_encoded_once_more_is_read_through(clips, found, other):
    content = clips.encode("groups of 12 ffv1.mkv", "-c:v", "ffv1", *GREY).read_bytes()
    assert content.count(found) == 1
    path = clips.folder / "encoded.mkv"
    path.write_bytes(content.replace(found, other))

    with heads_of(path, name="clip") as file:
        assert file == path
    assert probe(path, name="clip").frames == clips.frames


def test_a_block_of_several_packets_is_read_through(clips):
    path = clips.encode("groups of 12 ffv1.mkv", "-c:v", "ffv1", *GREY)
    content, packets = path.read_bytes(), clips.packets(path)
    laced = clips.folder / "laced.mkv"
    laced.write_bytes(flipped(content, content.index(packets[20]) - 1, 1))

    with heads_of(laced, name="clip") as file:
        assert file == laced


@pytest.mark.parametrize("name", ["rgb.mp4", "fragments.mp4", "ffv1.mkv"])
def test_damaged_heads_are_an_error_of_ours_or_none(clips, name):
    content = clips.encode(f"small {name}", *KINDS[name]).read_bytes()
    rng = random.Random(3)
    for size in (0, 1, 7, 100, len(content) // 2, *[len(content)] * 40):
        altered = content[:size]
        for _ in range(size and rng.choice([1, 8])):
            altered = flipped(altered, rng.randrange(min(size, 4096)), rng.randrange(8))
        path = clips.folder / "damaged heads"
        path.write_bytes(altered)
        with suppress(StereoGenBenchError):
            assert probe(path, name="clip").frames > 0
            read_seek_table(path, name="clip")


@given(st.sampled_from([b"\x1a\x45\xdf\xa3", b"\0\0\0\x18ftyp"]), st.binary(max_size=300))
def test_any_bytes_are_looked_at_to_an_end(begin, content):
    with heads_of(io.BytesIO(begin + content), name="clip"):
        pass
