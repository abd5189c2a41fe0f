"""Every example runs as its own text says, on the sample shards, and stays short."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MOST_LINES = 60


def run(tmp_path, *command):
    settings = {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=tmp_path, capture_output=True, text=True,
        check=False, timeout=240, env=os.environ | settings | {"HF_HOME": str(tmp_path / "home")},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def torchrun(tmp_path, *arguments):
    return run(
        tmp_path, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2, *arguments
    )  # fmt: skip


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short_enough_to_be_copied(path):
    assert len(path.read_text().splitlines()) <= MOST_LINES


def test_plain_pytorch_trains_and_draws(tmp_path):
    said = run(tmp_path, EXAMPLES / "train.py")

    errors = [float(number) for number in re.findall(r"error +([\d.]+) px", said)]
    assert len(errors) == 24
    assert min(errors[-6:]) < errors[0]
    assert (tmp_path / "demo" / "contact_sheet.png").stat().st_size > 1000


def test_two_ranks_train_and_a_second_run_goes_on(tmp_path):
    first = torchrun(tmp_path, EXAMPLES / "distributed.py")
    second = torchrun(tmp_path, EXAMPLES / "distributed.py")

    assert sorted(re.findall(r"rank (\d): epoch (\d)", first)) == [
        ("0", "0"), ("0", "1"), ("1", "0"), ("1", "1"),
    ]  # fmt: skip
    assert sorted(re.findall(r"rank (\d): epoch (\d)", second)) == [("0", "1"), ("1", "1")]


def test_pairs_are_made_on_the_device(tmp_path):
    said = run(tmp_path, EXAMPLES / "derive_on_device.py")

    errors = re.findall(r"epoch \d: 300 pairs of 20 moments, error ([\d.]+) px", said)
    assert len(errors) == 2
    assert float(errors[1]) < float(errors[0])


def test_lightning_trains_and_validates(tmp_path):
    assert re.search(r"error [\d.]+ px", run(tmp_path, EXAMPLES / "lightning_module.py"))


def test_accelerate_trains(tmp_path):
    said = run(tmp_path, EXAMPLES / "accelerate_loop.py")

    assert re.findall(r"epoch (\d): error", said) == ["0", "1"]


def test_hugging_face_streams_samples_and_raw_shards(tmp_path):
    said = run(tmp_path, EXAMPLES / "huggingface_streaming.py")

    assert "left (4, 3, 72, 72) torch.uint8" in said
    assert "16 batches of 4 scenes" in said
    assert said.count("raw shards: train/") == 4


def test_webdataset_decodes_by_our_stage(tmp_path):
    said = run(tmp_path, EXAMPLES / "webdataset_pipeline.py")

    assert len(re.findall(r"batch \d+: \(5, 3, 72, 72\)", said)) == 12
