"""The sample shards as other tools read them: one scene, one sample, bytes as released."""

import gc
import io
import json
import shutil
import warnings
from pathlib import Path

import av
import pytest
import webdataset

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.card import write_card
from stereogenbench_data.schema.release import VIDEO_FILES

SHARDS = Path(__file__).resolve().parents[1] / "shards"
TARS = sorted(str(path) for path in SHARDS.glob("*.tar"))


@pytest.fixture(scope="module")
def index():
    return SceneIndex.open(SHARDS)


def expected_keys(index):
    return sorted(str(key) for key in index.column("key"))


def frames_of(video):
    with av.open(io.BytesIO(video)) as container:
        return sum(1 for _ in container.decode(video=0))


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)
def test_webdataset_reads_one_scene_as_one_sample(index):
    """Webdataset leaves its files to the garbage collector, which warns of them."""
    samples = list(webdataset.WebDataset(TARS, shardshuffle=False))
    gc.collect()

    assert sorted(sample["__key__"] for sample in samples) == expected_keys(index)
    for sample in samples:
        assert set(VIDEO_FILES) <= sample.keys()
        assert len(json.loads(sample["baseline.json"])["pairwise_pairs"]) == 15
    assert frames_of(samples[0]["cam_03_rgb.mp4"]) == 81
    assert frames_of(samples[0]["cam_03_depth.mkv"]) == 81


def test_hugging_face_datasets_loads_a_folder_with_a_card_by_its_name(index, tmp_path):
    """With ``data_dir`` it would take the index for a tar."""
    folder = shutil.copytree(SHARDS, tmp_path / "packed", ignore=lambda *_: {"README.md"})
    write_card(index, folder, repository="a/b")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from datasets import load_dataset

        rows = list(load_dataset(str(folder), "Uniform", split="train", streaming=True))
        scenes = list(load_dataset(str(folder), "scenes", split="train", streaming=True))

    assert [row["__key__"] for row in rows] == [
        f"train/Uniform/SynthStage/scene_{number:06d}" for number in range(2)
    ]
    assert frames_of(rows[0]["cam_05_depth.mkv"]) == 81
    assert {scene["family.txt"] for scene in scenes} == {
        "IPD_Gaussian", "Pairwise_Uniform", "Uniform",
    }  # fmt: skip


def test_hugging_face_datasets_streams_one_scene_as_one_row(index):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from datasets import Features, Value, load_dataset

        columns = {name: Value("binary") for name in VIDEO_FILES}
        features = Features({**columns, "__key__": Value("string"), "__url__": Value("string")})
        rows = list(
            load_dataset(
                "webdataset",
                data_files={"train": TARS},
                split="train",
                streaming=True,
                features=features,
            )
        )

    assert sorted(row["__key__"] for row in rows) == expected_keys(index)
    assert frames_of(rows[0]["cam_05_depth.mkv"]) == 81
