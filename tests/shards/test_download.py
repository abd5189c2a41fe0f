"""Downloading a part of a release: only what is asked for, checked, gone on with, usable."""

import os
import shutil
import subprocess

import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.table import IncompleteSceneWarning, StaleIndexWarning
from stereogenbench_data.schema.release import depth_name, rgb_name
from stereogenbench_data.shards.download import download, wanted_files
from tests.cli.command import COMMAND, refused, succeed
from tests.servers.failing_server import Answer
from tests.servers.tools import wait_until
from tests.shards.shard_files import bytes_of


@pytest.fixture
def shards_on_the_web(web, small_shards):
    shutil.copytree(small_shards, web.folder / "shards")
    return f"{web.url}/shards"


def fetched(url, dest, *, cameras=(0, 1), streams=("rgb", "depth"), rows=(0, 1), **how):
    index = SceneIndex.open(url)
    scenes = [wanted_files(index.scene(row), cameras=cameras, streams=streams) for row in rows]
    return download(index, scenes, dest, **how)


def test_only_the_files_of_the_cameras_are_fetched(shards_on_the_web, web, small_release, tmp_path):
    dest = tmp_path / "part"

    index = fetched(shards_on_the_web, dest)

    files = sorted(path.relative_to(dest) for path in dest.rglob("*.*") if path.is_file())
    assert len([path for path in files if path.suffix in (".mp4", ".mkv")]) == 2 * 4
    for path in files:
        if path.name != "index.parquet":
            assert (dest / path).read_bytes() == (small_release / path).read_bytes()
    sent = sum(asked.sent for asked in web.asked if asked.path.endswith(".tar"))
    members = [member for row in range(2) for member in index.scene(row).members.values()]
    assert sent == sum(member.size for member in members)


def test_a_camera_that_was_not_fetched_is_named(shards_on_the_web, tmp_path):
    fetched(shards_on_the_web, tmp_path / "part", streams=("rgb",))

    assert len(StereoPairs(tmp_path / "part", pairs=[(0, 1)], fields=("left", "right"))) == 2
    with pytest.raises(StorageError, match=r"has no cam_00_depth; videos of cameras 00, 01 were"):
        StereoPairs(tmp_path / "part", pairs=[(0, 1)])
    with pytest.raises(StorageError, match=r"has no cam_02_rgb, cam_03_rgb"):
        StereoPairs(tmp_path / "part", pairs=[(2, 3)], fields=("left", "right"))


def test_a_part_can_be_indexed_packed_shown_and_audited(shards_on_the_web, here):
    part = here / "part"
    fetched(shards_on_the_web, part)
    (part / "index.parquet").unlink()

    for command in (
        ["index", part], ["pack", part, "shards"], ["show", part, "-o", "sheet.png"],
        ["audit", part], ["conventions", part],
    ):  # fmt: skip
        succeed(*command)
    for data in (part, "shards"):
        assert len(StereoPairs(data, pairs=[(0, 1)])) == 2
        assert not SceneIndex.open(data).remarked("videos").size


def test_a_stopped_run_goes_on_where_it_was(shards_on_the_web, web, tmp_path):
    dest = tmp_path / "part"
    fetched(shards_on_the_web, dest)
    lost = next(dest.rglob("cam_01_depth.mkv"))
    size = lost.stat().st_size
    lost.unlink()
    web.asked.clear()

    fetched(shards_on_the_web, dest)

    assert sum(asked.sent for asked in web.asked if asked.path.endswith(".tar")) == size
    assert lost.stat().st_size == size


def test_a_damaged_file_is_refused_and_leaves_nothing_behind(shards_on_the_web, web, tmp_path):
    shard = SceneIndex.open(shards_on_the_web).scene(0).members["baseline.json"].path
    web.always[f"shards/{shard}"] = Answer(change=lambda data: bytes([data[0] ^ 1]) + data[1:])

    match = rf"{shard} ?: .*\.baseline\.json: has crc32 [0-9a-f]{{8}}, and .* fetch"
    with pytest.raises(StorageError, match=match):
        fetched(shards_on_the_web, tmp_path / "part", rows=(0,), workers=1)

    assert [path for path in (tmp_path / "part").rglob("*") if path.is_file()] == []


def test_a_full_disk_is_reported_before_a_fetch(shards_on_the_web, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=0))

    with pytest.raises(StorageError, match=r"part: needs \d+ bytes, and the disk has \d+ left"):
        fetched(shards_on_the_web, tmp_path / "part")


def test_the_folder_of_the_data_is_refused(small_release):
    with pytest.raises(StorageError, match=r"is the folder of the data"):
        fetched(small_release, small_release)


