"""A bit that flips in a time never brings the frame beside the one asked for."""

import io
import random
import re
from contextlib import suppress

import av
import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.depth import read_depth_units
from stereogenbench_data.media.video import VideoReader, read_rgb
from stereogenbench_data.schema.records import DepthEncoding
from tests.media.conftest import flipped

FRAMES = 17
TIMES = rb"(?:\xe7|\x2a\xd7\xb1|\x44\x89)([\x81-\x88])"  # of a cluster, of a tick, of the whole
TABLES = (b"stts", b"ctts", b"mdhd", b"stss", b"elst")


def shown(content, order, number_of):
    """Return (frame asked for, frame shown) of some frames, without those that are refused."""
    found = []
    with suppress(MediaError), VideoReader(io.BytesIO(content), name="clip", frames=FRAMES) as clip:
        for index in order:
            with suppress(MediaError):
                found.append((index, number_of(clip, index)))
    return found


def block_times(content):
    """Return where the time of each block of a Matroska file stands, two bytes each."""
    with av.open(io.BytesIO(content)) as container:
        packets = {bytes(packet) for packet in container.demux(video=0) if packet.size}
    starts = sorted(content.index(packet) for packet in packets)
    assert len(starts) == FRAMES
    return [start - before for start in starts for before in (3, 2)]


def test_no_flipped_bit_of_a_depth_videos_times_brings_another_frame(clips):
    pictures = np.zeros((FRAMES, 16, 16), "<u2") + 7 * np.arange(FRAMES, dtype="<u2")[:, None, None]
    path = clips.encode(
        "times.mkv", "-c:v", "ffv1", "-cluster_time_limit", "300",
        pictures=pictures, pixel_format="gray16le",
    )  # fmt: skip
    content = path.read_bytes()
    places = block_times(content)
    for found in re.finditer(TIMES, content):
        places += range(found.end(), found.end() + found[1][0] % 16)
    rng = random.Random(4)
    wrong = []

    def number_of(clip, index):
        return int(read_depth_units(clip, index, encoding=DepthEncoding())[0, 0]) // 7

    assert shown(content, range(FRAMES), number_of) == [(n, n) for n in range(FRAMES)]
    for place in places:
        for bit in (0, 3, 7):
            order = (range(FRAMES), rng.sample(range(FRAMES), FRAMES))[(place + bit) % 2]
            found = shown(flipped(content, place, bit), order, number_of)
            wrong += [(place, bit, *each) for each in found if each[0] != each[1]]

    assert len(places) > 2 * FRAMES + 8
    assert wrong == []


@pytest.mark.parametrize("codec", [("-g", "6"), ("-bf", "0")])
def test_no_flipped_bit_of_an_mp4s_tables_of_times_brings_another_frame(clips, codec):
    path = clips.encode(
        f"times {codec}.mp4", "-c:v", "libx264", "-preset", "ultrafast", "-pix_fmt", "yuv420p",
        *codec, pictures=clips.pictures[:FRAMES],
    )  # fmt: skip
    content = path.read_bytes()
    places = []
    for table in TABLES:
        start = content.find(table)
        if start >= 0:
            size = int.from_bytes(content[start - 4 : start], "big")
            places += range(start + 8, start - 4 + size)
    wrong = []

    for seen, place in enumerate(places, 1):
        altered = flipped(content, place, seen % 8)
        found = shown(altered, (9, 2, 16, 0), lambda clip, n: clips.number(read_rgb(clip, n)))
        wrong += [(place, *each) for each in found if each[0] != each[1]]

    assert len(places) > 40
    assert wrong == []
