"""One scene by its key, or by a part of it."""

from dataclasses import replace

import pytest

from stereogenbench_data import SceneIndex, SelectionError
from stereogenbench_data.selection.filters import find_scene


@pytest.fixture(scope="module")
def index(small_release):
    return SceneIndex.open(small_release)


def keys(index):
    return index.column("key").tolist()


@pytest.mark.parametrize("text", ["scene_000001", "SCENE_000001", "/scene_000001/", "000001"])
def test_a_part_that_one_key_alone_has_finds_it(index, text):
    assert keys(index)[find_scene(index, text)] == "train/Uniform/SynthStage/scene_000001"


def test_whole_folders_of_one_key_win_over_a_part_of_others(index):
    scene, keys = index.scene(0), [f"train/{name}/A/b" for name in ("Pairwise_Uniform", "Uniform")]
    both = [replace(scene, id=replace(scene.id, key=key)) for key in keys]

    assert find_scene(SceneIndex.from_scenes(both, index.root), "uniform") == 1


def test_a_part_of_several_keys_names_them(index):
    with pytest.raises(SelectionError, match=r"'scene_000000' is a part of 3 keys: eval/.*Give"):
        find_scene(index, "scene_000000")


def test_what_is_no_part_names_the_keys_that_are_close(index):
    with pytest.raises(
        SelectionError, match=r"'scene_00001' is not a key .* Did you mean .*_000001"
    ):
        find_scene(index, "scene_00001")
