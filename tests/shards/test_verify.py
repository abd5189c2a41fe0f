"""Verifying shards: each kind of damage is found, named, and reported with its cure."""

import io
import json
import os
import re
import shutil
import tarfile
import zlib
from dataclasses import replace
from hashlib import sha256

import pytest

from stereogenbench_data import StereoPairs
from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import Member, ShardFacts
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.verify import verify
from tests.cli.command import invoke
from tests.shards.shard_files import alter_scene, flip_byte, scenes_of, tar_of

PAIR = "train-Uniform-000000.tar"
SINGLE = "train-IPD_Gaussian-000000.tar"
SCENES = [f"train/Uniform/SynthStage/scene_00000{number}" for number in range(2)]
FETCH = "Fetch the shard again, or pack it again."


@pytest.fixture
def place(shards):
    """Where a file of the index lies."""
    scenes = scenes_of(shards)
    return lambda scene, name: scenes[scene].members[name]


def lines(shards, **how):
    report = verify(shards, workers=1, **how)
    return [str(problem) for problem in report.problems]


def assert_lines(found, *expected):
    """Each line begins with the first text of a tuple, and holds the others in their order."""
    assert len(found) == len(expected), found
    for line, texts in zip(found, expected, strict=True):
        assert re.match(".*".join(map(re.escape, texts)), line), line


@pytest.mark.parametrize(("mode", "videos"), [("bytes", 0), ("decode", 4 * 12)])
def test_sound_shards_have_no_problem_and_progress_ends_at_the_end(small_shards, mode, videos):
    seen, index = [], small_shards / "index.parquet"

    report = verify(index, mode=mode, workers=1, progress=lambda *now: seen.append(now))

    assert report.problems == ()
    assert (report.shards, report.scenes, report.members) == (3, 4, 4 * 17)
    assert report.bytes == sum(path.stat().st_size for path in small_shards.glob("*.tar"))
    assert report.videos_decoded == videos
    assert seen[-1][0] == seen[-1][1]
    assert (seen[-1][1] > report.bytes) == (mode == "decode")
    assert seen == sorted(seen)


@pytest.mark.parametrize("where", ["in a header", "in a payload", "before the end"])
def test_a_cut_shard_is_reported_with_its_size_and_what_is_lost(shards, place, where):
    member = place(SCENES[1], "cam_02_rgb.mp4")
    size = (shards / PAIR).stat().st_size
    cut = {
        "in a header": member.offset - 412,
        "in a payload": member.offset + 10,
        "before the end": size - 1024,
    }[where]
    os.truncate(shards / PAIR, cut)

    told = [(f"{PAIR}: has {cut} bytes", f"{size}: it is cut short", FETCH)]
    if "end" not in where:
        lost = "(cam_02_depth.mkv, cam_02_rgb.mp4, "
        told.append((f"{PAIR}: {SCENES[1]}: 8 of its files ", lost, FETCH))
    assert_lines(lines(shards), *told)


def test_a_flipped_payload_byte_is_reported_with_its_member(shards, place):
    member = place(SCENES[1], "cam_03_depth.mkv")
    flip_byte(shards / PAIR, member.offset + 1000)

    (reported,) = lines(shards)

    assert reported.startswith(f"{PAIR}: {SCENES[1]}: cam_03_depth.mkv: its bytes have crc32 ")
    assert reported.endswith(f", and the index says {member.crc32:08x}. {FETCH}")


def test_a_byte_between_members_is_reported(shards, place):
    member = place(SCENES[0], "_scene_complete.json")
    assert member.size % 512
    flip_byte(shards / PAIR, member.offset + member.size)

    assert_lines(lines(shards), (f"{PAIR}: has sha256 ", "though its files are sound", FETCH))


KEY = "train/Uniform/Town/scene_000001"
FILES = [
    (f"{KEY}.cam_00_depth.mkv", b"{}"),
    (f"{KEY}.cam_00_rgb.mp4", b"left" * 128),
    (f"{KEY}.cam_01_rgb.mp4", b"four" * 128),
]


