"""Seek tables: where packets lie, as ffprobe says; and what a reader needs of them."""

import io
import json
import subprocess
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data.media.depth import packed_depth
from stereogenbench_data.media.seek_table import (
    ReadCursor,
    SeekTable,
    packed_tables,
    parse_tables,
    read_seek_table,
)
from stereogenbench_data.media.video import VideoReader
from stereogenbench_data.sources.ranged_file import RangedFile
from tests.servers.tools import require_tool
from tests.servers.videos import write_depth, write_rgb

FRAMES = 30


KINDS = {"rgb.mp4": "libx264", "fast.mp4": "libx264", "jpeg.mp4": "mjpeg", "depth.mkv": "ffv1"}
"""One of each kind that the release and training shards have, and its encoder."""


def write(path, codec):
    """A video of noise, whose packets are large enough to be skipped by seeking."""
    rng = np.random.default_rng(7)
    if codec == "ffv1":
        units = rng.integers(0, 2**16, (FRAMES, 64, 96), dtype=np.uint16)
        return write_depth(path, units, options={"g": "10"})
    pictures = rng.integers(0, 256, (FRAMES, 64, 96, 3), dtype=np.uint8)
    pixel_format = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    of_file = {"movflags": "faststart"} if path.name == "fast.mp4" else {}
    how = {"codec": codec, "pixel_format": pixel_format, "options": {"g": "10"}}
    return write_rgb(path, pictures, **how, file_options=of_file)


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seek")
    return {name: write(folder / name, codec) for name, codec in KINDS.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_packets_lie_where_ffprobe_finds_them(videos, kind):
    program = require_tool("ffprobe")
    command = [program, "-v", "error", "-show_packets", "-of", "json", str(videos[kind])]
    packets = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)["packets"]

    table = read_seek_table(videos[kind], name=kind)

    assert table.packets == len(packets) == FRAMES
    assert table.keys == tuple(n for n, packet in enumerate(packets) if "K" in packet["flags"])
    for number, packet in enumerate(packets):
        start, stop = table.bounds[number], table.bounds[number + 1]
        assert start <= int(packet["pos"]) < int(packet["pos"]) + int(packet["size"]) <= stop
    payload = sum(int(packet["size"]) for packet in packets)
    assert table.bounds[-1] - table.bounds[0] <= payload + 40 * FRAMES
    assert table.fits(file_bytes=videos[kind].stat().st_size)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "frames",
    [[29], [3, 4, 5, 25], [17, 2, 2, 3], list(range(FRAMES))],
    ids=str,
)
def test_each_frame_is_read_from_the_bytes_that_it_needs_alone(videos, kind, frames):
    path = videos[kind]
    content, table = path.read_bytes(), read_seek_table(path, name=kind)
    position, ranges, missed = ReadCursor(table), [], []
    needed = 0

    def ahead(at):
        return next(((a, content[a:b]) for a, b in ranges if a <= at < b), None)

    def fetch(start, stop):
        missed.append((start, stop))
        return content[start:stop]

    file = RangedFile(fetch, table=table, ahead=ahead, size=len(content), crc32=zlib.crc32(content))
    with VideoReader(path, name=kind, frames=FRAMES) as expected:
        reader = None
        for frame in frames:
            ranges = position.needed(frame)
            needed += sum(stop - start for start, stop in ranges)
            reader = reader or VideoReader(file, name=kind, frames=FRAMES)
            found = reader.frame(frame).to_ndarray()
            np.testing.assert_array_equal(found, expected.frame(frame).to_ndarray())
        reader.close()

    assert missed == []
    if frames == list(range(FRAMES)):
        assert needed == table.bounds[-1] - table.bounds[0]


def test_packed_depth_has_a_table_of_its_chunks(videos):
    pytest.importorskip("blosc2")
    content = packed_depth(videos["depth.mkv"], name="depth", frames=FRAMES)

    table = read_seek_table(io.BytesIO(content), name="cam_00_depth.b2frame")

    assert table.packets == FRAMES
    position = ReadCursor(table)
    assert position.needed(7) == [(table.bounds[7], table.bounds[8])]
    assert position.needed(7) == []
    assert position.needed(3) == [(table.bounds[3], table.bounds[4])]


