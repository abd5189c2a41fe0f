"""The check of a descriptor names what mlcroissant's own validation accepts."""

import json
import re

import pytest

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.croissant.check import check_descriptor
from stereogenbench_data.bridges.croissant.descriptor import write_descriptor
from stereogenbench_data.errors import DescriptorError
from tests.cli.command import invoke


@pytest.fixture
def written(small_shards, tmp_path):
    path = tmp_path / "data.json"
    write_descriptor(SceneIndex.open(small_shards), path)
    return path


def node(document, name):
    """A file, set, record set or field, by its id."""
    nodes = [*document["distribution"], *document["recordSet"]]
    nodes += [field for records in document["recordSet"] for field in records["field"]]
    return next(each for each in nodes if each["@id"] == name)


def first_tar(document):
    return next(
        each for each in document["distribution"] if each["encodingFormat"] == "application/x-tar"
    )


def test_a_written_descriptor_has_no_problem(written):
    assert check_descriptor(written) == []


MUTATIONS = {
    "missing file": (
        lambda d: first_tar(d).update(contentUrl="nowhere.tar"), r"nowhere\.tar does not exist",
    ),
    "wrong sha256": (lambda d: first_tar(d).update(sha256="0" * 64), "was replaced or damaged"),
    "short sha256": (lambda d: first_tar(d).update(sha256="abc"), "must have 64 hex digits"),
    "wrong size": (lambda d: first_tar(d).update(contentSize="1 B"), "the descriptor says 1 B"),
    "unknown column": (
        lambda d: node(d, "scenes/map")["source"]["extract"].update(column="maps"),
        r"scenes/map: reads the column 'maps' of scenes\.parquet; its columns are",
    ),
    "dangling key": (
        lambda d: node(d, "scenes").update(key={"@id": "scenes/number"}),
        "scenes: has the key scenes/number, which is not one of its fields",
    ),
    "dangling reference": (
        lambda d: node(d, "pairs/scene_id").update(references={"field": {"@id": "scenes/key"}}),
        "pairs/scene_id: refers to 'scenes/key', which is not in the descriptor",
    ),
    "reference of the specification's form": (
        lambda d: node(d, "pairs/scene_id").update(references={"@id": "scenes/scene_id"}),
        "pairs/scene_id: has a reference without a field",
    ),
    "chained reference": (
        lambda d: node(d, "scenes/scene_id").update(references={"field": {"@id": "maps/name"}}),
        "which is itself a reference: chains load wrong rows",
    ),
    "misspelt responsible-AI name": (
        lambda d: d.update({"rai:dataBias": ["none"]}), "rai:dataBias: is not a property of RAI",
    ),
    "missing responsible-AI name": (
        lambda d: d.pop("rai:dataLimitations"), "rai:dataLimitations: is missing",
    ),
    "misspelt property": (
        lambda d: first_tar(d).update(contentURL="x"), "contentURL: is not a property of Croissant",
    ),
    "context of another version": (
        lambda d: d["@context"].pop("containedIn"), "@context: containedIn is None and must be",
    ),
    "context by address": (
        lambda d: d.update({"@context": "https://example.org/context"}), "must be an object",
    ),
    "another version": (
        lambda d: d.update(conformsTo="http://mlcommons.org/croissant/1.0"),
        "conformsTo: lacks http://mlcommons.org/croissant/1.1",
    ),
    "no licence": (lambda d: d.pop("license"), "license: is missing"),
    "no version": (lambda d: d.update(version="v1"), "must be MAJOR.MINOR.PATCH"),
    "pattern that finds nothing": (
        lambda d: node(d, "rgb-files").update(includes="**/*.cam_??_colour.mp4"),
        "rgb-files: includes .*matches no file",
    ),
    "set in no file": (
        lambda d: node(d, "rgb-files").update(containedIn={"@id": "other.tar"}),
        "is contained in 'other.tar', which is not in the descriptor",
    ),
    "regex without a group": (
        lambda d: node(d, "rgb_videos/camera")["source"].update(transform={"regex": ".*"}),
        "rgb_videos/camera: takes the first group of the regex",
    ),
    "two nodes of one name": (
        lambda d: node(d, "depth-files").update({"@id": "rgb-files"}),
        "rgb-files: is the @id of two nodes",
    ),
    "branch for a revision": (
        lambda d: first_tar(d).update(
            contentUrl="https://huggingface.co/datasets/a/b/resolve/main/x.tar"
        ),
        "is a branch, which changes: pin a revision",
    ),
    "inline data of no field": (
        lambda d: node(d, "splits")["data"][0].update({"splits/link": "x"}),
        "splits: has data for splits/link",
    ),
    "unknown data type": (
        lambda d: node(d, "scenes/map").update(dataType="sc:String"),
        "scenes/map: has the data type sc:String, and one must be of",
    ),
    "split as the only data type": (
        lambda d: node(d, "splits/url").update(dataType="cr:Split"),
        "splits/url: has the data type cr:Split",
    ),
    "no data type": (
        lambda d: node(d, "scenes/map").pop("dataType"), "scenes/map: has the data type none",
    ),
    "text as a number": (
        lambda d: node(d, "scenes/map").update(dataType="sc:Integer"),
        r"scenes/map: has the data type sc:Integer \(whole numbers\), but the column 'map' of "
        r"scenes\.parquet holds string",
    ),
    "number as text": (
        lambda d: node(d, "pairs/camera_left").update(dataType="sc:Text"),
        r"pairs/camera_left: .*holds int64",
    ),
    "number as a day": (
        lambda d: node(d, "scenes/frames").update(dataType="sc:Date"),
        r"scenes/frames: has the data type sc:Date \(days\), but .* holds int64",
    ),
    "name as a number": (
        lambda d: node(d, "baseline_json/scene_id").update(dataType="sc:Float"),
        "baseline_json/scene_id: is an sc:Float, but the regex .* of a name",
    ),
    "file as a number": (
        lambda d: node(d, "rgb_videos/content").update(dataType="sc:Integer"),
        "rgb_videos/content: has the data type sc:Integer, but the content of a file is none",
    ),
    "list as a value": (
        lambda d: node(d, "scenes/depth_unit_m").pop("isArray"),
        "scenes/depth_unit_m: has no isArray, but .* holds list",
    ),
    "value as a list": (
        lambda d: node(d, "scenes/map").update(isArray=True, arrayShape="3"),
        "scenes/map: has isArray, but .* holds string",
    ),
    "list of another length": (
        lambda d: node(d, "scenes/pairwise_baselines_cm").update(arrayShape="14"),
        "scenes/pairwise_baselines_cm: has the arrayShape 14, but .* has a list of 15",
    ),
    "shape that is none": (
        lambda d: node(d, "scenes/depth_unit_m").update(arrayShape="six"),
        "scenes/depth_unit_m: has the arrayShape 'six', and must have numbers",
    ),
    "inline value of another type": (
        lambda d: node(d, "splits")["data"][0].update({"splits/meaning": 3}),
        "splits/meaning: has the value 3, which is not sc:Text",
    ),
    "regex that takes no number": (
        lambda d: node(d, "rgb_videos/camera")["source"].update(
            transform={"regex": r"^.*?(cam_\d{2})_rgb\.\w+$"}
        ),
        "rgb_videos/camera: is an sc:Integer, but .* takes 'cam_00' of a name",
    ),
    "date that is none": (
        lambda d: d.update(datePublished="22.11.2026"), "datePublished: is '22.11.2026', and must",
    ),
    "no such day": (
        lambda d: d.update(datePublished="2026-02-30"), "datePublished: is '2026-02-30', and must",
    ),
    "day to come": (
        lambda d: d.update(datePublished="9999-01-01"), "datePublished: is 9999-01-01, which has",
    ),
    "question without an answer": (
        lambda d: d["creator"][0].update(name="FILL IN: who made it"),
        "creator.name: must be filled in",
    ),
    "no record sets": (lambda d: d.update(recordSet=[]), "recordSet: is empty"),
    "empty responsible-AI value": (
        lambda d: d.update({"rai:dataBiases": []}), "rai:dataBiases: is empty",
    ),
    "several values where one is kept": (
        lambda d: d.update({"rai:dataSocialImpact": ["a", "b"]}), "readers keep only the first",
    ),
    "misspelt provenance": (
        lambda d: d.update({"prov:wasDerivedfrom": "x"}), "prov:wasDerivedfrom: must be one of",
    ),
    "constant values in the context": (
        lambda d: d["@context"].update(value="cr:value"), "constant fields have no value",
    ),
    "tar of another kind": (
        lambda d: first_tar(d).update(encodingFormat="application/tar"),
        r"\.tar: has the encodingFormat 'application/tar', and must be application/x-tar",
    ),
    "property that files have not": (
        lambda d: node(d, "media_files/file")["source"]["extract"].update(fileProperty="name"),
        "media_files/file: reads 'name' of each file; must be one of fullpath, filename",
    ),
    "regex that matches nothing": (
        lambda d: node(d, "rgb_videos/camera")["source"].update(transform={"regex": r"^x(\d)"}),
        "rgb_videos/camera: has the regex .*, which does not match scene_",
    ),
    "join key that is not left as it is": (
        lambda d: node(d, "rgb_videos/scene_id")["source"].update(
            transform={"regex": r"^(.+?)\.cam_\d{2}_rgb\.mp4$"}
        ),
        "rgb_videos/scene_id: .*changes its own result",
    ),
    "join key that another field reads": (
        lambda d: node(d, "rgb_videos/camera")["source"]["extract"].update(fileProperty="fullpath"),
        "rgb_videos/camera: reads what rgb_videos/scene_id reads, fullpath of rgb-files",
    ),
    "value that no enumeration has": (
        lambda d: node(d, "families")["data"].pop(),
        "scene_categories/family: has the value '[A-Z].*', which families/name does not have",
    ),
    "record set without fields": (
        lambda d: node(d, "shards").pop("field"), "shards: has the key shards/shard, which is not",
    ),
    "not shaped as one": (lambda d: d.update(recordSet=[1]), "does not have the structure"),
}  # fmt: skip


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_is_reported_by_name(written, name):
    change, message = MUTATIONS[name]
    document = json.loads(written.read_text())
    change(document)
    written.write_text(json.dumps(document))

    problems = check_descriptor(written)

    assert any(re.search(message, problem) for problem in problems), problems


