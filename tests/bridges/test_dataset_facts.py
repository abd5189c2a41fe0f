"""What is said of a dataset as a whole is what is known of it."""

import json
import re
import shutil

import pytest

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.card import card
from stereogenbench_data.bridges.croissant.descriptor import write_descriptor
from stereogenbench_data.bridges.dataset_facts import DRAWN, RELEASE, facts_of, template
from stereogenbench_data.errors import DescriptorError
from stereogenbench_data.schema.release import COMPLETE_JSON
from stereogenbench_data.shards.pack import pack
from tests.audit.release_counts import paper_scenes
from tests.bridges.validation import problems_of
from tests.cli.command import invoke, one_line, succeed


@pytest.fixture(scope="module", params=["no program", "assets of the user"])
def elsewhere(request, small_release, tmp_path_factory):
    """Shards of scenes whose marks of completion name no program, or a renderer of assets."""
    root = tmp_path_factory.mktemp("elsewhere")
    tree = shutil.copytree(small_release, root / "tree")
    for mark in tree.rglob(COMPLETE_JSON):
        facts = json.loads(mark.read_text())
        facts["synthesis"]["renderer"] = "blender 4.5 0123abcd"
        if request.param == "no program":
            del facts["synthesis"]
        mark.write_text(json.dumps(facts))
    pack(tree, root / "shards", workers=1)
    return SceneIndex.open(root / "shards")


@pytest.fixture
def about(tmp_path):
    """The template with every blank filled in."""
    path = tmp_path / "about.json"
    path.write_text(json.dumps(template()).replace("FILL IN: ", "Known: "))
    return path


def test_scenes_that_synth_drew_are_drawn(small_shards):
    assert facts_of(SceneIndex.open(small_shards)) == DRAWN


def test_scenes_on_the_papers_maps_are_the_papers_only_if_the_user_says_so(
    indexed_release, tmp_path
):
    """Others may render on maps of these names, at this size and length."""
    scenes = paper_scenes(SceneIndex.open(indexed_release).scene(0))
    index = SceneIndex.from_scenes(scenes[::100], tmp_path)

    with pytest.raises(DescriptorError, match=r"is not known.*creator.*--about release"):
        facts_of(index)
    assert facts_of(index, about="release") == RELEASE


def test_drawn_scenes_cannot_be_said_to_be_the_papers(small_shards):
    with pytest.raises(DescriptorError, match=r"scene_\d+ was drawn by .*--about release"):
        facts_of(SceneIndex.open(small_shards), about="release")


def test_the_command_takes_the_users_word_for_the_release(elsewhere, tmp_path):
    path = tmp_path / "data.json"

    succeed("publish", "croissant", elsewhere.root, "-o", path, "--about", "release")
    shown = succeed("publish", "card", elsewhere.root, "a/b", "--about", "release")

    assert "Yangzhi Cui" in path.read_text()
    assert "cc-by-4.0" in shown.stdout


@pytest.mark.parametrize("write", ["descriptor", "card"])
def test_scenes_of_an_unknown_maker_are_described_as_the_maker_states(
    elsewhere, about, tmp_path, write
):
    path = tmp_path / "data.json"

    def written(stated):
        if write == "card":
            return card(elsewhere, repository="a/b", about=stated)
        return json.dumps(write_descriptor(elsewhere, path, about=stated))

    with pytest.raises(DescriptorError, match=r"is not known.*Not stated: name, .*--template"):
        written(None)
    text = written(about)

    assert not re.search(r"Unreal|Qwen2|Yangzhi|Drawing", text)
    assert "Known: how to cite it" in text
    if write == "descriptor":
        assert "Known: who made it" in text
        assert "Known: where results on it do not hold" in text
        assert problems_of(path) == []


def test_blanks_misspelt_names_and_what_is_not_json_are_named(small_shards, about, tmp_path):
    index, facts = SceneIndex.open(small_shards), json.loads(about.read_text())
    for change, named in (
        ({"creator": template()["creator"]}, r"creator\.name must be filled in"),
        ({"licence": "x"}, r"has 'licence', .* license"),
    ):
        about.write_text(json.dumps(facts | change))
        with pytest.raises(DescriptorError, match=rf"about\.json: {named}"):
            facts_of(index, about=about)
    with pytest.raises(DescriptorError, match=r"none\.json: cannot be read as JSON"):
        facts_of(index, about=tmp_path / "none.json")


def test_a_maker_may_state_only_what_differs(small_shards, tmp_path):
    stated = tmp_path / "about.json"
    stated.write_text(json.dumps({"name": "Mine", "license": "https://example.org/licence"}))

    facts = facts_of(SceneIndex.open(small_shards), about=stated)
    text = card(SceneIndex.open(small_shards), repository="a/b", about=stated)

    assert facts == DRAWN | {"name": "Mine", "license": "https://example.org/licence"}
    assert "license: other" in text
    assert "license_link: https://example.org/licence" in text


def test_a_maker_states_name_version_and_day_of_a_descriptor(small_shards, tmp_path):
    stated, path = tmp_path / "about.json", tmp_path / "data.json"
    facts = {"name": "Mine", "version": "2.1.0", "datePublished": "2026-11-21"}

    def written(change):
        stated.write_text(json.dumps(facts | change))
        return invoke("publish", "croissant", small_shards, "-o", path, "--about", stated)

    assert written({}).exit_code == 0
    assert facts.items() <= json.loads(path.read_text()).items()
    assert "'two' is not a version" in one_line(written({"version": "two"}).stderr)
    assert "datePublished is 'May', not a day" in one_line(written({"datePublished": "May"}).stderr)
