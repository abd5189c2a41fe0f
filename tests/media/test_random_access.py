"""Any frame, in any order, is the one that ffmpeg decodes at that place."""

import random

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.seek_table import read_seek_table
from stereogenbench_data.media.video import VideoReader, probe, read_rgb
from stereogenbench_data.sources.ranged_file import RangedFile

X264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p")
STRUCTURES = {
    "one group with b-pyramid": X264,
    "groups of 12": (*X264, "-g", "12"),
    "open groups": (*X264, "-x264-params", "open-gop=1:keyint=10:scenecut=0:bframes=3"),
    "deep pyramid": (*X264, "-bf", "8", "-x264-params", "b-pyramid=strict:b-adapt=0:keyint=30"),
    "many references": (*X264, "-preset", "veryslow", "-refs", "8", "-g", "20"),
    "intra refresh": (*X264, "-x264-params", "intra-refresh=1:keyint=15"),
    "mpeg4 with b-frames": ("-c:v", "mpeg4", "-q:v", "3", "-bf", "2", "-g", "12"),
    "hevc": ("-c:v", "libx265", "-pix_fmt", "yuv420p", "-x265-params", "log-level=0:keyint=20"),
    "ffv1": ("-c:v", "ffv1", "-pix_fmt", "yuv420p"),
}


@pytest.mark.parametrize("structure", STRUCTURES)
def test_every_frame_in_random_order_is_ffmpegs_own(clips, structure):
    suffix = "mkv" if structure == "ffv1" else "mp4"
    path = clips.encode(f"{structure}.{suffix}", *STRUCTURES[structure])
    truth = clips.truth(path)
    order = random.Random(1).sample(range(clips.frames), clips.frames)

    with VideoReader(path, name="clip", frames=clips.frames) as reader:
        for index in [*range(clips.frames), *order]:
            np.testing.assert_array_equal(read_rgb(reader, index), truth[index])


@settings(max_examples=15, suppress_health_check=list(HealthCheck))
@given(order=st.lists(st.integers(0, 47), min_size=1, max_size=6))
@pytest.mark.parametrize("structure", ["one group with b-pyramid", "groups of 12"])
def test_any_walk_over_the_frames_shows_the_painted_numbers(clips, structure, order):
    path = clips.encode(f"{structure}.mp4", *STRUCTURES[structure])

    assert clips.shown(path, order) == order


WRITTEN = {
    "late.mp4": ("-output_ts_offset", "2.03"),
    "late.mkv": ("-output_ts_offset", "2.03"),
    **{
        f"{flags}.mp4": ("-use_editlist", "0", "-movflags", flags)
        for flags in ("+faststart", "+negative_cts_offsets", "+frag_keyframe+empty_moov")
    },
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_late_start_and_other_ways_of_writing_do_not_shift_the_numbers(clips, name):
    source = clips.encode("groups of 12.mp4", *STRUCTURES["groups of 12"])
    path = clips.folder / f"written {name}"
    clips.ffmpeg("-i", source, "-c", "copy", *WRITTEN[name], path)

    assert clips.shown(path, (40, 0, 1, 47)) == [40, 0, 1, 47]


RATES = {
    "film.mp4": ((), "24000/1001"),
    "film.mkv": ((), "24000/1001"),
    "variable.mkv": (("-vf", "setpts='(N+N*N/40)/15/TB'", "-fps_mode", "vfr"), "15"),
}


@pytest.mark.parametrize("name", RATES)
def test_frames_are_counted_by_order_at_rates_that_vary_or_no_clock_ticks(clips, name):
    how, rate = RATES[name]
    path = clips.encode(name, *how, *X264, "-g", "12", rate=rate)

    assert clips.shown(path, (33, 5, 47, 0, 46)) == [33, 5, 47, 0, 46]
    assert how or probe(path, name="clip").frame_rate_hz == pytest.approx(24000 / 1001)


@pytest.mark.parametrize("place", ["here", "far away"])
def test_frames_around_a_gap_are_counted_by_order_in_any_order(clips, place):
    """The header tells of one frame more than there are; a seek lands behind the gap."""
    source = clips.encode("groups of 6.mkv", *X264, "-g", "6", "-bf", "0")
    path = clips.remuxed(source, "gap.mkv", without=[11])
    content, file = path.read_bytes(), path
    if place == "far away":
        table = read_seek_table(path, name="clip")
        file = RangedFile(lambda a, b: content[a:b], size=len(content), table=table)

    found = clips.shown(file, (40, 5, 30, 11, 10, 46), frames=clips.frames - 1)

    assert found == [41, 5, 31, 12, 10, 47]


def test_an_edit_list_that_hides_frames_counts_those_that_are_left(clips):
    source = clips.encode("groups of 12.mp4", *STRUCTURES["groups of 12"])
    path = clips.folder / "edited.mp4"
    clips.ffmpeg("-ss", "1.01", "-i", source, "-c", "copy", path)
    truth = clips.truth(path)
    with av.open(str(path)) as container:
        stored = container.streams.video[0].frames

    with pytest.raises(MediaError, match=f"holds {len(truth)} frames where {stored} are expected"):
        VideoReader(path, name="clip", frames=stored)
    with VideoReader(path, name="clip", frames=len(truth)) as reader:
        for index in (20, 0, len(truth) - 1, 1):
            np.testing.assert_array_equal(read_rgb(reader, index), truth[index])
