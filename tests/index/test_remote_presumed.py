"""Many scenes on the Hub without an index: presumed by the listing, described when needed."""

import json
import os
import shutil

import numpy as np
import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index import table as open_module
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from tests.servers.hub import REPOSITORY, hub_serving

HUB = f"hf://datasets/{REPOSITORY}@main"
KEYS = [f"train/Uniform/Map_{number % 2}/scene_{number:06d}" for number in range(10)]
KEYS += [f"eval/MapSeenInTrain/Uniform/Map_0/scene_{number:06d}" for number in range(40)]
ODD = "eval/MapSeenInTrain/Uniform/Map_0/scene_000007"
"""A scene that opening the tree does not look at."""
UNREAD = "eval/MapSeenInTrain/Uniform/Map_0/scene_000008"
"""A scene with which a file of all scenes is not compared."""


@pytest.fixture(scope="module")
def whole_release(small_release, tmp_path_factory):
    """Many scenes, each with the files of one drawn scene and baselines of its own."""
    (drawn,) = small_release.glob("eval/*/Uniform/*/*")
    root = tmp_path_factory.mktemp("many")
    for number, key in enumerate(KEYS):
        (root / key).mkdir(parents=True)
        for file in drawn.iterdir():
            if file.suffix != ".json" or "scene_description" in file.name:
                os.link(file, root / key / file.name)
        for name in ("baseline.json", "trajectory.json", "_scene_complete.json"):
            document = json.loads((drawn / name).read_text())
            document["scene_label"] = f"Scene {number}"
            (root / key / name).write_text(json.dumps(document))
    return root


@pytest.fixture
def release(whole_release, tmp_path):
    """A release of its own, of which files may be replaced."""
    return shutil.copytree(whole_release, tmp_path / "release", copy_function=os.link)


@pytest.fixture(scope="module")
def local(whole_release):
    """The index of the release as it is on the disk, each scene read."""
    return SceneIndex.open(whole_release, rows="read")


