"""Many scenes on the Hub without an index: known by the listing, opened when needed."""

import json
import os
import shutil

import numpy as np
import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.errors import SchemaError, StorageError
from stereogenbench_data.index import table as open_module
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from tests.servers.hub import REPOSITORY, hub_serving

pytestmark = pytest.mark.filterwarnings("ignore:.*not opened yet:UserWarning")

HUB = f"hf://datasets/{REPOSITORY}@main"
KEYS = [f"train/Uniform/Map_{number % 2}/scene_{number:06d}" for number in range(10)]
KEYS += [f"eval/MapSeenInTrain/Uniform/Map_0/scene_{number:06d}" for number in range(40)]
ODD = "eval/MapSeenInTrain/Uniform/Map_0/scene_000014"
"""A scene that opening the tree does not look at."""


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

    assert index.unopened is not None
    assert not read_names(hub, ODD)
    for name in ("key", "subset", "frames", "primary_left", "depth_unit_m", "depth_codec"):
        np.testing.assert_array_equal(index.column(name), local.column(name), err_msg=name)
    assert requests(hub) < 300


@pytest.mark.parametrize(
    ("options", "needs"),
    [
        ({"baseline_cm": (1, 300)}, "baselines_cm stands in the baseline.json"),
        (
            {"balance": "baseline", "limit": 4, "pairs": "all"},
            "baselines_cm stands in the baseline.json",
        ),
        ({"focal_mm": (1, 300)}, "focal_mm stands in the baseline.json"),
        ({"caption": "room"}, "caption stands in the description"),
    ],
)
def test_what_each_baseline_json_tells_is_an_error_with_the_cost_and_two_cures(hub, options, needs):
    index = SceneIndex.open(HUB)
    asked = requests(hub)

    told = rf"{needs} of each of 50 scenes.* 50 requests.* 1 minute\. Run `stereogenbench index hf:"
    with pytest.raises(StorageError, match=rf"{told}.*; or read them now: .*\.with_[a-z]+\(\)"):
        StereoPairs(index, split="eval", fields=["left"], **options)

    assert requests(hub) == asked
    assert "not opened yet" in repr(index)


def test_baselines_are_read_when_that_is_asked_for_and_the_digest_stays(hub, local):
    index = SceneIndex.open(HUB)

    read = index.with_baselines()

    np.testing.assert_array_equal(read.column("scene_label"), local.column("scene_label"))
    np.testing.assert_array_equal(read.column("baselines_cm"), local.column("baselines_cm"))
    assert read_names(hub, ODD) == {"baseline.json"}
    assert read.digest == index.digest
    assert read.with_baselines() is read


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
def test_a_scene_unlike_those_that_were_opened_is_named(hub, release, how):
    place = release / ODD / ("baseline.json" if how == "another pair" else "cam_00_rgb.mp4")
    text = "no video" * 200
    if how == "another pair":
        document = json.loads(place.read_bytes())
        pair = document["primary_stereo_pair"]
        pair["left_camera"], pair["right_camera"] = pair["right_camera"], pair["left_camera"]
        text = json.dumps(document)
    place.unlink()
    place.write_text(text)
    pairs = StereoPairs(HUB, split="eval", fields=["left"], frames=[0])
    number = pairs.index.column("key").tolist().index(ODD)

    with pytest.raises(
        StorageError, match=rf"{ODD} is not as the scenes that were opened.*stereogenbench index"
    ):
        pairs[number]


@pytest.mark.usefixtures("hub")
def test_too_many_scenes_are_not_all_opened_each_time(monkeypatch):
    monkeypatch.setattr(open_module, "MOST_REMOTE_SCENES", 49)

    with pytest.raises(StorageError, match=r" 50 are too many .*`stereogenbench index hf://"):
        SceneIndex.open(HUB, rows="read")


def test_captions_come_from_each_description_or_from_one_file_of_all(hub, release, local):
    lines = [json.dumps({"path": f"/data/out/{key}", "text": {"long": f"About {key}."}})
             for key in KEYS]  # fmt: skip
    (release / "metadata").mkdir()
    (release / "metadata" / "all.jsonl").write_text("\n".join(lines))
    index = SceneIndex.open(HUB)

    of_file = index.with_captions("metadata/all.jsonl", scene="$.path", caption="$.text.long")

    assert of_file.column("caption").tolist() == [f"About {key}." for key in sorted(KEYS)]
    assert not read_names(hub, ODD)
    assert of_file.digest == index.digest
    assert index.with_captions().column("caption").tolist() == local.column("caption").tolist()


@pytest.mark.usefixtures("hub")
@pytest.mark.parametrize(
    ("lines", "error", "told"),
    [
        ('{"scene": "train/a/b/c", "caption": "A."}', StorageError, "no record of 50 scenes of 50"),
        ('{"scene": 7, "caption": "A."}', SchemaError, r"line 1: has no text at \$\.scene; it has"),
    ],
)
def test_a_file_of_captions_that_does_not_fit_is_refused(release, lines, error, told):
    (release / "all.jsonl").write_text(lines)

    with pytest.raises(error, match=told):
        SceneIndex.open(HUB).with_captions("all.jsonl")