@pytest.mark.parametrize("published", ["2026", "2026-05", "2026-05-31"])
def test_a_year_a_month_and_a_day_are_dates(written, published):
    document = json.loads(written.read_text())
    document["datePublished"] = published
    written.write_text(json.dumps(document))

    assert check_descriptor(written) == []


def test_a_file_behind_a_url_is_checked_at_its_local_path(written, small_shards):
    document = json.loads(written.read_text())
    tar = first_tar(document)
    tar.update(contentUrl="https://example.org/data.tar", sha256="0" * 64)
    written.write_text(json.dumps(document))

    assert check_descriptor(written) == []
    problems = check_descriptor(written, mapping={tar["@id"]: small_shards / tar["@id"]})
    assert "was replaced or damaged" in " ".join(problems)


def test_a_mapping_for_an_unknown_file_is_named(written, tmp_path):
    (problem,) = check_descriptor(written, mapping={"scene.parquet": tmp_path})

    assert problem.startswith("scene.parquet: is mapped to a path")


def test_a_file_that_is_not_json_is_refused(tmp_path):
    path = tmp_path / "data.json"
    path.write_text("{")

    with pytest.raises(DescriptorError, match=r"data\.json: cannot be read as JSON"):
        check_descriptor(path)


def test_the_command_writes_and_checks(small_shards, tmp_path):
    path = tmp_path / "out" / "data.json"

    written = invoke("croissant", small_shards, "-o", path)
    checked = invoke("croissant", "--check", path, "--json")
    document = json.loads(path.read_text())
    del document["rai:dataBiases"]
    path.write_text(json.dumps(document))
    found = invoke("croissant", "--check", path)

    assert written.exit_code == 0, written.output
    assert json.loads(checked.output)["problems"] == []
    assert found.exit_code == 1
    assert "rai:dataBiases: is missing" in found.output


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000])
def test_deep_nesting_is_refused_by_name(tmp_path, text):
    (tmp_path / "data.json").write_text(text)

    with pytest.raises(DescriptorError, match=r"data\.json: .* nested hundreds of levels deep"):
        check_descriptor(tmp_path / "data.json")


@pytest.mark.parametrize(
    "place",
    [
        "/etc/passwd",
        "/x.tar",
        "~/x.tar",
        "../secret",
        "a\\b.tar",
        "c:x.tar",
        "\0.tar",
        "file:///etc/passwd",
        "FILE:///x.tar",
    ],
)
def test_a_path_outside_the_data_is_not_read(written, place):
    document = json.loads(written.read_text())
    first_tar(document)["contentUrl"] = place
    written.write_text(json.dumps(document))

    (problem,) = [each for each in check_descriptor(written) if "contentUrl" in each]

    assert f"has the contentUrl {place!r}, and a path must be relative" in problem
    assert "sha256" not in problem
