"""The check of a descriptor names what mlcroissant's own validation accepts."""

import json
import re
import sys

import pytest

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.croissant.check import check_descriptor
from stereogenbench_data.bridges.croissant.descriptor import SEEN_AFTER_ALL as SEEN
from stereogenbench_data.bridges.croissant.descriptor import write_descriptor
from stereogenbench_data.errors import DescriptorError, ExtraError
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


MUTATIONS = {
    "dangling reference": (
        lambda d: node(d, "pairs/scene_id").update(references={"field": {"@id": "scenes/key"}}),
        "scenes/key",
    ),
    "reference of the specification's form": (
        lambda d: node(d, "pairs/scene_id").update(references={"@id": "scenes/scene_id"}),
        "data.json: mlcroissant cannot read it",
    ),
    "misspelt responsible-AI name": (
        lambda d: d.update({"rai:dataBias": ["none"]}), "rai:dataBias: is not a property of RAI",
    ),
    "question without an answer": (
        lambda d: d["creator"][0].update(name="FILL IN: who made it"),
        "creator.name: must be filled in",
    ),
    "map that is seen and unseen": (
        lambda d: d["recordSet"].append({"data": [{"maps/name": "Town", "maps/meaning": SEEN}]}),
        "maps: 'Town' is in train, though scenes of unseen_map have it",
    ),
    "no record sets": (
        lambda d: d.update(recordSet=[]),
        "recordSet: is missing",
    ),
    "empty responsible-AI value": (
        lambda d: d.update({"rai:dataBiases": []}),
        "rai:dataBiases: is missing",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_is_reported_by_name(written, name):
    change, message = MUTATIONS[name]
    document = json.loads(written.read_text())
    change(document)
    written.write_text(json.dumps(document))

    problems = check_descriptor(written)

    assert any(re.search(message, problem) for problem in problems), problems


def test_without_mlcroissant_its_extra_is_named(written, monkeypatch):
    monkeypatch.setitem(sys.modules, "mlcroissant", None)

    with pytest.raises(ExtraError, match=r"stereogenbench-data\[croissant\]"):
        check_descriptor(written)


def test_a_file_that_is_not_json_is_refused(tmp_path):
    path = tmp_path / "data.json"
    path.write_text("{")

    with pytest.raises(DescriptorError, match=r"data\.json: cannot be read as JSON"):
        check_descriptor(path)


def test_the_command_writes_and_checks(small_shards, tmp_path):
    path = tmp_path / "out" / "data.json"

    written = invoke("publish", "croissant", small_shards, "-o", path)
    checked = invoke("publish", "croissant", "--check", path)
    document = json.loads(path.read_text())
    del document["rai:dataBiases"]
    path.write_text(json.dumps(document))
    found = invoke("publish", "croissant", "--check", path)

    assert written.exit_code == 0, written.output
    assert (checked.exit_code, checked.output) == (0, f"{path}: 0 problems\n")
    assert found.exit_code == 1
    assert "rai:dataBiases: is missing" in found.output


@pytest.mark.parametrize(
    "change",
    [
        lambda d, url: d.update({"@context": url}),
        lambda d, url: d["distribution"][0].update({"@context": url}),
        lambda d, url: d["@context"].update({"@import": url}),
        lambda d, url: d["@context"].update(key={"@id": "cr:key", "@context": url}),
        lambda d, url: d["@context"].update(more="@context"),
    ],
    ids=["of all", "in a file", "imported", "of a term", "by another name"],
)
def test_a_context_elsewhere_is_not_fetched(written, web, change):
    document = json.loads(written.read_text())
    change(document, f"{web.url}/context.json")
    written.write_text(json.dumps(document))

    (problem,) = check_descriptor(written)

    assert problem.startswith("@context: ")
    assert web.asked == []
