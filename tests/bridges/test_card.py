"""The dataset card: for people, and for `datasets`."""

import json
import re
import shutil
from pathlib import Path

import pytest
import yaml

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.card import MARK, card, write_card
from stereogenbench_data.errors import DescriptorError
from tests.servers.failing_server import serving
from tests.servers.hub import REPOSITORY, HubHandler
from tests.servers.tools import require_module, run_python
from tests.shards.shard_files import scenes_of

SAMPLE = Path(__file__).resolve().parents[2] / "shards"
LOAD = """
import json, sys
from datasets import load_dataset

found = {}
for name, split in json.loads(sys.argv[2]):
    rows = list(load_dataset(sys.argv[1], name, split=split, streaming=True))
    found[f"{name} {split}"] = [
        [row["__key__"], type(row["cam_00_depth.mkv"]).__name__, len(row["cam_00_depth.mkv"])]
        for row in rows
    ]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def sample_card():
    return card(SceneIndex.open(SAMPLE), repository="a/b")


@pytest.fixture(scope="module")
def head(sample_card):
    return yaml.safe_load(sample_card.split("---")[1])


def test_every_family_is_a_config_with_its_splits_and_all_has_every_shard_once(head):
    configs = {each["config_name"]: each["data_files"] for each in head["configs"]}

    assert list(configs) == ["all", "IPD_Gaussian", "Pairwise_Uniform", "Uniform"]
    assert [each["config_name"] for each in head["configs"] if each.get("default")] == ["all"]
    splits = [each["split"] for each in configs["Uniform"]]
    assert splits == ["train", "eval_seen_map", "eval_unseen_map"]
    assert configs["Pairwise_Uniform"] == [
        {"split": "train", "path": ["train-Pairwise_Uniform-*.tar"]}
    ]
    patterns = [pattern for each in configs["all"] for pattern in each["path"]]
    found = sorted(path.name for pattern in patterns for path in SAMPLE.glob(pattern))
    assert found == sorted(path.name for path in SAMPLE.glob("*.tar"))


def test_the_head_says_what_the_hub_lists_datasets_by(head):
    assert head["language"] == ["en"]
    assert "arxiv:2605.23237" in head["tags"]
    assert {"video", "webdataset", "mlcroissant"} <= set(head["tags"])
    assert "image-to-video" in head["task_categories"]
    assert head["license"] == "mit"


def test_a_card_counts_its_own_scenes_and_claims_nothing_of_the_release(sample_card):
    assert "stereogenbench synth" in sample_card
    assert not re.search(r"Unreal|Qwen2|Yangzhi|cc-by", sample_card, re.IGNORECASE)
    assert "| train |  | Uniform | 2 | 30 |" in sample_card
    assert "| eval | unseen_map | IPD_Gaussian | 1 | 15 |" in sample_card
    assert "- 8 scenes on 2 maps, in 7 shards" in sample_card
    assert "(0.01 m here)" in sample_card


def test_load_dataset_finds_configs_and_splits_and_leaves_videos_as_bytes(tmp_path):
    require_module("datasets")
    folder = shutil.copytree(SAMPLE, tmp_path / "hub")
    (folder / "README.md").unlink()
    write_card(SceneIndex.open(folder), folder, repository=REPOSITORY)
    wanted = [["Uniform", "train"], ["IPD_Gaussian", "eval_unseen_map"], [None, "train"]]

    with serving(folder, handler=HubHandler) as server:
        settings = {"HF_ENDPOINT": server.url, "HF_HOME": str(tmp_path / "home")}
        printed = run_python("-c", LOAD, REPOSITORY, json.dumps(wanted), **settings)

    found = json.loads(printed)
    assert len(found["None train"]) == 4, "without a config: all families"
    scenes = scenes_of(SAMPLE)
    assert [row[0] for row in found["Uniform train"]] == [
        f"train/Uniform/SynthStage/scene_{number:06d}" for number in range(2)
    ]
    for key, kind, size in (row for rows in found.values() for row in rows):
        assert kind == "bytes"
        assert size == scenes[key].members["cam_00_depth.mkv"].size


def test_a_card_is_replaced_but_another_readme_is_not(tmp_path):
    index = SceneIndex.open(SAMPLE)

    write_card(index, tmp_path, repository="a/b")
    write_card(index, tmp_path, repository="a/c")

    assert MARK in (tmp_path / "README.md").read_text()
    assert "a/c" in (tmp_path / "README.md").read_text()
    (tmp_path / "README.md").write_text("mine")
    match = r"README\.md: exists and was not written by this package"
    with pytest.raises(DescriptorError, match=match):
        write_card(index, tmp_path, repository="a/b")


def test_the_card_states_the_features_of_packed_depth(packed_depth):
    text = card(SceneIndex.open(packed_depth), repository="a/b")

    head = yaml.safe_load(text.split("---")[1])
    names = [each["name"] for each in head["dataset_info"][0]["features"]]
    assert "cam_05_depth.b2frame" in names
    assert "cam_05_depth.mkv" not in names
    assert "`stereogenbench unpack` turns them back into videos" in text


def test_a_tree_of_folders_has_no_card(small_release):
    with pytest.raises(DescriptorError, match="not a folder of shards"):
        card(SceneIndex.open(small_release), repository="a/b")
