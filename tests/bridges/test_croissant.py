"""Descriptors, as mlcroissant validates and loads them."""

import json
import re
import shlex
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.croissant.descriptor import write_descriptor
from stereogenbench_data.errors import DescriptorError
from stereogenbench_data.shards.download import download, wanted_files
from stereogenbench_data.shards.pack import pack
from tests.bridges.validation import problems_of
from tests.cli.command import succeed
from tests.servers.tools import planned_by_make, run_python
from tests.shards.shard_files import scenes_of

HOME = Path(__file__).resolve().parents[2]
SHIPPED = HOME / "croissant"
LOADER = Path(__file__).with_name("load_records.py")


def loaded(cache, *paths):
    """Return the records of descriptors, which a process of its own loads."""
    return json.loads(run_python(LOADER, *paths, CROISSANT_CACHE=str(cache)))


def stored(index, form, *, cameras=range(6)):
    """Return [scene, camera or None, crc32] of members, as the index has them."""
    return sorted(
        [key, camera, scene.members[form.format(camera)].crc32]
        for key, scene in scenes_of(index.root).items()
        for camera in cameras
    )


@pytest.fixture(scope="module")
def index(small_shards):
    return SceneIndex.open(small_shards)


def test_the_shipped_descriptors_are_valid_without_a_warning():
    paths = [SHIPPED / "release.json", SHIPPED / "sample.json"]

    assert sorted(SHIPPED.glob("*.json")) == [*paths, SHIPPED / "template.json"]
    assert [problems_of(path) for path in paths] == [[], []]


def test_the_shipped_descriptors_name_where_their_own_data_come_from_and_their_splits():
    """Neither claims the other's renderer, authors, licence or page."""
    sample = (SHIPPED / "sample.json").read_text()
    release = (SHIPPED / "release.json").read_text()

    assert not re.search(r"Unreal|Qwen|Yangzhi|creativecommons|huggingface", sample)
    assert "stereogenbench synth" in sample
    assert "stereogenbench synth" not in release
    assert json.loads(sample)["url"] == "../shards/README.md"
    assert (SHIPPED / json.loads(sample)["url"]).is_file()
    assert json.loads(release)["datePublished"] == "2026-05"
    for text in (sample, release):
        splits = next(each for each in json.loads(text)["recordSet"] if each["@id"] == "splits")
        assert splits["dataType"] == "cr:Split"
        assert {row["splits/name"]: row["splits/url"] for row in splits["data"]} == {
            "train": "cr:TrainingSplit",
            "eval": "cr:TestSplit",
        }


@pytest.fixture(scope="module")
def of_many(index, tmp_path_factory):
    """A descriptor of shards that are too many for all of their files."""
    path = tmp_path_factory.mktemp("many") / "many.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stereogenbench_data.bridges.croissant.descriptor.MOST_MEDIA_BYTES", 1)
        write_descriptor(index, path)
    return path


@pytest.fixture(scope="module")
def found(packed_depth, of_many, tmp_path_factory):
    """The records of four descriptors by their names, which one process loads."""
    root = tmp_path_factory.mktemp("c")
    write_descriptor(SceneIndex.open(packed_depth), root / "packed.json")
    paths = [SHIPPED / "release.json", SHIPPED / "sample.json", root / "packed.json", of_many]
    assert problems_of(root / "packed.json") == []
    return {path.stem: each for path, each in zip(paths, loaded(root, *paths), strict=True)}


def test_the_descriptor_of_the_release_needs_no_file_of_it(found):
    """Reading one through its repository would clone hundreds of gigabytes."""
    records = found["release"]

    assert records["counts"] == {
        "splits": 2, "eval_subsets": 2, "families": 3, "maps": 25, "parts": 7,
    }  # fmt: skip
    assert records["first_of_each"] == [True] * 5
    document = json.loads((SHIPPED / "release.json").read_text())
    (parts,) = (each for each in document["recordSet"] if each["@id"] == "parts")
    assert sum(row["parts/scenes"] for row in parts["data"]) == 8493
    assert (
        "cloning the whole repository, with GitPython" in document["distribution"][0]["description"]
    )


def test_the_shipped_descriptor_of_the_sample_loads_every_record_in_both_orders(found):
    sample, records = SceneIndex.open(HOME / "shards"), found["sample"]

    assert records["counts"] == {
        "splits": 2, "eval_subsets": 2, "families": 3, "maps": 2, "scenes": 8,
        "scene_categories": 8, "pairs": 120, "shards": 7, "descriptions": 8, "media_files": 96,
        "rgb_videos": 48, "depth_videos": 48, "baseline_json": 8, "trajectory_json": 8,
        "scene_complete_json": 8,
    }  # fmt: skip
    assert records["backwards"] == records["counts"]
    contents = records["contents"]
    assert contents["rgb_videos"] == stored(sample, "cam_{:02d}_rgb.mp4")
    assert contents["depth_videos"] == stored(sample, "cam_{:02d}_depth.mkv")
    assert contents["baseline_json"] == stored(sample, "baseline.json", cameras=[None])
    assert records["baselines"] == sample.column("baselines_cm").reshape(-1).tolist()