def test_far_away_the_packets_of_a_cluster_count_as_one(videos):
    whole = read_seek_table(videos["depth.mkv"], name="depth.mkv")
    content = videos["depth.mkv"].read_bytes()
    far = RangedFile(lambda start, stop: content[start:stop], size=len(content))
    table = read_seek_table(far, name="depth.mkv")

    assert table.keys == whole.keys
    one, other = ([each.bounds[key] for key in each.keys[1:]] for each in (table, whole))
    assert one == other
    assert abs(table.bounds[-1] - whole.bounds[-1]) <= 32
    assert table.fits(file_bytes=videos["depth.mkv"].stat().st_size)
    # A later frame lies somewhere in its cluster: all of that is kept until the last one is read.
    position = ReadCursor(table)
    needed = [position.needed(frame) for frame in range(FRAMES)][2:]
    starts = [table.bounds[table.key_before(frame)] for frame in range(2, FRAMES)]
    assert [ranges[-1][0] for ranges in needed] == starts


def test_tables_come_back_as_they_were_packed(videos):
    tables = {name: read_seek_table(path, name=name) for name, path in videos.items()}

    assert parse_tables(packed_tables(tables)) == tables


def repacked(change):
    """Tables that a stranger altered."""
    content = json.dumps(change).encode()
    return b"seek1" + zlib.compress(len(content).to_bytes(4, "big") + content + bytes(64))


@pytest.mark.parametrize(
    "packed",
    [
        b"",
        b"seek1",
        b"seek2" + zlib.compress(b""),
        repacked({}),
        repacked([["v", 10**12, [0], 0, 0, 0, 0, 0, 0, 0]]),
        repacked([["v", -1, [0], 0, 0, 0, 0, 0, 0, 0]]),
        repacked([["v", 2, [0, 9], 0, 0, 0, 0, 0, 0, 0]]),
        repacked([["v", 2, [0], 0, 0, 3, 0, 0, 0, 0]]),
        repacked([["v", 2, [0], 0, 0, 0, 0, 10**9, 0, 5]]),
        repacked([["v", 2, "x", 0, 0, 0, 0, 0, 0, 0]]),
        repacked([["v"]]),
    ],
)
def test_altered_tables_are_none(packed):
    assert parse_tables(packed) == {}


@given(st.binary(max_size=200))
def test_any_bytes_give_tables_or_none(content):
    parse_tables(b"seek1" + zlib.compress(content))
    parse_tables(content)


@given(
    st.lists(st.integers(1, 50), min_size=1, max_size=40),
    st.lists(st.integers(0, 39), max_size=6),
    st.integers(0, 3),
    st.booleans(),
    st.sampled_from([(0, 0), (1, 0), (1, 8)]),
    st.lists(st.integers(0, 39), min_size=1, max_size=20),
)
def test_what_is_needed_holds_each_frame_from_where_its_decoding_can_begin(
    spans, keys, delay, has_neighbours, opening, frames
):
    count = len(spans)
    table = SeekTable(
        tuple(np.cumsum([10, *spans]).tolist()),
        tuple(sorted({0, *(key % count for key in keys)})),
        delay=delay % (count + 1),
        has_neighbours=has_neighbours,
        opening=opening[0],
        blind_jump=opening[1],
        head=bytes(10),
    )
    frames = [frame % count for frame in frames]
    position = ReadCursor(table)
    there, previous = set(), None
    for frame in frames:
        parts = position.needed(frame)
        for start, stop in parts:
            assert start < stop
            assert {start, stop} <= {*table.bounds}
            there |= set(range(start, stop))
        key = table.key_before(frame)
        assert set(range(table.bounds[key], table.bounds[frame + 1])) <= there
        if frame == previous:
            assert not parts
        previous = frame