def test_the_command_says_the_size_first_and_reports(small_release, tmp_path):
    dest = tmp_path / "part"
    words = ["download", small_release, "-o", dest, "--split", "eval", "--cameras", "0,5"]

    said, done = succeed(*words, "--dry-run"), succeed(*words)

    assert "1 scene, 9 files" in said.stderr
    assert said.stdout == ""
    assert f"{dest}: 1 scene, " in done.stdout
    assert len(StereoPairs(dest, pairs=[(0, 5)])) == 1


def test_a_share_passes_over_scenes_without_the_wanted_videos(small_release, tmp_path):
    root = shutil.copytree(small_release, tmp_path / "part", copy_function=os.link)
    lacking = sorted(root.rglob("cam_05_rgb.mp4"))[0]
    lacking.unlink()

    words = ["download", root, "-o", "unused", "--streams", "rgb", "--dry-run", "--cameras", "5"]
    with pytest.warns(IncompleteSceneWarning, match=lacking.name):
        all_that_have_it = succeed(*words, "--scenes", 3)
    with pytest.warns(IncompleteSceneWarning, match=lacking.name):
        more = refused(*words, "--scenes", 4)

    assert "3 scenes, " in all_that_have_it.stderr
    assert "3" in more


def test_a_share_of_scenes_that_all_lack_a_wanted_video_names_it(shards_on_the_web, tmp_path):
    fetched(shards_on_the_web, tmp_path / "part", streams=("rgb",))

    words = ["download", tmp_path / "part", "-o", tmp_path / "not", "--scenes", 1]
    told = refused(*words, "--cameras", "0", "--streams", "depth")

    assert "the index has no cam_00_depth" in told


def test_a_metadata_file_of_another_revision_is_fetched_again(shards_on_the_web, tmp_path):
    dest = tmp_path / "part"
    fetched(shards_on_the_web, dest)
    changed = next(dest.rglob("baseline.json"))
    text = changed.read_bytes()
    changed.write_bytes(text.replace(b"1", b"2"))

    fetched(shards_on_the_web, dest)

    assert changed.read_bytes() == text


def test_a_killed_download_leaves_whole_files_and_goes_on(
    shards_on_the_web, small_release, web, tmp_path
):
    """The process is killed while a server that answers slowly has sent some files."""
    dest = tmp_path / "part"
    command = ["download", shards_on_the_web, "-o", str(dest)]
    for name in sorted(path.relative_to(web.folder) for path in web.folder.rglob("*.tar")):
        web.always[str(name)] = Answer(delay_s=0.1)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    killed = subprocess.Popen([*COMMAND, *command], **quiet)
    wait_until(lambda: list(dest.rglob("cam_00_rgb.mp4")))
    killed.kill()
    killed.wait()
    there = [path for path in dest.rglob("*.*") if not path.name.startswith(".") and path.is_file()]
    web.always.clear()

    succeed(*command)

    assert 0 < len(there) < 4 * 17
    for path in there:
        assert path.read_bytes() == (small_release / path.relative_to(dest)).read_bytes()
    assert len(StereoPairs(dest, pairs="all")) == 4 * 15
    assert not list(dest.rglob(".*"))


def test_downloads_into_one_folder_add_up(shards_on_the_web, tmp_path):
    fetched(shards_on_the_web, tmp_path / "part", rows=(0, 1), streams=("rgb",))
    fetched(shards_on_the_web, tmp_path / "part", rows=(1, 2), cameras=(1, 2))

    index = SceneIndex.open(tmp_path / "part")
    videos = [set(index.scene(row).held_videos) for row in range(3)]
    first = {rgb_name(0), rgb_name(1)}
    second = {name(camera) for camera in (1, 2) for name in (rgb_name, depth_name)}
    assert not index.stale
    assert videos == [first, first | second, second]


def test_what_was_removed_since_an_earlier_download_is_not_listed(shards_on_the_web, tmp_path):
    first = fetched(shards_on_the_web, tmp_path / "part", rows=(0, 1))
    shutil.rmtree(tmp_path / "part" / first.scene(0).id.key)

    with pytest.warns(StaleIndexWarning, match="1 scene of the index, and not there"):
        index = fetched(shards_on_the_web, tmp_path / "part", rows=(2,))
    fetched_key = SceneIndex.open(shards_on_the_web).scene(2).id.key

    assert {*index.column("key")} == {first.scene(1).id.key, fetched_key}


def test_a_folder_with_an_index_of_other_data_is_refused(shards_on_the_web, small_shards, shards):
    with pytest.raises(StorageError, match="shards: has the index of other data"):
        fetched(shards_on_the_web, shards)
    assert bytes_of(shards) == bytes_of(small_shards)