def test_the_shipped_descriptors_are_those_of_make_descriptors(here):
    copied = here / "croissant"
    shutil.copytree(HOME / "shards", here / "shards")
    planned = planned_by_make("descriptors").replace("\\\n", " ")
    commands = re.findall(r"^\S*stereogenbench (publish croissant .*)", planned, re.MULTILINE)

    for command in commands:
        succeed(*shlex.split(command))

    assert len(commands) == 3
    written = {path.relative_to(copied) for path in copied.rglob("*") if path.is_file()}
    assert written == {path.relative_to(SHIPPED) for path in SHIPPED.rglob("*") if path.is_file()}
    for path in written:
        assert contents(copied / path) == contents(SHIPPED / path), path


def contents(path):
    """The rows of a table, whose bytes depend on Arrow's version; a descriptor without those."""
    if path.suffix == ".parquet":
        return pq.read_table(path).to_pylist()
    document = json.loads(path.read_text())
    for file in document.get("distribution", []):  # the template is no descriptor yet
        if str(file.get("contentUrl")).endswith(".parquet"):
            del file["sha256"], file["contentSize"]
    return document


def test_absolute_addresses_pass_the_steps_of_the_conference_checker(web, index, tmp_path):
    """It takes a dict, so paths must be URLs, and reads the first record of every set."""
    shutil.copytree(index.root, web.folder / "rev1" / "shards")
    place = web.folder / "rev1" / "shards" / "metadata.json"
    write_descriptor(index, place, data_url=f"{web.url}/rev1/shards")

    (records,) = loaded(tmp_path / "cache", place)

    assert records["counts"]["scenes"] == len(index)
    assert records["counts"]["pairs"] == 15 * len(index)
    expected = dict(zip(index.column("key"), index.column("baselines_cm").tolist(), strict=True))
    assert {
        row["scenes/scene_id"]: row["scenes/pairwise_baselines_cm"] for row in records["scenes"]
    } == expected
    assert records["backwards"] == records["counts"]
    assert records["first_of_each"] == [True] * len(records["counts"])


def test_shards_of_packed_depth_are_described_by_its_suffix(packed_depth, found):
    packed = SceneIndex.open(packed_depth)
    depth = stored(packed, "cam_{:02d}_depth.b2frame")
    assert found["packed"]["contents"]["depth_videos"] == depth
    assert found["packed"]["counts"]["media_files"] == 12 * len(packed)


def test_a_partial_download_is_described_by_its_videos(small_shards, tmp_path):
    whole = SceneIndex.open(small_shards)
    scenes = map(whole.scene, [0, 1])
    part = [wanted_files(scene, cameras=(2, 3), streams=("depth",)) for scene in scenes]
    download(whole, part, tmp_path / "tree")
    pack(tmp_path / "tree", tmp_path / "shards", workers=1)
    path = tmp_path / "data.json"
    written = write_descriptor(SceneIndex.open(tmp_path / "shards"), path)

    kinds = [each["@id"] for each in written["recordSet"] if each["@id"].endswith("_videos")]
    assert kinds == ["depth_videos"]
    assert problems_of(path) == []


def test_records_of_many_shards_are_those_of_the_smallest_of_each_family(index, of_many, found):
    named = {each["@id"] for each in json.loads(of_many.read_text())["distribution"]}
    counts = found["many"]["counts"]

    assert problems_of(of_many) == []
    assert set(index.shards) <= named
    assert counts["shards"] == len(index.shards)
    assert 0 < counts["media_files"] <= 12 * len(index)


def test_shards_behind_a_url_need_an_address_to_name(small_release, web, tmp_path):
    pack(small_release, web.folder / "shards", workers=1)
    remote = SceneIndex.open(f"{web.url}/shards")

    with pytest.raises(DescriptorError, match=r"are behind a URL.*--base-url"):
        write_descriptor(remote, tmp_path / "data.json")


def test_a_descriptor_that_cannot_be_written_names_the_place(index, tmp_path):
    (tmp_path / "file").write_text("")

    with pytest.raises(DescriptorError, match=r"file/data: tables cannot be written"):
        write_descriptor(index, tmp_path / "file" / "data.json")


def test_a_tree_is_to_be_packed_first(small_release, tmp_path):
    with pytest.raises(DescriptorError, match="Pack them first"):
        write_descriptor(SceneIndex.open(small_release), tmp_path / "data.json")


@pytest.mark.parametrize(
    ("data_url", "message"),
    [
        ("packed", "'packed' is not a URL"),
        (
            "https://me:word@host/data?key=word",
            r"^'https://host/data ?' is not .*without a login or a query",
        ),
    ],
)
def test_what_the_check_would_refuse_is_not_written(small_shards, tmp_path, data_url, message):
    with pytest.raises(DescriptorError, match=message):
        write_descriptor(SceneIndex.open(small_shards), tmp_path / "a.json", data_url=data_url)
    assert list(tmp_path.iterdir()) == []
