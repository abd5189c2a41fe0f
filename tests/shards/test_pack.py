"""Packing: the bytes, one way of packing against another, what stops it and how it goes on."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import zlib
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest

from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex
from stereogenbench_data.schema.records import Member
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.plan import PlannedShard
from stereogenbench_data.shards.writer import ShardTask, pack_task
from stereogenbench_data.sources.files import locked
from tests.cli.command import refused, succeed
from tests.servers.tools import killed_fork, small_disk
from tests.servers.videos import write_video
from tests.shards.shard_files import bytes_of, scenes_of

ONE_EACH = 250_000
"""A target that holds one of the small release's scenes, not two."""

UNIFORM = [f"train-Uniform-{number:06d}.tar" for number in range(2)]
NAMES = ["eval-seen_map-Uniform-000000.tar", "train-IPD_Gaussian-000000.tar", *UNIFORM]


@pytest.fixture(scope="session")
def release(small_release):
    return SceneIndex.open(small_release)


@pytest.fixture(scope="session")
def packed(release, tmp_path_factory):
    """The small release, one scene a shard; not to be changed."""
    out = tmp_path_factory.mktemp("packed")
    pack(release, out, target_bytes=ONE_EACH, workers=1)
    return out


@pytest.fixture
def tree(small_release, tmp_path):
    """A copy of the small release that a test may change."""
    return shutil.copytree(small_release, tmp_path / "release")


def tars(folder):
    return sorted(path.name for path in folder.iterdir() if ".tar" in path.name)


def test_shards_hold_the_bytes_of_the_release_and_nothing_else(packed, small_release):
    found = {}
    for name in NAMES:
        with tarfile.open(packed / name) as tar:
            found |= {info.name: tar.extractfile(info).read() for info in tar}

    names = {path: path.relative_to(small_release) for path in small_release.rglob("scene_*/*")}
    released = {
        f"{name.parent.as_posix()}.{name.name}": p.read_bytes() for p, name in names.items()
    }
    assert found == released


def test_the_index_places_every_file(packed, release):
    index = SceneIndex.open(packed)

    assert len(index) == len(release)
    for row in range(len(index)):
        scene, before = index.scene(row), release.scene(row)
        assert (scene.id, scene.rig, scene.frames) == (before.id, before.rig, before.frames)
        assert scene.members.keys() == before.members.keys()
        for name, member in scene.members.items():
            content = (packed / member.path).read_bytes()[member.offset :][: member.size]
            assert content == Path(release.root, before.members[name].path).read_bytes()
            assert member.crc32 == zlib.crc32(content)
    assert list(index.shards) == NAMES
    for name, facts in index.shards.items():
        content = (packed / name).read_bytes()
        with tarfile.open(packed / name) as tar:
            assert facts.members == len(tar.getnames())
        assert (facts.size, facts.sha256) == (len(content), sha256(content).hexdigest())


def test_packing_again_gives_the_same_bytes_with_two_workers(packed, release, tmp_path):
    report = pack(release, tmp_path / "out", target_bytes=ONE_EACH, workers=2)

    assert bytes_of(tmp_path / "out") == bytes_of(packed)
    assert report.packed == report.part
    assert report.index == tmp_path / "out" / "index.parquet"


def test_packing_in_parts_gives_the_same_bytes(packed, release, tmp_path):
    out = tmp_path / "out"
    how = {"target_bytes": ONE_EACH, "workers": 1}
    reports = [pack(release, out, part=(number, 3), **how) for number in (3, 1, 2)]

    assert bytes_of(out) == bytes_of(packed)
    expected = [(NAMES[2],), (NAMES[0], NAMES[3]), (NAMES[1],)]
    assert [report.part for report in reports] == expected
    assert [len(report.missing) for report in reports] == [3, 1, 0]
    assert [report.index is None for report in reports] == [True, True, False]


