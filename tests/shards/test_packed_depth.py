"""Shards whose depth blosc2 packed: the same samples, in few bytes, verified, and turned back."""

import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from stereogenbench_data import PAIR_FIELDS, StereoPairs
from stereogenbench_data.errors import ExtraError, ShardError, StorageError
from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex
from stereogenbench_data.media.video import VideoReader
from stereogenbench_data.schema.release import PACKED_DEPTH_NAMES, depth_name, rgb_name
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.unpack import unpack
from stereogenbench_data.shards.verify import verify
from tests.cli.command import succeed
from tests.datasets.conftest import same
from tests.servers.tools import require_module
from tests.shards.shard_files import bytes_of, flip_byte, scenes_of

PAIR = "train-Uniform-000000.tar"
KEY = "train/Uniform/SynthStage/scene_000001"
FIELDS = tuple(name for name in PAIR_FIELDS if name != "__url__")


@pytest.fixture(scope="module")
def unpacked(packed_depth, tmp_path_factory):
    """The tree that unpacking makes of them, with the report; not to be changed."""
    tree = tmp_path_factory.mktemp("unpacked") / "tree"
    return tree, unpack(packed_depth, tree)


@pytest.fixture
def shards(packed_depth, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(packed_depth, tmp_path / "shards")


def test_the_index_differs_in_depths_names_places_and_codec_alone(packed_depth, small_shards):
    found, released = scenes_of(packed_depth), scenes_of(small_shards)

    assert found.keys() == released.keys()
    for key, scene in found.items():
        assert scene.depth_codec == ("blosc2",) * 6
        one, other = (replace(s, members={}, depth_codec=()) for s in (scene, released[key]))
        assert one == other
        names = {PACKED_DEPTH_NAMES.get(name, name) for name in released[key].members}
        assert names == set(scene.members)
        assert scene.held_name(depth_name(2)) == "cam_02_depth.b2frame"
        assert released[key].held_name(depth_name(2)) == "cam_02_depth.mkv"
        assert len(scene.held_videos) == 12


@pytest.mark.parametrize("size", [None, (48, 56)])
def test_pairs_are_the_same(packed_depth, small_shards, size):
    options = {"fields": FIELDS, "pairs": "all", "frames": [0, 5], "size": size}
    one, other = StereoPairs(packed_depth, **options), StereoPairs(small_shards, **options)

    assert len(one) == len(other) == 4 * 15 * 2
    for number in range(0, len(one), 13):
        assert same(one[number], other[number])


def test_sound_shards_verify_and_every_frame_is_decoded(packed_depth):
    report = verify(packed_depth, mode="decode", workers=1)

    assert report.problems == ()
    assert report.videos_decoded == 48


def test_a_video_that_cannot_be_packed_whole_is_named(small_release, tmp_path):
    require_module("blosc2")
    tree = shutil.copytree(small_release, tmp_path / "tree")
    shutil.copy(tree / KEY / rgb_name(0), tree / KEY / "cam_04_depth.mkv")

    with pytest.warns(IncompleteSceneWarning, match=rf"{KEY}/cam_04_depth\.mkv: holds colours"):
        pack(tree, tmp_path / "out", depth_codec="blosc2", workers=1)

    assert KEY not in SceneIndex.open(tmp_path / "out").column("key").tolist()


def test_without_blosc2_the_extra_is_named(packed_depth, small_release, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "blosc2", None)
    match = r"pip install 'stereogenbench-data\[blosc2\]'"

    with pytest.raises(ExtraError, match=match):
        pack(small_release, tmp_path / "out", depth_codec="blosc2")
    with pytest.raises(ExtraError, match=match):
        StereoPairs(packed_depth)[0]

    assert not (tmp_path / "out").exists()


def same_videos(one, other):
    with (
        VideoReader(one, name="one", frames=7) as reader,
        VideoReader(other, name="other", frames=7) as released,
    ):
        assert reader.facts.tags["depth_scale"] == released.facts.tags["depth_scale"]
        for index in range(7):
            frame, expected = reader.frame(index), released.frame(index)
            assert frame.time == expected.time
            np.testing.assert_array_equal(frame.to_ndarray(), expected.to_ndarray())


def test_unpacking_gives_the_release_back(unpacked, small_release):
    tree, report = unpacked

    found, released = bytes_of(tree), bytes_of(small_release)
    assert found.keys() == released.keys()
    assert len(report.unpacked) == 4
    for name, digest in found.items():
        if name.endswith("_depth.mkv"):
            same_videos(tree / name, small_release / name)
        else:
            assert digest == released[name]
    again = scenes_of(tree)
    for key, scene in scenes_of(small_release).items():
        assert replace(again[key], members={}) == replace(scene, members={})


def test_unpacking_goes_on_where_it_was(small_shards, small_release, tmp_path):
    tree = tmp_path / "tree"
    unpack(small_shards, tree)
    (tree / KEY / "_scene_complete.json").unlink()
    (tree / KEY / "cam_00_rgb.mp4").unlink()
    (tree / KEY / ".cam_00_rgb.mp4.unfinished").write_bytes(b"of a killed run")
    seen = []

    report = unpack(small_shards, tree, progress=lambda *now: seen.append(now))

    assert report.unpacked == (KEY,)
    assert len(report.kept) == 3
    assert seen[-1][0] == seen[-1][1]
    assert bytes_of(tree) == bytes_of(small_release)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("baseline.json", flip_byte),
        ("cam_00_rgb.mp4", lambda path: path.write_text("mine")),
        ("cam_03_depth.mkv", lambda path: (path.unlink(), path.mkdir())),
    ],
)
def test_a_file_that_is_there_and_differs_is_left_alone(
    packed_depth, unpacked, tmp_path, name, change
):
    tree = shutil.copytree(unpacked[0], tmp_path / "tree")
    change(tree / KEY / name)
    (tree / KEY / "trajectory.json").unlink()
    before = bytes_of(tree)

    with pytest.raises(ShardError, match=rf"scene_000001/{name}: already exists, .*Move it away"):
        unpack(packed_depth, tree)

    assert bytes_of(tree) == before


