"""A bit that flips in a time never brings the frame beside the one asked for."""

import io
import random

import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.depth import read_depth_units
from stereogenbench_data.media.video import VideoReader, read_rgb
from stereogenbench_data.schema.records import DepthEncoding

FRAMES = 17
ENCODING = DepthEncoding()
CONTAINERS = {b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75", b"\xa0", b"\x15\x49\xa9\x66"}
TIMES = {b"\xe7", b"\x2a\xd7\xb1", b"\x44\x89"}  # of a cluster, of a tick, of the whole
BLOCKS = {b"\xa3", b"\xa1"}
TABLES = (b"stts", b"ctts", b"mdhd", b"stss", b"elst")


def number_at(content, at):
    """Return an EBML number of variable length and how many bytes it has."""
    length = 9 - content[at].bit_length()
    value = content[at] & ((1 << (8 - length)) - 1)
    return int.from_bytes(bytes([value]) + content[at + 1 : at + length], "big"), length


def matroska_times(content, at=0, end=None):
    """Return the places of all bytes of a Matroska file that tell a time."""
    places, end = [], len(content) if end is None else end
    while at < end:
        length = 9 - content[at].bit_length()
        kind = content[at : at + length]
        size, more = number_at(content, at + length)
        at += length + more
        if kind in CONTAINERS:
            places += matroska_times(content, at, min(end, at + size))
        elif kind in TIMES:
            places += range(at, at + size)
        elif kind in BLOCKS:
            track = number_at(content, at)[1]
            places += (at + track, at + track + 1)
        at += size
    return places


def flipped(content, place, bit):
    altered = bytearray(content)
    altered[place] ^= 1 << bit
    return bytes(altered)


def depth_numbers(content, order):
    """Return the painted number of each frame that is read, None for those that are refused."""
    found = {}
    try:
        with VideoReader(io.BytesIO(content), name="clip", frames=FRAMES) as reader:
            for index in order:
                try:
                    units = read_depth_units(reader, index, encoding=ENCODING)
                    found[index] = int(units[0, 0]) // 7
                except MediaError:
                    found[index] = None
    except MediaError:
        return {}
    return found


@pytest.fixture(scope="module")
def depth(clips):
    pictures = np.zeros((FRAMES, 16, 16), "<u2") + 7 * np.arange(FRAMES, dtype="<u2")[:, None, None]
    return clips.gray(
        "times.mkv", "-c:v", "ffv1", "-cluster_time_limit", "300",
        pictures=pictures, pixel_format="gray16le",
    ).read_bytes()  # fmt: skip


def test_no_flipped_bit_of_a_depth_videos_times_brings_another_frame(depth):
    rng = random.Random(4)
    wrong, places = [], matroska_times(depth)
    for place in places:
        for bit in (0, 3, 7):
            altered = flipped(depth, place, bit)
            order = (range(FRAMES), rng.sample(range(FRAMES), FRAMES))[(place + bit) % 2]
            found = depth_numbers(altered, order)
            wrong += [
                (place, bit, index, number)
                for index, number in found.items()
                if number not in (None, index)
            ]

    assert len(places) > 2 * FRAMES
    assert wrong == []


@pytest.mark.parametrize("codec", [("-g", "6"), ("-bf", "0")])
def test_no_flipped_bit_of_an_mp4s_tables_of_times_brings_another_frame(clips, codec):
    path = clips.rgb(
        f"times {codec}.mp4", "-c:v", "libx264", "-preset", "ultrafast", "-pix_fmt", "yuv420p",
        *codec, pictures=clips.pictures[:FRAMES],
    )  # fmt: skip
    content = path.read_bytes()
    wrong, seen = [], 0
    for table in TABLES:
        start = content.find(table)
        if start < 0:
            continue
        size = int.from_bytes(content[start - 4 : start], "big")
        for place in range(start + 8, start - 4 + size):
            seen += 1
            altered = flipped(content, place, seen % 8)
            wrong += [each for each in shown(altered, clips) if each[1] not in (None, each[0])]

    assert seen > 40
    assert wrong == []


def shown(content, clips):
    """Return (frame asked for, frame shown) of some frames, None where one is refused."""
    found = []
    try:
        with VideoReader(io.BytesIO(content), name="clip", frames=FRAMES) as reader:
            for index in (9, 2, 16, 0):
                try:
                    found.append((index, clips.number(read_rgb(reader, index))))
                except MediaError:
                    found.append((index, None))
    except MediaError:
        return []
    return found
