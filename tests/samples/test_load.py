"""The pool of open videos."""

import gc
from dataclasses import replace

import numpy as np
import pytest
import torch

from stereogenbench_data.errors import MediaError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.load import Streams
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.sources.members import MemberSource
from tests.servers.tools import open_files

RGB = [f"cam_{camera:02d}_rgb.mp4" for camera in range(6)]
DEPTH = "cam_00_depth.mkv"


@pytest.fixture(params=["files", "shards"])
def data(request, small_release, small_shards):
    """An index of released files, and one of the same in shards."""
    return SceneIndex.open(small_release if request.param == "files" else small_shards)


def pool_of(data, **how):
    return Streams(MemberSource(data.root, shards=data.shards), **how)


def open_videos():
    """Return the videos that this process has open."""
    gc.collect()
    return [path for path in open_files() if path.endswith((".mp4", ".mkv", ".tar"))]


def test_the_pool_keeps_no_more_videos_open_than_its_limit(data):
    pool = pool_of(data, limit=4)
    for row in range(2):
        for name in RGB:
            pool.rgb(data.scene(row), name, 0, size=None)

    assert len(open_videos()) == 4
    pool.close()
    assert open_videos() == []


def test_a_picture_is_handed_out_read_only_and_not_decoded_twice(data):
    pool = pool_of(data)
    first = pool.rgb(data.scene(0), RGB[0], 2, size=None)

    assert pool.rgb(data.scene(0), RGB[0], 2, size=None) is first
    with pytest.raises(ValueError, match="read-only"):
        first[0, 0, 0] = 1


@pytest.mark.parametrize(
    "held",
    [np.asarray, lambda picture: picture.view()[None].transpose(), memoryview, torch.from_numpy],
    ids=["itself", "a view of a view", "its buffer", "a tensor"],
)
@pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")
def test_what_is_held_of_a_picture_stays_as_it_was(data, held):
    pool, scene = pool_of(data), data.scene(0)
    kept = [held(pool.rgb(scene, RGB[0], frame, size=None)) for frame in range(4)]
    fresh = pool_of(data)

    for frame, one in enumerate(kept):
        assert np.array_equal(one, held(fresh.rgb(scene, RGB[0], frame, size=None)))


def test_a_picture_can_be_written_where_it_is_wanted_and_is_not_kept(data):
    pool, scene = pool_of(data), data.scene(0)
    out = np.empty((2, 3, 64, 64), dtype=np.uint8)
    pool.rgb(scene, RGB[0], 2, out=out[1])

    assert np.array_equal(out[1], pool.rgb(scene, RGB[0], 2, size=None))
    small = np.empty((3, 10, 20), dtype=np.uint8)
    pool.rgb(scene, RGB[0], 0, out=small)
    assert np.array_equal(small, pool.rgb(scene, RGB[0], 0, size=(10, 20)))


def test_stored_depth_comes_back_as_it_was_written(data):
    pool, encoding = pool_of(data), DepthEncoding(0.001)
    stored = pool.read_stored_depth(data.scene(0), DEPTH, 0, encoding=encoding)
    small = pool.read_stored_depth(data.scene(0), DEPTH, 0, encoding=encoding, size=(16, 32))

    assert stored.units.dtype == np.uint16
    assert np.array_equal(stored.measured, (stored.units != 0) & (stored.units != 65535))
    assert np.array_equal(small.units, stored.units[2::4, 1::2])
    assert np.array_equal(small.measured, stored.measured[2::4, 1::2])


def test_a_video_that_failed_is_closed(data):
    pool = pool_of(data)
    scene = data.scene(0)
    with pytest.raises(MediaError, match="holds 7 frames where 8 are expected"):
        pool.rgb(replace(scene, frames=8), RGB[0], 7, size=None)
    with pytest.raises(MediaError, match=r"cam_00_rgb.mp4: has no frame 9"):
        pool.rgb(scene, RGB[0], 9, size=None)

    assert open_videos() == []
