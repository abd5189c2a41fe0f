"""Which scene goes into which shard."""

from dataclasses import replace

import pytest

from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import Member
from stereogenbench_data.shards.plan import MEMBER_ORDER, parse_bytes, plan_shards, planned_members


@pytest.fixture(scope="module")
def pattern(small_release):
    return SceneIndex.open(small_release).scene(0)


@pytest.fixture
def index_of(pattern):
    """An index of scenes with these keys, each with one file of so many bytes."""

    def make(sizes, **places):
        scenes = []
        for key, size in sizes.items():
            members = {"baseline.json": Member(f"{key}/baseline.json", 0, size)}
            scenes.append(replace(pattern, id=parse_scene_key(key), members=members))
        return SceneIndex.from_scenes(scenes, places.pop("root", "/release"), **places)

    return make


def key(number, family="Uniform"):
    return f"train/{family}/Town/scene_{number:06d}"


def test_shards_are_filled_in_the_order_of_keys_with_whole_scenes(index_of):
    """A scene of 512 bytes takes 1024; the end of a shard takes 1024 too."""
    plan = plan_shards(index_of({key(number): 512 for number in range(5)}), 3 * 1024)

    assert [shard.keys for shard in plan.shards] == [
        (key(0), key(1)),
        (key(2), key(3)),
        (key(4),),
    ]
    assert [shard.size for shard in plan.shards] == [3072, 3072, 2048]
    names = [f"train-Uniform-{number:06d}.tar" for number in range(3)]
    assert [shard.name for shard in plan.shards] == names


def test_a_scene_larger_than_the_target_has_a_shard_of_its_own(index_of):
    plan = plan_shards(index_of({key(0): 1, key(1): 90_000, key(2): 1, key(3): 1}), 5000)

    assert [shard.keys for shard in plan.shards] == [(key(0),), (key(1),), (key(2), key(3))]


def test_splits_subsets_and_families_have_shards_of_their_own(index_of):
    keys = [key(0), key(0, "IPD_Gaussian"), "eval/MapUnseenInTrain/Uniform/Town/scene_000000"]

    plan = plan_shards(index_of(dict.fromkeys(keys, 1)), 10**9)

    groups = ["eval-unseen_map-Uniform", "train-IPD_Gaussian", "train-Uniform"]
    assert [shard.name for shard in plan.shards] == [f"{group}-000000.tar" for group in groups]


def test_files_come_metadata_first_then_camera_by_camera(small_release):
    members = planned_members(SceneIndex.open(small_release).scene(0), depth_codec="released")

    names = [member.name.partition(".")[2] for member in members]

    assert names == [name for name in MEMBER_ORDER if name in names]
    assert names[:3] == ["baseline.json", "trajectory.json", "_scene_complete.json"]
    assert names[-4:] == [
        "cam_04_rgb.mp4", "cam_04_depth.mkv", "cam_05_rgb.mp4", "cam_05_depth.mkv",
    ]  # fmt: skip


def test_a_plan_is_the_same_each_time_and_wherever_the_release_lies(index_of):
    sizes = {key(number): 512 for number in range(5)}
    plan = plan_shards(index_of(sizes), 3072)

    moved = index_of(dict(reversed(sizes.items())), root="/moved")
    assert plan_shards(moved, 3072) == replace(plan, root="/moved")


@pytest.mark.parametrize(
    ("sizes", "target"),
    [({key(0): 512, key(1): 513}, 3072), ({key(0): 512, key(2): 512}, 3072),
     ({key(0): 512, key(1): 512}, 3073), ({key(0): 512}, 3072)],
    ids=["a size", "a key", "the target", "a scene less"],
)  # fmt: skip
def test_another_release_or_target_is_another_plan(index_of, sizes, target):
    digest = plan_shards(index_of({key(0): 512, key(1): 512}), 3072).digest

    assert plan_shards(index_of(sizes), target).digest != digest


def test_a_file_of_8_gib_is_refused(index_of):
    with pytest.raises(ShardError, match="has 8589934592 bytes, and ustar cannot"):
        plan_shards(index_of({key(0): 8 * 2**30}))


def test_data_behind_a_url_are_not_packed(index_of):
    with pytest.raises(ShardError, match=r"example\.org/data : is remote\. Download"):
        plan_shards(index_of({key(0): 1}, root="https://example.org/data"))


@pytest.mark.parametrize(
    ("text", "size"),
    [("500MB", 500_000_000), ("2GiB", 2**31), ("1.5 kb", 1500), ("12", 12), ("3k", 3000)],
)
def test_a_size_is_read_as_it_is_written(text, size):
    assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["GB", "-2GB", "2 parsecs", "0"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(ShardError, match=f"{text!r} is not a size: write one such as 500MB"):
        parse_bytes(text)