@pytest.fixture
def toy(small_shards, tmp_path):
    """Verifies a tar in the place of a shard of files, whose index names but those of `FILES`."""
    pattern = SceneIndex.open(small_shards).scene(0)

    def verified(other, *, of=FILES):
        content = tar_of(of)
        with tarfile.open(fileobj=io.BytesIO(content)) as tar:
            files = {each: tar.extractfile(each).read() for each in tar}
        members = {
            each.name.removeprefix(f"{KEY}."): Member(
                "x.tar", each.offset_data, each.size, zlib.crc32(payload)
            )
            for each, payload in files.items()
            if each.name in dict(FILES)
        }
        scene = replace(pattern, id=parse_scene_key(KEY), members=members)
        facts = ShardFacts(len(content), sha256(content).hexdigest(), len(of))
        index = SceneIndex.from_scenes([scene], tmp_path, shards={"x.tar": facts})
        index.write(tmp_path / "index.parquet")
        (tmp_path / "x.tar").write_bytes(other)
        # They are not all files of a scene, which is told, too.
        return [line for line in lines(tmp_path) if "has no baseline.json" not in line]

    assert verified(tar_of(FILES)) == []
    return verified


def test_exchanged_payloads_are_both_reported(toy):
    exchanged = [FILES[0], (FILES[1][0], FILES[2][1]), (FILES[2][0], FILES[1][1])]

    reported = toy(tar_of(exchanged))

    assert [line.split(": ")[2] for line in reported] == ["cam_00_rgb.mp4", "cam_01_rgb.mp4"]
    assert all("its bytes have crc32" in line for line in reported)


def test_a_missing_member_is_reported_and_so_is_what_moved(toy):
    reported = toy(tar_of([FILES[0], FILES[2]]))

    assert_lines(
        reported,
        ("x.tar: has 3072 bytes, and the index says 4096: it is cut short", FETCH),
        (f"x.tar: {KEY}: cam_00_rgb.mp4: its bytes ", FETCH),
        (f"x.tar: {KEY}: cam_01_rgb.mp4: its bytes ", FETCH),
    )


@pytest.mark.parametrize("at", [3, 600, 2 * 512, 3000, -1])
def test_no_damaged_byte_goes_unseen(toy, at):
    content = bytearray(tar_of(FILES))
    content[at] ^= 1

    assert len(toy(bytes(content))) == 1


@pytest.mark.parametrize("place", ["between", "behind"])
def test_a_file_that_the_index_does_not_name_is_reported_though_the_checksums_are_of_it(toy, place):
    """As by somebody who made the index, too: readers of tars would meet the file."""
    added = ("a/x.txt", b"code")

    files = [FILES[0], added, *FILES[1:]] if place == "between" else [*FILES, added]
    reported = toy(tar_of(files), of=files)

    assert_lines(reported, ("x.tar: a/x: txt: its header", "does not name it", FETCH))


def test_shards_that_the_index_does_not_know_are_reported(shards):
    shutil.copy(shards / PAIR, shards / "train-Uniform-000001.tar")

    told = ("train-Uniform-000001.tar: is not in the index", "Put the index beside the shards")
    assert_lines(lines(shards), told)


def test_all_problems_are_listed_whatever_the_workers(shards, place):
    (shards / SINGLE).unlink()
    for scene in SCENES:
        flip_byte(shards / PAIR, place(scene, "trajectory.json").offset)

    reported = verify(shards, workers=2).problems

    expected = [(SINGLE, "", ""), *((PAIR, scene, "trajectory.json") for scene in SCENES)]
    assert [(each.shard, each.scene, each.member) for each in reported] == expected


def test_a_video_that_does_not_decode_is_reported_by_decoding(small_release, tmp_path):
    tree = shutil.copytree(small_release, tmp_path / "tree")
    flip_byte(tree / SCENES[0] / "cam_05_depth.mkv")
    pack(tree, tmp_path / "out", workers=1)

    assert lines(tmp_path / "out") == []
    told = (f"{PAIR}: {SCENES[0]}: cam_05_depth.mkv: ", "Pack the scene again from an undamaged")
    assert_lines(lines(tmp_path / "out", mode="decode"), told)


def test_a_folder_that_was_not_finished_is_refused(shards):
    (shards / "index.parquet").unlink()

    with pytest.raises(ShardError, match="Packing was not finished: run `stereogenbench pack`"):
        verify(shards)


def test_remote_shards_must_be_downloaded_first(tmp_path):
    with pytest.raises(ShardError, match=r"shards : is remote\. Download the shards"):
        verify("https://example.org/shards")


