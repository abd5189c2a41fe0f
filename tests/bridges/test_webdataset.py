"""The pipeline stage for webdataset: the samples of `StereoPairs`, out of plain tars."""

import gc
import json
import tempfile

import numpy as np
import pytest
import webdataset
from torch.utils.data import DataLoader

from stereogenbench_data import StereoPairs
from stereogenbench_data.bridges.webdataset import decode
from stereogenbench_data.errors import SchemaError, SelectionError, StorageError
from tests.bridges.conftest import require_equal, require_frames_of_epochs

FIELDS = ("left", "right", "disparity", "valid", "baseline_m", "pair", "scene", "__key__")

pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)
"""Webdataset leaves its files to the garbage collector, which warns of them."""


@pytest.fixture(autouse=True)
def collected():
    yield
    gc.collect()


@pytest.fixture
def scenes(urls):
    """Every scene as webdataset reads it: a dict of bytes."""
    return list(webdataset.WebDataset(urls, shardshuffle=False))


@pytest.mark.parametrize(
    ("shards", "parsed", "options"),
    [
        ("small_shards", False, {"pairs": "adjacent", "frames": [0, 6]}),
        ("small_shards", True, {}),
        ("derived_shards", False, {"pairs": [(0, 3)], "frames": [6]}),
    ],
    ids=["released", "with parsed JSON", "derived for training"],
)
def test_the_stage_gives_the_samples_of_the_map_style_dataset(request, shards, parsed, options):
    folder = request.getfixturevalue(shards)
    expected = StereoPairs(folder, fields=FIELDS, **options)
    scenes = webdataset.WebDataset(sorted(map(str, folder.glob("*.tar"))), shardshuffle=False)
    if parsed:
        scenes = scenes.decode(webdataset.handle_extension("json", json.loads))

    found = {sample["__key__"]: sample for sample in scenes.compose(decode(FIELDS, **options))}

    assert len(found) == len(expected) > 0
    for sample in expected:
        require_equal(found[sample["__key__"]], sample)


def test_the_url_is_that_of_the_shard(scenes, urls):
    sample = next(decode(("left", "__url__"))(scenes))

    assert sample["__url__"] in urls


def test_a_baseline_leaves_out_scenes_without_such_a_pair(scenes):
    narrow = list(decode(("baseline_m",), pairs="all", baseline_cm=(0, 8))(scenes))

    assert 0 < len(narrow) < 60
    assert all(sample["baseline_m"] <= 0.08 for sample in narrow)


def test_random_frames_differ_among_scenes_and_epochs_and_repeat_by_seed(scenes):
    def frames(seed, epoch):
        stage = decode(("frame_index",), frames=("random", 2), seed=seed)
        stage.set_epoch(epoch)
        return [int(sample["frame_index"]) for sample in stage(scenes)]

    assert frames(0, 0) == frames(0, 0)
    assert frames(0, 0) != frames(0, 1)
    assert frames(0, 0) != frames(1, 0)


def test_running_workers_draw_for_the_epoch_that_was_set(urls):
    stage = decode(("frame_index",), frames=("random", 2))
    scenes = webdataset.WebDataset(urls, shardshuffle=False).compose(stage)
    loader = DataLoader(scenes, batch_size=None, num_workers=1, persistent_workers=True)

    require_frames_of_epochs(loader, stage)


def test_nothing_is_left_in_the_temporary_folder(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    next(decode(("left",))(scenes))
    list(decode(("left",))(scenes))
    gc.collect()

    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("damaged", "named"),
    [
        (lambda video: None, "is missing, and the scene"),
        (lambda video: video[: len(video) // 2], r"has 3\. Fetch those again"),
        (lambda video: np.zeros((7, 64, 64), dtype=np.uint8), "must be bytes, found ndarray"),
    ],
    ids=["missing", "cut", "decoded"],
)
def test_a_video_that_cannot_be_used_is_named(scenes, damaged, named):
    scenes[0]["cam_02_depth.mkv"] = damaged(scenes[0]["cam_02_depth.mkv"])

    with pytest.raises(StorageError, match=rf"cam_02_depth\.mkv:? {named}"):
        list(decode(("disparity",), pairs=[(2, 3)], frames="all")(scenes[:1]))


@pytest.mark.parametrize("key", ["../../etc/scene", "/train/A/B/c", "train/a.b/c/d", "scene"])
def test_a_key_that_is_not_a_scene_path_is_refused(scenes, key):
    scenes[0]["__key__"] = key

    with pytest.raises(SchemaError, match="scene"):
        list(decode(("left",))(scenes[:1]))


def test_an_unknown_option_is_named():
    match = r"decode has no option 'split'; it is an option of an earlier stage"
    with pytest.raises(SelectionError, match=match):
        decode(("left",), split="train")
