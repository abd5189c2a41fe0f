"""The pool of open videos."""

import gc
from pathlib import Path

import numpy as np
import pytest

from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.schema.records import DepthEncoding


def videos(root, kind):
    return sorted(root.glob(f"train/*/*/*/cam_*_{kind}"))


def open_files():
    """Return the videos that this process has open, as Linux tells."""
    gc.collect()
    links = []
    for link in Path("/proc/self/fd").iterdir():
        try:
            links.append(str(link.readlink()))
        except OSError:
            continue
    return sorted(link for link in links if link.endswith((".mp4", ".mkv")))


def test_the_pool_keeps_no_more_videos_open_than_its_limit(small_release):
    pool = Streams(limit=4)
    for path in videos(small_release, "rgb.mp4"):
        pool.rgb(path, 0, frames=7, size=None)

    assert len(open_files()) == 4
    pool.close()
    assert open_files() == []


def test_a_video_that_was_closed_in_turn_is_read_again_the_same(small_release):
    paths = videos(small_release, "rgb.mp4")[:3]
    roomy, tight = Streams(limit=8), Streams(limit=1)

    for frame in (0, 3, 1):
        for path in paths:
            expected = roomy.rgb(path, frame, frames=7, size=None)
            assert np.array_equal(tight.rgb(path, frame, frames=7, size=None), expected)
    roomy.close()
    tight.close()


def test_a_picture_is_handed_out_read_only_and_not_decoded_twice(small_release):
    path = videos(small_release, "rgb.mp4")[0]
    pool = Streams()
    first = pool.rgb(path, 2, frames=7, size=None)

    assert pool.rgb(path, 2, frames=7, size=None) is first
    with pytest.raises(ValueError, match="read-only"):
        first[0, 0, 0] = 1
    pool.close()


def test_another_size_is_another_picture(small_release):
    path = videos(small_release, "rgb.mp4")[0]
    pool = Streams()

    assert pool.rgb(path, 0, frames=7, size=None).shape == (3, 64, 64)
    assert pool.rgb(path, 0, frames=7, size=(10, 20)).shape == (3, 10, 20)
    assert pool.rgb(path, 0, frames=7, size=None).shape == (3, 64, 64)
    pool.close()


def test_stored_depth_comes_back_as_it_was_written(small_release):
    path = videos(small_release, "depth.mkv")[0]
    pool = Streams()
    units = pool.depth_units(path, 0, frames=7, encoding=DepthEncoding(0.001))

    assert units.dtype == np.uint16
    assert pool.pixel_format(path, frames=7) == "gray16le"
    pool.close()