@pytest.mark.parametrize(
    ("member", "change", "found"),
    [
        ("baseline.json", lambda scene: {"rig": replace(scene.rig, focal_mm=99.0)},
         "tells focal_mm "),
        ("baseline.json", lambda scene: {"rig": replace(scene.rig, image_width_px=63)},
         "tells image_width_px 64, and by the index it is 63"),
        ("trajectory.json", lambda scene: {"pose_form": "R: matrix, opencv axes @ 1.0"},
         "no reading of its poses fits the rig of baseline.json"),
        ("cam_00_depth.mkv", lambda scene: {"depth_unit_m": (1.0, *scene.depth_unit_m[1:])},
         "tells depth_unit_m 0.001, and by the index it is 1.0"),
        ("cam_05_depth.mkv", lambda scene: {"depth_codec": (*scene.depth_codec[:5], "hevc")},
         "tells depth_codec 'ffv1', and by the index it is 'hevc'"),
        ("trajectory.json", lambda scene: {"frames": 8},
         "tells frames 7, and by the index it is 8"),
        ("trajectory.json", lambda scene: {"lateral_m": (0.0,) * 6}, "tells lateral_m (0.0, "),
        ("scene_description_qwen_dataset_level.json", lambda scene: {"caption": "Snow."},
         "and by the index it is 'Snow.'"),
        ("", lambda scene: {"id": replace(scene.id, family="IPD_Gaussian")},
         "its path tells family 'Uniform', and by the index it is 'IPD_Gaussian'"),
    ],
)  # fmt: skip
def test_an_index_that_contradicts_a_shards_metadata_is_reported(shards, member, change, found):
    alter_scene(shards, SCENES[1], change)

    (reported,) = lines(shards)

    assert reported.startswith(": ".join(part for part in (PAIR, SCENES[1], member) if part) + ": ")
    assert found in reported
    assert reported.endswith(". Fetch the shard and its index again, or pack them again.")


def test_shards_beside_which_an_earlier_version_wrote_files_for_other_readers_are_sound(shards):
    (shards / "dali").mkdir()
    (shards / "dali" / f"{PAIR[:-4]}.idx").write_text("v1.2 0\n")
    (shards / "shards.json").write_text('{"__kind__": "wids-shard-index-v1", "shardlist": []}')

    assert lines(shards, mode="decode") == []
    assert len(StereoPairs(shards)) > 0


def test_a_damaged_index_of_shards_is_to_be_fetched_or_packed_again(shards):
    os.truncate(shards / "index.parquet", (shards / "index.parquet").stat().st_size // 2)

    with pytest.raises(StorageError, match="the index of shards: fetch it again or, where"):
        verify(shards)


@pytest.mark.parametrize(
    ("crc32", "told"), [(1, "cam_02_rgb.mp4: has crc32 .* 00000001"), (None, "the index has none")]
)
def test_a_checksum_that_the_index_alone_has_wrong_is_reported(shards, place, crc32, told):
    altered = {"cam_02_rgb.mp4": replace(place(SCENES[0], "cam_02_rgb.mp4"), crc32=crc32)}
    alter_scene(shards, SCENES[0], lambda scene: {"members": scene.members | altered})

    (reported,) = lines(shards)
    assert re.search(rf"{PAIR}: {SCENES[0]}: .*{told}", reported)


def test_an_index_that_contradicts_itself_is_refused(shards):
    index = SceneIndex.open(shards)
    index.shards.pop(PAIR)
    index.write(shards / "index.parquet")

    with pytest.raises(ShardError, match=f"in {PAIR}, but does not list this shard"):
        verify(shards)


def test_a_missing_shard_is_reported_with_what_it_held_as_json_too(shards):
    (shards / PAIR).unlink()

    result = invoke("verify", shards, "--workers", "1", "--json")

    reported = json.loads(result.stdout)
    assert result.exit_code == 1
    assert (reported["shards"], reported["scenes"]) == (3, 4)
    (problem,) = reported["problems"]
    assert (problem["shard"], problem["found"]) == (PAIR, "is missing, with 2 scenes")
    assert_lines(lines(shards, mode="decode"), (f"{PAIR}: is missing", "2 scenes", FETCH))


def test_a_released_folder_is_not_shards(small_release, tmp_path):
    SceneIndex.open(small_release).write(tmp_path / "index.parquet")

    with pytest.raises(ShardError, match="is the index of a released folder, not of shards"):
        verify(tmp_path, root=small_release)