@pytest.fixture
def hub(release, tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    with hub_serving(release, monkeypatch) as server:
        server.facts["page"] = 100
        yield server


def requests(server):
    """Return how many requests a server has answered."""
    facts = server.facts
    return sum(len(each) for each in (facts.get("resolved", []), facts["listed"], server.asked))


def read_names(server, key):
    return {name.rpartition("/")[2] for _, name, _ in server.facts["resolved"] if key in name}


def test_rows_come_from_the_listing_and_a_few_scenes(hub, local):
    index = SceneIndex.open(HUB)

    assert index.presumption is not None
    assert not read_names(hub, ODD)
    for name in ("key", "subset", "frames", "primary_left", "depth_unit_m", "depth_codec"):
        np.testing.assert_array_equal(index.column(name), local.column(name), err_msg=name)
    assert requests(hub) < 300


def test_baselines_are_read_where_a_selection_needs_them_and_the_digest_stays(hub, local):
    index = SceneIndex.open(HUB)
    digest = index.digest

    np.testing.assert_array_equal(index.column("scene_label"), local.column("scene_label"))
    np.testing.assert_array_equal(index.column("baselines_cm"), local.column("baselines_cm"))
    assert read_names(hub, ODD) == {"baseline.json"}
    assert index.digest == digest


def test_samples_are_those_of_the_folder_and_only_their_videos_are_opened(hub, release):
    options = {"split": "eval", "fields": ["left", "disparity", "baseline_m"], "frames": [0, 3]}
    remote, local = StereoPairs(HUB, **options), StereoPairs(release, **options)

    number = local.index.column("key").tolist().index(ODD)
    for each in (2 * number, 2 * number + 1):
        a, b = local[each], remote[each]
        assert a.keys() == b.keys()
        for name in ("left", "disparity", "baseline_m"):
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    videos = {name for name in read_names(hub, ODD) if name.startswith("cam_")}
    assert len(videos) == 2
    assert all(key.startswith("eval") for key in remote.index.column("key"))


def test_an_epoch_with_workers_is_that_of_the_folder(hub, release):
    options = {"split": "eval", "fields": ["left", "scene"], "frames": [0], "size": (16, 16)}

    def epoch(data):
        loader = StereoPairs(data, **options).loader(8, num_workers=2, seed=3)
        return [(batch["scene"], batch["left"].numpy()) for batch in loader]

    for (keys, left), (other_keys, other_left) in zip(epoch(HUB), epoch(release), strict=True):
        assert keys == other_keys
        np.testing.assert_array_equal(left, other_left)


def test_a_second_opening_asks_for_the_commit_alone(hub):
    first = SceneIndex.open(HUB)
    first.scene(0)
    hub.facts["resolved"].clear()
    hub.facts["listed"].clear()

    second = SceneIndex.open(HUB)

    assert second.scene(0) == first.scene(0)
    assert not hub.facts["listed"]
    assert {name.rpartition("/")[2] for _, name, _ in hub.facts["resolved"]} <= {"index.parquet"}


@pytest.mark.parametrize("how", ["another pair", "no video"])
def test_a_scene_that_contradicts_what_was_presumed_is_named(hub, release, how):
    place = release / ODD / ("baseline.json" if how == "another pair" else "cam_00_rgb.mp4")
    text = "no video"
    if how == "another pair":
        document = json.loads(place.read_bytes())
        pair = document["primary_stereo_pair"]
        pair["left_camera"], pair["right_camera"] = pair["right_camera"], pair["left_camera"]
        text = json.dumps(document)
    place.unlink()
    place.write_text(text)
    pairs = StereoPairs(HUB, split="eval", fields=["left"], frames=[0])
    number = pairs.index.column("key").tolist().index(ODD)

    with pytest.raises(StorageError, match=rf"{ODD} is not as was presumed.*stereogenbench index"):
        pairs[number]


@pytest.mark.usefixtures("hub")
def test_too_many_scenes_are_not_all_described_each_time(monkeypatch):
    monkeypatch.setattr(open_module, "MOST_REMOTE_SCENES", 49)

    with pytest.raises(StorageError, match=r" 50 are too many .*`stereogenbench index hf://"):
        SceneIndex.open(HUB, rows="read")


def as_path(key, record):
    return record | {"scene_path": f"/data/out/{key}"}


def as_parts(key, record):
    split, subset, *_ = key.split("/")
    names = dict(zip(("family", "map", "scene"), key.split("/")[-3:], strict=True))
    return record | names | {"split": split, "eval_subset": subset}


def write_records(release, name, record_of):
    """Write a file of all scenes, as records of their own ``baseline.json``."""
    records = {key: record_of(key, json.loads((release / key / "baseline.json").read_text()))
               for key in KEYS}  # fmt: skip
    (release / "metadata").mkdir(exist_ok=True)
    if name.endswith(".jsonl"):
        text = "\n".join(json.dumps(record) for record in records.values())
    else:
        text = json.dumps({"version": 1, "scenes": records})
    (release / "metadata" / name).write_text(text)


@pytest.mark.parametrize(
    ("name", "record_of"),
    [("all.jsonl", as_parts), ("scenes.json", lambda key, record: record)],
)
def test_one_file_of_all_scenes_stands_for_each_baseline_json(hub, release, local, name, record_of):
    write_records(release, name, record_of)
    index = SceneIndex.open(HUB)

    np.testing.assert_array_equal(index.column("scene_label"), local.column("scene_label"))
    np.testing.assert_array_equal(index.column("baselines_cm"), local.column("baselines_cm"))
    assert not read_names(hub, UNREAD)


def scaled(key, record):
    for pair in record["pairwise_pairs"]:
        pair["baseline_cm"] *= 1.001
    return as_path(key, record)


@pytest.mark.parametrize("record_of", [scaled, lambda key, record: {"a": key}])
def test_a_file_that_other_files_contradict_is_not_used(hub, release, local, record_of):
    write_records(release, "scenes.jsonl", record_of)
    (release / "metadata" / "notes.json").write_text("{")
    index = SceneIndex.open(HUB)

    np.testing.assert_array_equal(index.column("baselines_cm"), local.column("baselines_cm"))
    assert read_names(hub, UNREAD) == {"baseline.json"}


def test_captions_come_from_one_file_of_all_scenes(hub, release, local):
    (drawn,) = {(release / key / "scene_description_qwen_dataset_level.json").read_bytes()
                for key in KEYS}  # fmt: skip
    write_records(release, "captions.jsonl", lambda key, _: as_path(key, json.loads(drawn)))
    captions = SceneIndex.open(HUB).column("caption")

    assert captions.tolist() == local.column("caption").tolist()
    assert not read_names(hub, UNREAD)
