"""Links in a data folder: what leads out of it is read, and never passed on to others."""

import shutil

import pytest

from stereogenbench_data import StereoPairs
from stereogenbench_data.bridges.card import write_card
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import DESCRIPTION_TXT
from stereogenbench_data.shards.download import download, wanted_files
from stereogenbench_data.shards.pack import pack

SCENE = "train/Uniform/SynthStage/scene_000000"
TEXT = f"{SCENE}/{DESCRIPTION_TXT}"


@pytest.fixture
def tree(small_release, tmp_path):
    """A copy of the small release that a test may change."""
    return shutil.copytree(small_release, tmp_path / "data" / "tree")


def link_away(tree, path, *, to):
    """Move a file or a folder of a tree elsewhere, and leave a link to it."""
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(tree / path, to)
    (tree / path).symlink_to(to)


def fetch(tree, dest):
    index = SceneIndex.open(tree)
    scenes = map(index.scene, range(len(index)))
    wanted = [wanted_files(scene, cameras=[0], streams=["rgb"]) for scene in scenes]
    return download(index, wanted, dest)


PASSED_ON = {"pack": lambda tree, out: pack(tree, out, workers=1), "download": fetch}


@pytest.mark.parametrize("what", PASSED_ON)
@pytest.mark.parametrize("linked", [TEXT, f"{SCENE}/cam_00_rgb.mp4", SCENE, "train"])
def test_what_a_link_leads_out_to_is_not_passed_on(what, linked, tree, tmp_path):
    link_away(tree, linked, to=tmp_path / "elsewhere" / "secret")
    out = tmp_path / "out"

    told = rf"tree/train/\S+: leads out of {tree} by a link, to {tmp_path}/elsewhere/secret.*Copy"
    with pytest.raises(StorageError, match=told):
        PASSED_ON[what](tree, out)

    assert not list(out.rglob("*.tar")) + list(out.rglob("*.mp4"))
    assert len(StereoPairs(tree)) == 4


@pytest.mark.parametrize("what", PASSED_ON)
def test_a_name_that_begins_alike_is_another_folder(what, tree, tmp_path):
    link_away(tree, TEXT, to=tree.with_name("tree2") / "secret")

    with pytest.raises(StorageError, match="leads out of"):
        PASSED_ON[what](tree, tmp_path / "out")


@pytest.mark.parametrize("what", PASSED_ON)
def test_links_within_the_folder_and_the_folder_itself_may_be_links(what, tree, tmp_path):
    link_away(tree, f"{SCENE}/cam_00_rgb.mp4", to=tree / ".store" / "a.mp4")
    link_away(tree, "train/IPD_Gaussian", to=tree / ".store" / "IPD")
    (tmp_path / "way").symlink_to(tree)

    PASSED_ON[what](tmp_path / "way", tmp_path / "out")


def test_a_snapshot_of_the_hubs_cache_is_passed_on(small_release, tmp_path):
    repository = tmp_path / "datasets--org--name"
    snapshot = shutil.copytree(small_release, repository / "snapshots" / "abc" / "release")
    for number, path in enumerate([each for each in snapshot.rglob("*") if each.is_file()]):
        link_away(path.parent, path.name, to=repository / "blobs" / str(number))

    assert pack(snapshot, tmp_path / "out", workers=1).index is not None


def test_shards_one_of_which_lies_elsewhere_have_no_card(small_release, tmp_path):
    pytest.importorskip("huggingface_hub")
    shards = tmp_path / "shards"
    pack(small_release, shards, workers=1)
    name = next(path.name for path in shards.glob("*.tar"))
    link_away(shards, name, to=tmp_path / "elsewhere.tar")

    with pytest.raises(StorageError, match=rf"{name}: leads out of {shards} by a link"):
        write_card(SceneIndex.open(shards), shards, repository="org/name")
    assert not (shards / "README.md").exists()
    assert (shards / name).is_symlink()
