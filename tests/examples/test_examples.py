"""Every example runs as its own text says, on the sample shards, and stays short."""

import json
import re
import runpy
import signal
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import find_scene
from tests.servers.tools import run_python

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SHARDS = EXAMPLES.parent / "shards"
MOST_LINES = 120


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run an example in this process and an empty folder, and return what it prints."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("ACCELERATE_USE_CPU", "true")

    def run_example(path, *words):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(path), *map(str, words)])
        monkeypatch.syspath_prepend(path.parent)
        torch.manual_seed(0)
        capsys.readouterr()
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    yield run_example
    for name in ("network", "train"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="session")
def two_scenes(tmp_path_factory):
    """Shards with a scene of each of two families of the sample's train split."""
    index, folder = SceneIndex.open(SHARDS), tmp_path_factory.mktemp("sample")
    keys = [f"train/{family}/SynthStage/scene_000000" for family in ("IPD_Gaussian", "Uniform")]
    rows = [find_scene(index, key) for key in keys]
    for row in rows:
        shard = index.scene(row).members["baseline.json"].path
        (folder / shard).hardlink_to(SHARDS / shard)
    index.only(rows).write(folder / "index.parquet")
    return folder


pytestmark = pytest.mark.filterwarnings("ignore")
"""Libraries that examples use warn of themselves."""


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short_enough_to_be_copied(path):
    assert len(path.read_text().splitlines()) <= MOST_LINES


def test_the_demo_learns_what_it_never_saw_and_draws_it(run, tmp_path):
    said = run(EXAMPLES / "train.py", "--steps", 20)

    before, after = re.search(
        r"held-out error ([\d.]+) px before, ([\d.]+) px after\n$", said
    ).groups()
    assert float(after) < float(before) / 3
    with Image.open(tmp_path / "demo" / "training.png") as picture:
        assert min(picture.size) > 1000


def test_a_real_training_goes_on_where_it_was_stopped_and_runs_of_one_kind_are_scored_together(
    run, tmp_path, ground_truth
):
    stereo, runs = EXAMPLES / "stereo", [tmp_path / seed for seed in "01"]

    def train(trained, steps):
        usual = ("--crop", 64, 64, "--workers", 0, "--seed", trained.name, "--steps", steps)
        return run(stereo / "train.py", SHARDS, trained, *usual)

    begun, again, _ = train(runs[0], 2), train(runs[0], 2), train(runs[1], 1)
    one, both = (
        run(stereo / "score.py", "--middlebury", ground_truth, *given).splitlines()
        for given in (runs[:1], runs)
    )

    assert ("from step 0 on" in begun, "from step 2 on" in again) == (True, True)
    log = (runs[0] / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in log] == [2]
    opencv, network = (line.split(" | ") for line in one[2:])
    assert len(opencv) == len(network) == 5
    assert float(opencv[-1].split(" px")[0]) < 1 < float(network[-1].split(" px")[0])
    mean, least, most = map(
        float, re.match(r"(.*) px \((.*) to (.*)\),", both[-1].split(" | ")[-1]).groups()
    )
    assert float(network[-1].split(" px")[0]) in (least, most)
    assert mean == pytest.approx((least + most) / 2, abs=0.011)


def test_the_waiting_for_data_is_printed_for_each_number_of_workers(run, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES / "stereo")
    monkeypatch.setattr("train.CROP", (64, 64))
    said = run(EXAMPLES / "stereo" / "waiting.py", SHARDS, SHARDS, "--steps", 2)

    rows = [line.strip("| ").split(" | ") for line in said.splitlines()[2:]]
    assert [row[1] for row in rows] == ["0", "1", "2"] * 2
    assert all(0 < float(row[3].rstrip("%")) < 100 for row in rows)


def test_a_learned_right_view_is_better_than_warping(run, tmp_path):
    said = run(EXAMPLES / "learned_fill.py", "--steps", 20)

    means = {}
    for line in said.splitlines():
        cells = line.strip("| ").split(" | ")
        if cells[0] in ("warp and fill", "learned"):
            means.setdefault(cells[0], []).append(float(cells[-2].split()[0]))
    assert len(means["learned"]) > 5
    assert sum(means["learned"]) > sum(means["warp and fill"])
    assert (tmp_path / "demo" / "learned_fill.png").exists()


