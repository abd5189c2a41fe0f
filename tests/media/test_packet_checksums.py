"""A frame of a training video is the one that was written, or an error, whatever bit flips."""

import io
import zlib
from fractions import Fraction

import av
import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import packet_checksums
from stereogenbench_data.media.encoder import write_pictures
from stereogenbench_data.media.video import VideoReader, read_rgb
from tests.media.conftest import flipped

FRAMES = 9


@pytest.fixture(scope="module", params=("balanced", "high"))
def written(request, tmp_path_factory):
    """The bytes of a training video, and its frames as they decode."""
    file = tmp_path_factory.mktemp("video") / "a.mp4"
    noise = np.random.default_rng(5).integers(0, 256, (FRAMES, 3, 32, 48), dtype=np.uint8)
    write_pictures(noise, file, quality=request.param, rate_hz=Fraction(15))
    return file.read_bytes(), [frame_of(file.read_bytes(), index) for index in range(FRAMES)]


def frame_of(content, index):
    with VideoReader(io.BytesIO(content), name="video", frames=FRAMES) as reader:
        return read_rgb(reader, index, content="colour")


def packets_of(content):
    """Where the packets lie, by FFmpeg's own list."""
    with av.open(io.BytesIO(content)) as container:
        return [(each.pos, each.size) for each in container.streams.video[0].index_entries]


def test_a_bit_that_flips_in_the_packet_of_a_frame_is_named(written):
    content, _ = written
    rng = np.random.default_rng(11)

    for index, (start, size) in enumerate(packets_of(content)):
        for place in start + rng.integers(size, size=6):
            damaged = flipped(content, int(place), int(rng.integers(8)))
            with pytest.raises(MediaError, match=rf"video: frame {index} cannot be decoded"):
                frame_of(damaged, index)


def test_a_bit_that_flips_anywhere_never_changes_a_frame_in_silence(written):
    content, frames = written
    rng = np.random.default_rng(12)
    header = packets_of(content)[0][0]
    places = [*range(0, header, 3), *rng.integers(header, len(content), size=40).tolist()]

    for place in places:
        index = int(rng.integers(FRAMES))
        try:
            found = frame_of(flipped(content, place, int(rng.integers(8))), index)
        except MediaError:
            continue
        np.testing.assert_array_equal(found, frames[index], err_msg=f"byte {place}")


def test_the_checksums_are_those_of_the_packets_that_ffmpeg_reads(written):
    content, _ = written

    with av.open(io.BytesIO(content)) as container:
        found = packet_checksums(container, frames=FRAMES, name="video")
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]

    assert len({*packets}) == FRAMES
    assert [*found] == [zlib.crc32(packet) for packet in packets]


def test_a_video_without_checksums_is_read_as_before(written):
    content, frames = written
    tag = content.index(b"CRC-32 of header and packets")
    unchecked = content[:tag] + b"X" + content[tag + 1 :]

    np.testing.assert_array_equal(frame_of(unchecked, 4), frames[4])
