"""A tree in the released layout behind a URL: found, indexed and read like one on this machine."""

import os
import re
import shutil
from collections import Counter
from io import FileIO
from pathlib import Path

import av
import fsspec
import numpy as np
import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index import build
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.index.tree import find_scene_folders, folder_of, stamp_of
from stereogenbench_data.media import heads
from stereogenbench_data.schema.release import VIDEO_FILES
from stereogenbench_data.sources.remote import RemoteObject
from tests.cli.command import invoke, one_line
from tests.servers.fixtures import BUCKET
from tests.servers.hub import REPOSITORY, hub_serving
from tests.servers.videos import SIZE, write_depth, write_rgb

HUB = f"hf://datasets/{REPOSITORY}@main"


@pytest.fixture
def hub_tree(small_release, monkeypatch):
    """A Hub whose data set is `small_release`."""
    with hub_serving(small_release, monkeypatch) as server:
        yield server


@pytest.fixture(params=["hub", "s3"])
def remote_root(request, small_release):
    """`small_release` in a store, by its URL."""
    if request.param == "hub":
        request.getfixturevalue("hub_tree")
        return HUB
    request.getfixturevalue("s3")
    fsspec.filesystem("s3").put(f"{small_release}/", f"{BUCKET}/tree/", recursive=True)
    return f"s3://{BUCKET}/tree"


def test_a_tree_in_a_store_opens_like_the_folder(remote_root, small_release):
    local = StereoPairs(small_release, pairs="all", frames=[0, 6])
    remote = StereoPairs(remote_root, pairs="all", frames=[0, 6])

    assert remote.index.digest == local.index.digest
    assert len(remote) == len(local)
    for number in (0, 31, 119):
        a, b = local[number], remote[number]
        assert a["__key__"] == b["__key__"]
        np.testing.assert_array_equal(a["left"], b["left"])
        np.testing.assert_array_equal(a["disparity"], b["disparity"])


def test_no_byte_of_depth_is_sent_twice_to_index_a_repository(hub_tree, small_release):
    SceneIndex.open(HUB)

    sizes = sum(path.stat().st_size for path in small_release.rglob("*.mkv"))
    sent = sum(asked.sent for asked in hub_tree.asked if asked.path.endswith(".mkv"))
    assert sent <= sizes


@pytest.fixture
def large_videos(make_scene, root):
    """The key of a scene of noise, whose videos have more than 40 kB each."""
    frames, rng = 100, np.random.default_rng(2)
    folder = make_scene(frames=frames)
    units = rng.integers(0, 2**16, (frames, *SIZE), dtype=np.uint16)
    pictures = rng.integers(0, 256, (frames, *SIZE, 3), dtype=np.uint8)
    depth = write_depth(folder / "cam_00_depth.mkv", units, tags={"DEPTH_SCALE": "0.001"})
    write_rgb(folder / "cam_00_rgb.mp4", pictures, options={"crf": "5"})
    for camera in range(1, 6):
        for name in ("rgb.mp4", "depth.mkv"):
            shutil.copy(folder / f"cam_00_{name}", folder / f"cam_{camera:02d}_{name}")
    assert depth.stat().st_size > 100_000
    return folder.relative_to(root).as_posix()


def test_at_most_40_kb_of_a_video_are_sent_to_describe_a_scene(large_videos, root, monkeypatch):
    local = describe_scene(root, large_videos)
    with hub_serving(root, monkeypatch) as server:
        remote = describe_scene(HUB, large_videos)

    sent, requests = Counter[str](), Counter[str]()
    for asked in server.asked:
        sent[asked.path.rpartition("/")[2]] += asked.sent
        requests[asked.path.rpartition("/")[2]] += asked.sent > 0
    assert remote == local
    assert {name for name in sent if name.startswith("cam_")} == {*VIDEO_FILES}
    assert all(sent[name] <= 40_000 for name in VIDEO_FILES)
    assert max(requests[name] for name in VIDEO_FILES) == 2


