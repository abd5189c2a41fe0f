"""A tree in the released layout behind a URL: found, indexed and read like one on this machine."""

import os
import shutil

import fsspec
import numpy as np
import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index import build
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.index.tree import find_scene_folders, folder_of, stamp_of
from stereogenbench_data.sources.remote import RemoteObject
from tests.cli.command import invoke, one_line
from tests.servers.fixtures import BUCKET
from tests.servers.hub import REPOSITORY, hub_serving

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
    monkeypatch.setattr(build, "_MOST_UNTOLD", 40)

    done = invoke("index", HUB, "-o", tmp_path / "all.parquet")

    assert done.exit_code == 0, done.output
    told = "reads all files of 4 scenes, in 116 requests: on the Hub without a login"
    assert told in one_line(done.output)


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
