"""Training shards through other formats: read as any shards, and described as derived."""

import gc
import json
import re

import numpy as np
import pytest
import webdataset

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.audit.statistics import statistics, statistics_markdown
from stereogenbench_data.bridges.card import card
from stereogenbench_data.bridges.croissant.check import check_descriptor
from stereogenbench_data.bridges.croissant.descriptor import write_descriptor
from stereogenbench_data.bridges.webdataset import decode
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings
from tests.servers.tools import require_module

FIELDS = ("left", "right", "disparity", "valid", "intrinsics", "pair", "scene", "__key__")
OPTIONS = {"pairs": [(0, 3)], "frames": [6]}

pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)
"""Webdataset leaves its files to the garbage collector, which warns of them."""


@pytest.fixture(autouse=True)
def collected():
    yield
    gc.collect()


@pytest.fixture(scope="module")
def packed(small_release, tmp_path_factory):
    """Two cameras of all scenes; not to be changed."""
    require_module("blosc2")
    out = tmp_path_factory.mktemp("derived") / "shards"
    pack(small_release, out, training=TrainingSettings((32, 48), "small", (0, 3)), workers=1)
    return out


def test_webdataset_reads_them(packed):
    urls = sorted(map(str, packed.glob("*.tar")))
    pipeline = webdataset.WebDataset(urls, shardshuffle=False).compose(decode(FIELDS, **OPTIONS))
    found = {sample["__key__"]: sample for sample in pipeline}

    expected = StereoPairs(packed, fields=FIELDS, **OPTIONS)
    assert found.keys() == {sample["__key__"] for sample in expected}
    for truth in expected:
        sample = found[truth["__key__"]]
        for name in ("left", "right", "valid", "disparity", "intrinsics"):
            np.testing.assert_allclose(np.asarray(sample[name]), truth[name], rtol=1e-6)


def test_the_descriptor_says_from_what_how_and_with_what_error(
    packed, small_release, small_shards, tmp_path
):
    path = tmp_path / "data.json"
    index = SceneIndex.open(packed)
    written = write_descriptor(index, path)

    assert check_descriptor(path) == []
    assert "derived from other scenes for training" in written["description"]
    (source,) = [
        each
        for each in written["prov:wasDerivedFrom"]
        if SceneIndex.open(small_release).digest in each["description"]
    ]
    assert source["prov:label"] == "Drawn stereo scenes in the layout of StereoGenBench"
    how = written["prov:wasGeneratedBy"][-1]["description"]
    assert all(part in how for part in ("48x32", "h264", "small", "crf", "dB"))
    released = write_descriptor(SceneIndex.open(small_shards), path)
    assert "Derivation for training" not in json.dumps(released)


def test_the_card_says_so_and_lists_the_file_that_says_it(packed, small_release, small_shards):
    derived = card(SceneIndex.open(packed), repository="a/b")
    released = card(SceneIndex.open(small_shards), repository="a/b")

    assert "## Derived for training" in derived
    assert "size 48x32, quality small" in derived
    assert f"source: the release with index {SceneIndex.open(small_release).digest}" in derived
    mean, worst = re.search(r"([\d.]+) dB on average, ([\d.]+) in the worst", derived).groups()
    assert float(worst) < float(mean)
    assert "name: training.json" in derived
    assert "size=(480, 832)" not in derived
    assert "training.json" not in released
    assert "Derived for training" not in released


def test_statistics_say_so(packed, small_shards):
    found = statistics(SceneIndex.open(packed))

    assert "derived at 48x32" in statistics_markdown(found)
    assert "derived at 48x32" in found.to_json()["derived"]
    assert "derived" not in statistics_markdown(statistics(SceneIndex.open(small_shards)))