@pytest.mark.parametrize("part", [(0, 3), (4, 3)])
def test_a_part_that_cannot_be_is_refused(release, tmp_path, part):
    with pytest.raises(ShardError, match=f"part {part[0]}/{part[1]}: a part is I/N"):
        pack(release, tmp_path, part=part)


def test_finished_shards_are_kept_and_progress_counts_them(release, tmp_path):
    pack(release, tmp_path, target_bytes=ONE_EACH, part=(1, 2), workers=1)
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in tars(tmp_path)}
    seen = []

    how = {"target_bytes": ONE_EACH, "progress": lambda *now: seen.append(now)}
    report = pack(release, tmp_path, workers=1, **how)

    assert len(before) == 2
    assert report.packed == (NAMES[1], NAMES[3])
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in before} == before
    assert 0 < seen[0][0] < seen[-1][0] == seen[-1][1]
    assert seen == sorted(seen)


def test_a_finished_shard_of_another_size_is_refused(packed, release, tmp_path):
    out = shutil.copytree(packed, tmp_path / "out")
    size = (out / NAMES[1]).stat().st_size
    with (out / NAMES[1]).open("ab") as file:
        file.write(b"\0")

    with pytest.raises(ShardError, match=rf"{NAMES[1]}: has {size + 1} bytes, and had {size}"):
        pack(release, out, target_bytes=ONE_EACH, workers=1)


def focal_changed(folder):
    """Edit a scene's focal length: the file keeps its size and its time of change."""
    path = folder / "baseline.json"
    text, before = path.read_text(), path.stat()
    found = re.search(r'"focal_length_mm": *(\d)', text)
    digit = str(9 - int(found[1]))
    path.write_text(text[: found.start(1)] + digit + text[found.end(1) :])
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size


def test_a_release_that_was_edited_after_a_shard_is_another_plan(tree, tmp_path):
    out = tmp_path / "out"
    pack(tree, out, target_bytes=ONE_EACH, part=(1, 2), workers=1)
    focal_changed(tree / "eval/MapSeenInTrain/Uniform/SynthStage/scene_000000")
    SceneIndex.open(tree).write(tree / "index.parquet")

    with pytest.raises(ShardError, match=rf"{out}.*this folder is for another plan"):
        pack(tree, out, target_bytes=ONE_EACH, part=(2, 2), workers=1)

    assert not (out / "index.parquet").exists()


def video_of(name, *, frames=7, unit_m=0.001):
    """Exchange a video of a scene."""
    tags = {"DEPTH_SCALE": str(unit_m)} if name.endswith("mkv") else {}
    return lambda folder: write_video(folder / name, frames=frames, size=(64, 64), tags=tags)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (focal_changed, r"/baseline\.json: .* focal_mm "),
        (video_of("cam_01_rgb.mp4", frames=6), "11 have 7, but cam_01_rgb.mp4 has 6"),
        (video_of("cam_05_depth.mkv", unit_m=0.0015), ": its cameras' units of depth differ"),
    ],
)
def test_files_that_the_index_does_not_know_are_not_packed(tree, tmp_path, change, told):
    SceneIndex.open(tree).write(tree / "index.parquet")
    change(next(tree.glob("train/Uniform/*/scene_000001")))
    sized = [
        replace(scene, members={name: replace(each, size=(tree / each.path).stat().st_size)
                                for name, each in scene.members.items()})
        for scene in scenes_of(tree).values()
    ]  # fmt: skip
    index = SceneIndex.from_scenes(sized, tree)

    match = rf"scene_000001.*{told}.* run `stereogenbench index` on the release"
    with pytest.raises(ShardError, match=match):
        pack(index, tmp_path / "out", target_bytes=ONE_EACH, workers=1)

    assert NAMES[3] not in tars(tmp_path / "out")


