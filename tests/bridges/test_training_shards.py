"""Training shards in other formats: described as derived."""

import json
import re

from stereogenbench_data import SceneIndex
from stereogenbench_data.audit.statistics import statistics, statistics_markdown
from stereogenbench_data.bridges.card import card
from stereogenbench_data.bridges.croissant.descriptor import write_descriptor
from tests.bridges.validation import problems_of


def test_the_descriptor_says_from_what_how_and_with_what_error(
    derived_shards, small_release, small_shards, tmp_path
):
    path = tmp_path / "data.json"
    index = SceneIndex.open(derived_shards)
    written = write_descriptor(index, path)

    assert problems_of(path) == []
    assert "derived from other scenes for training" in written["description"]
    (source,) = [
        each
        for each in written["prov:wasDerivedFrom"]
        if SceneIndex.open(small_release).digest in each["description"]
    ]
    assert source["prov:label"] == "Drawn stereo scenes in the layout of StereoGenBench"
    how = written["prov:wasGeneratedBy"][-1]["description"]
    assert all(part in how for part in ("48x32", "h264", "small", "crf"))
    mean, worst = re.search(r"([\d.]+) dB on average and ([\d.]+) dB in the worst", how).groups()
    assert float(worst) < float(mean)
    released = write_descriptor(SceneIndex.open(small_shards), path)
    assert "Derivation for training" not in json.dumps(released)


def test_the_card_says_so_and_lists_the_file_that_says_it(derived_shards, small_shards):
    derived = card(SceneIndex.open(derived_shards), repository="a/b")
    released = card(SceneIndex.open(small_shards), repository="a/b")

    assert "## Derived for training" in derived
    assert "pictures are smaller and were encoded again" in derived
    assert "name: training.json" in derived
    assert "size=(480, 832)" not in derived
    assert "training.json" not in released
    assert "Derived for training" not in released


def test_statistics_say_so(derived_shards, small_shards):
    found = statistics(SceneIndex.open(derived_shards))

    assert "derived at 48x32" in statistics_markdown(found)
    assert "derived at 48x32" in found.derived
    assert "derived" not in statistics_markdown(statistics(SceneIndex.open(small_shards)))
