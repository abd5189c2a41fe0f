"""A bit that flips in a time of depth never brings another moment's: folder, shard, blosc2."""

import random
import shutil
from contextlib import suppress

import numpy as np
import pytest

from stereogenbench_data import SceneIndex, StereoGenBenchError, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.shards.pack import pack
from tests.media.test_altered_times import block_times, flipped

FRAMES = 17
DEPTH = "cam_00_depth.mkv"
SHUFFLED = random.Random(3).sample(range(FRAMES), FRAMES)


@pytest.fixture(scope="module")
def truth(drawn):
    pairs = StereoPairs(drawn, frames="all", fields=("depth",))
    depths = [pairs[frame]["depth"].numpy() for frame in range(FRAMES)]
    assert all((a != b).any() for a in depths for b in depths if a is not b)
    return depths


def bits_of_times(content):
    """Return (place, bit) of some bits of the times, each of two bytes, of some blocks."""
    places = block_times(content)
    return [
        (places[2 * block + low], bit)
        for block in (0, 11, 12, 16)
        for low, bit in ((0, 1), (1, 0), (1, 6))
    ]


def wrong_frames(index, truth, *, check):
    """Return (frame asked for, frame given) wherever another one is given."""
    wrong = []
    for frames, order in ((12, (0,)), ("all", range(FRAMES)), ("all", SHUFFLED)):
        pairs = StereoPairs(index, frames=frames, fields=("depth",), check=check)
        for place in order:
            asked = 12 if frames == 12 else place
            with suppress(StereoGenBenchError):
                found = pairs[place]["depth"].numpy()
                given = [frame for frame in range(FRAMES) if np.array_equal(found, truth[frame])]
                wrong += [(asked, given)] if given != [asked] else []
    return wrong


def test_an_altered_time_in_a_folder_brings_no_other_frame_and_no_index(drawn, truth, tmp_path):
    index = SceneIndex.open(drawn)
    root = tmp_path / "scenes"
    shutil.copytree(drawn, root)
    key = index.scene(0).id.key
    content = (root / key / DEPTH).read_bytes()
    moved = SceneIndex.from_scenes([index.scene(0)], root)
    wrong, indexed, told = [], [], []
    for place, bit in bits_of_times(content):
        (root / key / DEPTH).write_bytes(flipped(content, place, bit))
        wrong += wrong_frames(moved, truth, check="read")
        try:
            described = describe_scene(root, key)
        except StorageError as error:
            told.append(str(error))
            continue
        if DEPTH in described.members:
            indexed.append(bit)
        else:
            told.append(described.remark("videos"))

    assert wrong == []
    assert all(f"{DEPTH}: its frame " in each for each in told)
    assert len(told) == 8
    assert set(indexed) <= {0}, "a tick is what rounding leaves open; more is refused"


@pytest.mark.parametrize("check", ["metadata", "read"])
def test_an_altered_time_in_a_shard_brings_no_other_frame(drawn, truth, tmp_path, check):
    pack(drawn, tmp_path / "shards", workers=1)
    index = SceneIndex.open(tmp_path / "shards")
    member = index.scene(0).member(DEPTH)
    shard = tmp_path / "shards" / member.path
    whole = shard.read_bytes()
    content = whole[member.offset : member.offset + member.size]
    wrong = []
    for place, bit in bits_of_times(content)[:: 1 if check == "metadata" else 5]:
        shard.write_bytes(flipped(whole, member.offset + place, bit))
        wrong += wrong_frames(index, truth, check=check)

    assert wrong == []