def test_at_most_40_kb_of_a_video_are_read_to_describe_a_scene(large_videos, root, monkeypatch):
    read = Counter[str]()

    class CountedFile(FileIO):
        def read(self, size=-1):
            content = super().read(size)
            read[Path(self.name).name] += len(content)
            return content

    def opened(file, **how):
        assert not isinstance(file, str), f"{file} is opened past the count"
        return open_any(file, **how)

    open_any = av.open
    monkeypatch.setattr(heads, "FileIO", CountedFile)
    monkeypatch.setattr(av, "open", opened)
    describe_scene(root, large_videos)

    assert read.keys() == {*VIDEO_FILES}
    assert all(read[name] <= 20_000 for name in VIDEO_FILES)


def test_scenes_that_lie_too_deep_are_told_behind_a_url_too(small_release, tmp_path, monkeypatch):
    tree = shutil.copytree(small_release, tmp_path / "tree", copy_function=os.link)
    (folder,) = tree.glob("train/Uniform/*")
    scenes = sorted(path.name for path in folder.iterdir())
    (folder / "more").mkdir()
    for name in scenes:
        (folder / name).rename(folder / "more" / name)

    with hub_serving(tree, monkeypatch):
        report = build.walk(HUB)

    assert [key.split("/")[-2:] for key in report.broken] == [["more", name] for name in scenes]
    assert all("found 5 folders" in told for told in report.broken.values())


@pytest.mark.usefixtures("hub_tree")
def test_the_command_indexes_a_part_of_a_repository(tmp_path, small_release):
    out = tmp_path / "part.parquet"

    done = invoke("index", HUB, "--split", "eval", "-o", out)

    assert done.exit_code == 0, done.output
    assert f"--root {HUB}" in done.output
    index = SceneIndex.open(out, root=HUB)
    assert set(index.column("split")) == {"eval"}
    key = index.scene(0).id.key
    folder = StereoPairs(small_release, split="eval", fields=("left",))
    pairs = StereoPairs(index, fields=("left",))
    np.testing.assert_array_equal(pairs[0]["left"], folder[0]["left"])
    assert key == folder.index.column("key")[folder.plan.scene_rows[0]]


@pytest.mark.usefixtures("hub_tree")
def test_the_command_tells_requests_and_time_before_it_reads_many_scenes(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "_WARN_ABOVE_REQUESTS", 40)
    monkeypatch.setattr(build, "_SETTLED_BY_REMOTE", 1)

    done = invoke("index", HUB, "-o", tmp_path / "all.parquet")

    assert done.exit_code == 0, done.output
    told = "reads all files of 3 scenes in 87 requests: on the Hub without a login"
    assert re.search(told, one_line(done.output))


def test_a_part_is_indexed_under_a_name_of_its_own(small_release):
    done = invoke("index", small_release, "--split", "eval")

    assert done.exit_code == 2
    assert "--out FILE" in done.output
    assert not (small_release / "index.parquet").exists()


@pytest.mark.usefixtures("hub")
def test_a_repository_without_a_scene_says_what_was_looked_for():
    with pytest.raises(StorageError, match=r"holds no scene; looked for"):
        find_scene_folders(RemoteObject(HUB))


def test_a_unit_of_depth_in_a_file_of_its_own_counts_afar(small_release, tmp_path, monkeypatch):
    (drawn,) = small_release.glob("eval/*/*/*/*")
    key = drawn.relative_to(small_release).as_posix()
    shutil.copytree(drawn, tmp_path / key, copy_function=os.link)
    before = stamp_of(folder_of(tmp_path, key).stamps())
    (tmp_path / key / "depth_meta.json").write_text('{"depth_unit": "cm"}')

    with hub_serving(tmp_path, monkeypatch):
        found = [describe_scene(root, key) for root in (tmp_path, HUB)]

    assert all("depth_meta.json: $.depth_unit is" in scene.remark("depth") for scene in found)
    assert all("depth_meta.json" not in scene.members for scene in found)
    assert stamp_of(folder_of(tmp_path, key).stamps()) != before


def test_a_plain_web_server_cannot_be_listed(web):
    (web.folder / "train").mkdir()

    with pytest.raises(StorageError, match=r"a web server does not list its folders"):
        find_scene_folders(RemoteObject(web.url))