def test_pairs_are_made_on_the_device(run, two_scenes):
    said = run(EXAMPLES / "derive_on_device.py", two_scenes)

    errors = re.findall(r"epoch \d: 150 pairs of 10 moments, error ([\d.]+) px", said)
    assert len(errors) == 2
    assert float(errors[1]) < float(errors[0])


def test_a_killed_run_of_two_ranks_goes_on_in_mid_epoch_and_takes_each_sample_once(tmp_path):
    """Of the 12 batches of an epoch and rank 6 are saved; another epoch follows."""
    saved, epoch = 6, 12

    printed = run_python("-m", "tests.examples.watched", tmp_path, EXAMPLES / "distributed.py")

    killed, done = json.loads((tmp_path / "ends.json").read_text())
    assert -signal.SIGKILL in killed
    assert done == [0, 0]
    before, going_on = (
        [json.loads((tmp_path / f"{run}.{rank}").read_text()) for rank in range(2)]
        for run in ("killed", "done")
    )
    assert max(map(len, before)) == 9
    assert min(map(len, before)) >= saved
    assert [len(of_rank) for of_rank in going_on] == [2 * epoch - saved] * 2
    whole = [old[:saved] + new for old, new in zip(before, going_on, strict=True)]
    for part in (slice(0, epoch), slice(epoch, None)):
        batches = [batch for of_rank in whole for batch in of_rank[part]]
        names = [name for batch in batches for name in batch]
        assert len(set(names)) == len(names) == 2 * epoch * len(batches[0])
    assert whole[0][:epoch] != whole[0][epoch:]
    # Two processes write here, so that ends of lines may come between.
    said = {*re.findall(r"rank \d: epoch \d", printed)}
    assert said == {f"rank {rank}: epoch {number}" for rank in range(2) for number in range(2)}


@pytest.mark.parametrize(
    ("example", "told"),
    [
        ("accelerate_loop.py", r"epoch 0: error [\d.]+ px\nepoch 1: error [\d.]+ px"),
        ("lightning_module.py", r"error [\d.]+ px"),
        ("huggingface_trainer.py", ""),
    ],
)
def test_a_frameworks_example_trains(run, example, told):
    """How runs of theirs go on is tested with the frameworks."""
    assert re.search(told, run(EXAMPLES / example))


def test_the_distributed_example_says_how_it_is_started(run):
    with pytest.raises(SystemExit, match="torchrun --nproc-per-node 2"):
        run(EXAMPLES / "distributed.py")


def test_hugging_face_streams_samples_and_raw_shards(run):
    said = run(EXAMPLES / "huggingface_streaming.py")

    assert "left (4, 3, 72, 72) torch.uint8" in said
    assert "16 batches of 4 scenes" in said
    assert said.count("raw shards: train/") == 4


def test_webdataset_shuffles_and_decodes_by_our_stage(run):
    said = run(EXAMPLES / "webdataset_pipeline.py")

    epochs = [re.findall(r"^  (train/.*)$", part, re.MULTILINE) for part in said.split("epoch 1")]
    epochs = [epochs[0], [key for part in epochs[1:] for key in part]]
    assert len(epochs[0]) == len(set(epochs[0])) == 60
    assert epochs[0] != epochs[1]
    assert sorted(epochs[0]) == sorted(epochs[1])
    assert any(len({key.rsplit("/", 2)[0] for key in epoch[:5]}) > 1 for epoch in epochs)


def test_a_video_diffusion_step_takes_clips_with_captions(run, two_scenes):
    said = run(EXAMPLES / "clip_diffusion.py", two_scenes)

    losses = [float(loss) for loss in re.findall(r"loss ([\d.]+), .* Stereo baseline", said)]
    assert len(losses) == 2
    assert losses[1] < losses[0]


def test_several_views_train_a_network_of_points(run, two_scenes):
    said = run(EXAMPLES / "multiview_points.py", two_scenes)

    errors = [float(error) for error in re.findall(r"error ([\d.]+) of", said)]
    assert len(errors) == 4
    assert errors[-1] < errors[0]