@pytest.mark.parametrize(
    "content",
    ["cut", "of another shard", "missing"],
)
def test_a_shard_without_a_usable_index_is_refused(packed, release, tmp_path, content):
    out = shutil.copytree(packed, tmp_path / "out")
    place, other = (next((out / ".parts").glob(f"{name[:-4]}-*.parquet")) for name in NAMES[:2])
    made = {"cut": place.read_bytes()[:-5], "of another shard": other.read_bytes()}
    place.write_bytes(made.get(content, b""))
    if content == "missing":
        place.unlink()

    with pytest.raises(ShardError, match=f"{NAMES[0]}: already exists and was not packed"):
        pack(release, out, target_bytes=ONE_EACH, workers=1)


@pytest.mark.parametrize(
    "change",
    [
        lambda source: Path(shutil.copy2(source, f"{source}.new")).replace(source),
        lambda source: os.truncate(source, 4 * 1024 * 1024 + 1),
    ],
    ids=["replaced", "cut short"],
)  # fmt: skip
def test_a_source_that_is_changed_while_it_is_read_is_an_error(release, tmp_path, change):
    source = tmp_path / "film"
    source.write_bytes(bytes(9 * 1024 * 1024))
    film = {"cam_00_rgb.mp4": Member("film", 0, 9 * 1024 * 1024)}
    shard = PlannedShard("x.tar", 0, (replace(release.scene(0), members=film),))
    task = ShardTask(shard, str(tmp_path), str(tmp_path), "plan")
    calls = []

    def after_bytes(count):
        calls.append(count)
        if len(calls) == 1:
            change(source)

    with pytest.raises(ShardError, match=r"film: (was changed while|ends \d+ bytes before)"):
        pack_task(task, after_bytes)

    assert tars(tmp_path) == []


def test_a_shard_that_another_process_packs_is_left_to_it(release, tmp_path):
    (tmp_path / ".parts").mkdir()

    with (
        locked(tmp_path / ".parts" / f"{NAMES[0]}.lock"),
        pytest.raises(ShardError, match=rf"{NAMES[0]}: another process is packing it"),
    ):
        pack(release, tmp_path, target_bytes=ONE_EACH, workers=1)
    assert tars(tmp_path) == []


def test_a_folder_that_holds_another_plan_is_refused(release, packed, tmp_path):
    out = shutil.copytree(packed, tmp_path / "out")

    match = r"plan\.json: .* another plan \(plan, target_bytes, shards differ\)"
    with pytest.raises(ShardError, match=match):
        pack(release, out, target_bytes=10**9)

    assert bytes_of(out) == bytes_of(packed)


@pytest.mark.parametrize("name", ["other.tar", "index.parquet"])
def test_a_folder_that_holds_something_else_is_refused(release, tmp_path, name):
    (tmp_path / name).write_text("mine")

    with pytest.raises(ShardError, match=f"{name}: already exists .* empty folder"):
        pack(release, tmp_path)

    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == [name]


@pytest.mark.parametrize("place", [".", "train/out", "train/Uniform/SynthStage/scene_000000"])
def test_a_release_is_not_packed_among_its_scenes(tree, place):
    before = sorted(tree.rglob("*"))

    with pytest.raises(ShardError, match=r"the release itself|among the scenes of the release\. "):
        pack(tree, tree / place)

    assert sorted(tree.rglob("*")) == before


def test_shards_are_not_packed_again(packed, tmp_path):
    with pytest.raises(ShardError, match="already holds shards"):
        pack(packed, tmp_path)


def test_packing_goes_on_once_there_is_room(release, packed, tmp_path):
    with small_disk(tmp_path / "disk", size="600k") as place:
        with pytest.raises(ShardError, match="Make room"):
            pack(release, place, target_bytes=ONE_EACH, workers=1)
        subprocess.run(["mount", "-o", "remount,size=10M", place], check=True)

        pack(release, place, target_bytes=ONE_EACH, workers=1)

        assert bytes_of(place) == bytes_of(packed)