@pytest.mark.parametrize("other", ["cam_04_depth.mkv", "baseline.json"])
def test_other_depth_in_the_place_of_restored_depth_is_refused(
    packed_depth, unpacked, tmp_path, other
):
    tree = shutil.copytree(unpacked[0], tmp_path / "tree")
    shutil.copyfile(tree / KEY / other, tree / KEY / "cam_03_depth.mkv")

    with pytest.raises(ShardError, match=r"scene_000001/cam_03_depth.mkv: already exists, .*"):
        unpack(packed_depth, tree)


@pytest.mark.parametrize("name", ["cam_03_depth.b2frame", "trajectory.json"])
def test_a_damaged_member_is_not_unpacked(shards, tmp_path, name):
    member = scenes_of(shards)[KEY].members[name]
    flip_byte(shards / PAIR, member.offset + 100)

    with pytest.raises(ShardError, match=rf"{PAIR}: {KEY}\.{name}: has crc32"):
        unpack(shards, tmp_path / "tree")

    scene = tmp_path / "tree" / KEY
    assert not (scene / name.replace("b2frame", "mkv")).exists()
    assert not (scene / "_scene_complete.json").exists()
    assert not list((tmp_path / "tree").rglob("*.unfinished"))


def test_where_there_are_no_shards_nothing_is_unpacked(packed_depth, small_release, tmp_path):
    with pytest.raises(ShardError, match=r"holds no index\.parquet\. Pass a folder that"):
        unpack(small_release, tmp_path)
    with pytest.raises(ShardError, match="is remote"):
        unpack("https://example.org/shards", tmp_path)
    with pytest.raises(ShardError, match="holds the shards themselves"):
        unpack(packed_depth, packed_depth)
    with pytest.raises(StorageError, match="does not exist"):
        unpack(tmp_path / "nothing", tmp_path / "tree")


def test_the_commands_pack_and_unpack(small_release, packed_depth, tmp_path):
    out, tree = tmp_path / "shards", tmp_path / "tree"
    succeed("pack", small_release, out, "--depth-codec", "blosc2", "--workers", "1")
    second, third = (succeed("unpack", out, tree) for _ in range(2))

    assert bytes_of(out) == bytes_of(packed_depth)
    assert second.stdout == f"{tree}: 4 scenes unpacked, 0 kept\n"
    assert third.stdout == f"{tree}: 0 scenes unpacked, 4 kept\n"
