"""A flipped bit that still decodes: found by the checksums of whole members, never trained on."""

import shutil

import pytest
import torch
from torch.utils.data import DataLoader

from stereogenbench_data import SceneViews, StereoPairs
from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.build import walk
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import rgb_name
from stereogenbench_data.shards.pack import pack
from tests.shards.shard_files import flip_byte

SCENE = "train/IPD_Gaussian/SynthStage/scene_000000"
SHARD = "train-IPD_Gaussian-000000.tar"
WRONG = rf"{SHARD} ?: {rgb_name(0)}: has crc32 [0-9a-f]{{8}}, and the index says [0-9a-f]{{8}}. It"


def selected(root, **options):
    return StereoPairs(root, scenes=SCENE, fields=("left", "right"), **options)


def flip(root, pairs, *, place):
    """Flip the lowest bit of a byte of the first view's video, at 0 the first, at 1 the last."""
    member = pairs.index.scene(pairs.plan.locate(0, epoch=0).row).members[rgb_name(0)]
    flip_byte(root / SHARD, member.offset + min(int(member.size * place), member.size - 1))


def harmless_flip(root):
    """Flip a bit of the first view's video after which all its frames decode, some differently."""
    pairs = selected(root, frames="all", check="metadata")
    before = [sample["left"] for sample in pairs]
    for step in range(20, 90):
        flip(root, pairs, place=step / 100)
        pairs.close()
        try:
            after = [sample["left"] for sample in pairs]
        except (ValueError, OSError):
            after = before
        if not all(map(torch.equal, before, after)):
            pairs.close()
            return
        flip(root, pairs, place=step / 100)
    raise AssertionError("no flipped bit decodes to another picture")


@pytest.mark.parametrize(
    "options", [{"frames": ("clips", 4)}, {"frames": "first", "check": "opened"}], ids=str
)
def test_a_flipped_bit_that_decodes_is_found_when_most_frames_are_read(shards, options):
    harmless_flip(shards)

    with pytest.raises(ShardError, match=WRONG):
        selected(shards, **options)[0]
    with pytest.raises(ShardError, match=WRONG):
        SceneViews(shards, scenes=SCENE, fields=("image",), **options)[0]


def test_it_is_found_in_workers_and_by_the_loader(shards):
    harmless_flip(shards)
    pairs = selected(shards, frames="all")

    with pytest.raises(ShardError, match=WRONG):
        list(DataLoader(pairs, batch_size=None, num_workers=1))
    with pytest.raises(ShardError, match=WRONG):
        list(pairs.loader(2))


@pytest.fixture
def folder(small_release, tmp_path):
    """A copy of a folder, indexed with checksums, in which then a bit was flipped."""
    root = shutil.copytree(small_release, tmp_path / "folder")
    SceneIndex.from_report(walk(root, checksums="all")).write(root / INDEX_NAME)
    flip_byte(root / SCENE / rgb_name(0))
    return root


@pytest.mark.parametrize(
    "options", [{"frames": ("clips", 4)}, {"frames": "first", "check": "opened"}], ids=str
)
def test_a_flipped_bit_of_a_folder_with_checksums_is_found(folder, options):
    told = rf"{SCENE}/{rgb_name(0)}: has crc32 [0-9a-f]{{8}}, and the index says"

    with pytest.raises(ShardError, match=told):
        selected(folder, **options)[0]
    with pytest.raises(ShardError, match=told):
        pack(folder, folder.parent / "packed", workers=1)


def test_a_flipped_bit_of_a_text_is_found_with_checksums(folder):
    (path,) = (folder / SCENE).glob("trajectory.json")
    text = path.read_bytes()
    path.write_bytes(text.replace(b"1", b"2", 1))

    with pytest.raises(ShardError, match=r"trajectory.json: has crc32 .*, and the index says"):
        SceneViews(folder, scenes=SCENE, fields=("world_from_cam",), check="metadata")[0]


@pytest.mark.parametrize("options", [{"frames": "first"}, {"frames": "all", "check": "metadata"}])
def test_single_frames_are_given_without_reading_the_rest(shards, options, small_shards):
    pairs = selected(shards, **options)
    flip(shards, pairs, place=1)  # in a text of the MP4's table behind the pictures

    assert torch.equal(pairs[0]["left"], selected(small_shards)[0]["left"])


def test_a_video_is_compared_once_a_process(shards):
    pairs = selected(shards, frames="all")
    assert pairs[0]["left"].shape == (3, 64, 64)
    pairs.close()
    flip(shards, pairs, place=1)

    assert pairs[0]["left"].shape == (3, 64, 64)
    pairs.close()
    with pytest.raises(ShardError, match=WRONG):
        selected(shards, frames="all")[0]


def test_from_a_url_it_is_found_when_the_last_byte_has_come(shards, web):
    harmless_flip(shards)
    shutil.copytree(shards, web.folder, dirs_exist_ok=True)

    with pytest.raises(ShardError, match=WRONG):
        list(selected(web.url, frames="all"))
    assert len(list(selected(web.url, frames="all", check="metadata"))) == 7
    assert "left" in selected(web.url)[0]