def test_the_command_packs_a_share_that_fits(small_release, tmp_path):
    folder = tmp_path / "share"
    most = 2 * sum(path.stat().st_size for path in small_release.rglob("scene_*/*")) // 3

    succeed("pack", small_release, folder, "--max-bytes", most, "--workers", "1")

    packed_bytes = sum(path.stat().st_size for path in folder.glob("*.tar"))
    assert 1 <= len(SceneIndex.open(folder)) < 4
    assert packed_bytes <= most


def test_the_command_packs_and_reports_what_there_is(small_release, tmp_path, packed):
    first = succeed("pack", small_release, tmp_path, "--shard-size", "250kB", "--part", "1/2")
    second = succeed("pack", small_release, tmp_path, "--shard-size", "250kB", "--workers", "1")

    packed_line, remaining_line = first.stdout.splitlines()
    assert packed_line.startswith(f"{tmp_path}: 2 shards packed, 0 ")
    assert remaining_line.startswith("2 shards ")
    assert NAMES[1] in remaining_line
    assert "index" in remaining_line
    told = f"{tmp_path}: 2 shards packed, 2 kept\n{tmp_path / 'index.parquet'}: 4 scenes\n"
    assert second.stdout == told
    assert bytes_of(tmp_path) == bytes_of(packed)


@pytest.mark.parametrize("name", ["trajectory.json", "cam_03_depth.mkv"])
def test_the_command_packs_the_others_and_names_one_scene_that_lacks_a_file(tree, tmp_path, name):
    lacking = next(tree.glob("train/Uniform/*/scene_000001"))
    (lacking / name).unlink()

    with pytest.warns(IncompleteSceneWarning, match=rf"1 of 4 lacks .*scene_000001/{name}: is mis"):
        result = succeed("pack", tree, tmp_path / "out", "--workers", "1")

    assert "index.parquet: 3 scenes" in result.stdout
    keys = SceneIndex.open(tmp_path / "out").column("key").tolist()
    assert len(keys) == 3
    assert lacking.relative_to(tree).as_posix() not in keys


def test_the_command_refuses_a_release_where_many_scenes_lack_a_file(tree, tmp_path):
    for place in list(tree.glob("train/*/*/scene_*/trajectory.json"))[:2]:
        place.unlink()

    told = refused("pack", tree, tmp_path / "out")

    assert "2 of 4 lack a file" in told
    assert "trajectory.json: is missing. Fetch these scenes again" in told
    assert not (tmp_path / "out").exists()


def test_the_command_packs_a_release_without_poses(tree, tmp_path):
    for place in list(tree.rglob("trajectory.json")):
        place.unlink()

    succeed("pack", tree, tmp_path / "out", "--workers", "1")

    assert len(SceneIndex.open(tmp_path / "out")) == 4


def killed_pack(moment, release, out):
    """Pack in a process that is killed at its n-th change of a file; return whether it was."""
    left = moment

    def after_event(event, arguments):
        nonlocal left
        mode = arguments[1] if event == "open" else None
        writes = isinstance(mode, str) and mode[:1] in "wxa" and str(out) in str(arguments[0])
        if writes or event in ("os.rename", "os.remove"):
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    def act():
        sys.addaudithook(after_event)
        pack(release, out, target_bytes=ONE_EACH, workers=1)

    return killed_fork(act)


@pytest.mark.parametrize("moment", [5, 24])
def test_a_killed_pack_goes_on_and_leaves_nothing_behind(
    moment, small_release, release, packed, tmp_path
):
    out = tmp_path / "out"

    was_killed = killed_pack(moment, small_release, out)
    had_index = (out / "index.parquet").is_file()
    had_shards = len(tars(out)) == 4
    pack(release, out, target_bytes=ONE_EACH, workers=1)

    assert was_killed
    assert had_shards or not had_index
    one, other = ({each.relative_to(d) for each in d.rglob("*")} for d in (out, packed))
    assert one == other
    assert bytes_of(out) == bytes_of(packed)
