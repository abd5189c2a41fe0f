"""Scoring what a method wrote or returns: the same both ways, restartable, never silently less."""

import json
import math
import os
import shutil
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from stereogenbench_data import EvaluationError, EvaluationProtocol
from stereogenbench_data.engine import LOCAL, ProcessPool
from stereogenbench_data.errors import FieldError, PredictionError, StorageError
from stereogenbench_data.evaluation.models import i3d, inception
from stereogenbench_data.evaluation.predictions import frame_name, item_name
from stereogenbench_data.schema.release import rgb_name
from tests.evaluation.conftest import (
    FRAMES,
    QUICK,
    SIZE,
    numbers,
    rendered,
    scored,
    true_ssim,
    write_pngs,
)
from tests.servers.tools import killed_fork


def keys(index):
    return [str(key) for key in index.column("key")]


@pytest.fixture
def copied(right_views, tmp_path):
    """The rendered right views, free to be changed."""
    return Path(shutil.copytree(right_views, tmp_path / "copied"))


def test_scores_are_those_of_scikit_image_averaged_over_frames(scored_index, other_views, protocol):
    pair = scored(scored_index, other_views, protocol).pairs[0]
    views = [
        [rendered(scored_index, pair.scene, camera, frame) for camera in (1, 2)]
        for frame in range(FRAMES)
    ]
    psnr = [peak_signal_noise_ratio(*both, data_range=255) for both in views]

    assert pair.tallies["psnr"].mean == pytest.approx(np.mean(psnr), abs=1e-9)
    ssim = [true_ssim(*both) for both in views]
    assert pair.tallies["ssim"].mean == pytest.approx(np.mean(ssim), abs=1e-6)


def test_one_and_two_processes_give_the_same_last_digits(scored_index, other_views, tmp_path):
    protocol = EvaluationProtocol(metrics=("psnr", "ssim", "e_match"), size=SIZE)
    results = [
        scored(scored_index, other_views, protocol, workers=workers, out=tmp_path / str(workers))
        for workers in (1, 2)
    ]

    assert numbers(results[0]) == numbers(results[1])


def test_a_callable_gets_its_tiers_inputs_in_batches_and_scores_as_if_written(
    scored_index, other_views, protocol
):
    seen = []

    def method(inputs):
        seen.append({name: (tuple(each.shape), each.dtype) for name, each in inputs.items()})
        found = np.abs(inputs["left"].numpy()[:, None].astype(int) - known_lefts).sum((2, 3, 4))
        return torch.from_numpy(known_rights[found.argmin(1)])

    places = [(scene, frame) for scene in keys(scored_index) for frame in range(FRAMES)]
    known_lefts = np.stack([rendered(scored_index, s, 0, f) for s, f in places])[None].astype(int)
    known_rights = np.stack([rendered(scored_index, s, 2, f) for s, f in places])
    called = scored(scored_index, method, protocol)
    written = scored(scored_index, other_views, protocol)

    assert numbers(called) == numbers(written)
    assert called.name == "method"
    assert [each["left"] for each in seen] == [
        ((size, 3, *SIZE), torch.uint8) for _ in range(3) for size in (3, 1)
    ]
    assert seen[0]["baseline_m"] == ((3,), torch.float64)
    assert set(seen[0]) == {"left", "baseline_m", "intrinsics"}


def test_floats_of_0_to_1_are_rounded_to_8_bits(scored_index, protocol):
    lefts, floats = (
        scored(scored_index, method, protocol)
        for method in (lambda inputs: inputs["left"], lambda inputs: inputs["left"].float() / 255)
    )

    assert numbers(lefts) == numbers(floats)


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (lambda inputs: inputs["left"][:1], r"given 3 frames.* torch\.uint8 \(1, 3, 48, 64\)"),
        (lambda inputs: inputs["left"].float(), r"returned floats of \d+ to \d+; expected 0 to 1"),
        (lambda inputs: inputs["left"].float() * math.nan, r"returned floats of nan to nan"),
        (lambda inputs: inputs["left"].int(), r"returned torch\.int32 \(3, 3, 48, 64\)"),
        (
            lambda inputs: [each[:, : 9 + n] for n, each in enumerate(inputs["left"].numpy())],
            r"returned a list that is not one array",
        ),
    ],
)
def test_what_a_callable_returns_is_checked(scored_index, protocol, method, message):
    with pytest.raises(PredictionError, match=message):
        scored(scored_index, method, protocol)


def released_videos(folder, index, *, size):
    for key in keys(index):
        target = folder / key / "00-01.mp4"
        target.parent.mkdir(parents=True)
        shutil.copy(Path(index.root, key, rgb_name(1)), target)


@pytest.mark.parametrize(
    ("write", "evaluated", "written"),
    [
        (write_pngs, (96, 128), (96, 128)),
        (write_pngs, (96, 128), None),
        (write_pngs, (33, 47), None),
        (released_videos, SIZE, None),
    ],
)
def test_pictures_and_videos_identical_to_the_rendered_view_score_infinitely(
    scored_index, tmp_path, write, evaluated, written
):
    write(tmp_path, scored_index, size=written)
    protocol = EvaluationProtocol(metrics=("psnr", "ssim", "p_psnr"), size=evaluated)
    scores = scored(scored_index, tmp_path, protocol)

    assert [pair.tallies["psnr"].infinite for pair in scores.pairs] == [FRAMES] * 3
    assert [pair.tallies["ssim"].mean for pair in scores.pairs] == [1.0] * 3
    for pair in scores.pairs:
        assert pair.tallies["p_psnr"] == pair.tallies["p_psnr_ceiling"]


def test_a_missing_prediction_is_an_error_before_anything_is_scored(scored_index, copied, protocol):
    scene = keys(scored_index)[1]
    shutil.rmtree(copied / item_name(scene, (0, 1)))
    done = []

    match = (
        rf"1 prediction missing or unusable, and 0 allowed.*{scene}.* expected a "
        rf"folder or video {scene}/00-01 or {item_name(scene, (0, 1))}\.$"
    )
    with pytest.raises(EvaluationError, match=match):
        scored(scored_index, copied, protocol, progress=lambda *counts: done.append(counts))
    assert done == []


def test_a_prediction_that_is_not_right_is_an_error_or_a_counted_gap(
    scored_index, copied, protocol
):
    _, second, scene = keys(scored_index)
    (copied / item_name(scene, (0, 1)) / frame_name(3)).write_bytes(b"no picture")

    with pytest.raises(PredictionError, match=r"003\.png cannot be read as a picture"):
        scored(scored_index, copied, protocol)
    scores = scored(scored_index, copied, protocol, allow_missing=1)
    assert [pair.scene for pair in scores.pairs if pair.problem] == [scene]
    assert [bool(pair.tallies) for pair in scores.pairs] == [True, True, False]
    (copied / f"{item_name(second, (0, 1))}.mp4").touch()
    with pytest.raises(EvaluationError, match=r"2 predictions missing or unusable, and 1 allowed"):
        scored(scored_index, copied, protocol, allow_missing=1)


def test_an_evaluation_that_was_killed_goes_on_with_what_it_has(scored_index, protocol, tmp_path):
    out = tmp_path / "out"
    batches = []

    def killed(inputs):
        batches.append(inputs)
        if len(batches) == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        return inputs["left"]

    assert killed_fork(lambda: scored(scored_index, killed, protocol, name="lefts", out=out))
    (kept,) = (out / "scenes").glob("*.pt")
    before = kept.stat().st_mtime_ns
    calls = []

    def lefts(inputs):
        calls.append(len(inputs["left"]))
        return inputs["left"]

    resumed = scored(scored_index, lefts, protocol, name="lefts", out=out)

    assert kept.stat().st_mtime_ns == before
    assert sum(calls) == 2 * FRAMES
    assert numbers(resumed) == numbers(scored(scored_index, lefts, protocol))


class Faded:
    """A method with a parameter, and what it was called with."""

    def __init__(self, share):
        self.share, self.calls = share, 0

    def __call__(self, inputs):
        self.calls += 1
        return inputs["left"] / 255 * self.share


@pytest.mark.parametrize(
    ("method", "called"),
    [
        (Faded(0.5), "Faded"),
        (partial(Faded(0.5)), "partial"),
        (Faded(0.5).__call__, "__call__"),
        (lambda inputs: inputs["left"], "<lambda>"),
        (torch.nn.Identity(), "Identity"),
    ],
)
def test_a_callable_whose_scores_are_kept_must_be_named_before_anything_is_done(
    scored_index, protocol, tmp_path, method, called
):
    out = tmp_path / "out"

    for nameless in ({}, {"name": None}, {"name": ""}):
        match = rf"out: is to keep the scores of {called},.* Pass name="
        with pytest.raises(EvaluationError, match=match):
            scored(scored_index, method, protocol, out=out, **nameless)
    assert not out.exists()


def test_kept_scores_are_those_of_the_name_alone(scored_index, protocol, tmp_path):
    whole, half = Faded(1.0), Faded(0.5)
    first = scored(scored_index, whole, protocol, name="whole", out=tmp_path)

    match = r"other methods: \['whole'\], where \['half'\] is asked for"
    with pytest.raises(EvaluationError, match=match):
        scored(scored_index, half, protocol, name="half", out=tmp_path)
    again = scored(scored_index, whole, protocol, name="whole", out=tmp_path)

    assert half.calls == 0
    assert whole.calls == 2 * 3
    assert numbers(again) == numbers(first)


MATCHER = """
import numpy as np

class Mine:
    name, settings = "Mine", {{}}

    def __call__(self, left, right):
        return np.full(left.shape[1:], {0}, dtype=np.float32)
"""


def test_a_matcher_of_the_same_name_in_another_file_is_another_one(
    scored_index, right_views, tmp_path, monkeypatch
):
    for place in ("one", "two"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "mine.py").write_text(MATCHER.format(len(place)))
    protocol = EvaluationProtocol(metrics=("sd",), size=SIZE, stereo_matcher="mine.py:Mine")

    monkeypatch.chdir(tmp_path / "one")
    for _ in range(2):
        scored(scored_index, right_views, protocol, frames=[0], out=tmp_path / "out")
    monkeypatch.chdir(tmp_path / "two")
    match = r"other matchers: \['sift', '.*one/mine\.py:Mine'\], where .*two/mine"
    with pytest.raises(EvaluationError, match=match):
        scored(scored_index, right_views, protocol, frames=[0], out=tmp_path / "out")


class Counting(ProcessPool):
    """Processes of this machine, and how many were asked for."""

    asked: ClassVar = []

    def map(self, *given, workers, **options):
        self.asked.append(workers)
        yield from LOCAL.map(*given, workers=1, **options)


@pytest.mark.parametrize(
    ("device", "workers", "asked"),
    [("cpu", None, None), ("cuda", None, 1), ("cuda:1", None, 1), ("cuda", 3, 3)],
)
def test_models_on_a_gpu_are_loaded_by_one_process_unless_more_are_asked_for(
    scored_index, right_views, device, workers, asked
):
    protocol = replace(QUICK, device=device)

    scored(scored_index, right_views, protocol, frames=[0], workers=workers, engine=Counting())

    assert Counting.asked.pop() == asked


def test_results_of_another_evaluation_are_refused_by_what_differs(
    scored_index, right_views, tmp_path
):
    options = {"protocol": QUICK, "frames": [0]}
    scored(scored_index, right_views, **options, out=tmp_path)

    for change, differs in (
        ({"protocol": replace(QUICK, size=(32, 64))}, r"settings\.size"),
        ({"tier": "G2"}, "tier: 'G1', where 'G2'"),
        ({"frames": [0, 1]}, "frames"),
        ({"name": "another"}, "methods"),
    ):
        with pytest.raises(EvaluationError, match=rf"holds scores of other {differs}"):
            scored(scored_index, right_views, **(options | change), out=tmp_path)


def test_partial_results_that_are_cut_are_made_again_and_of_another_format_refused(
    scored_index, right_views, protocol, tmp_path
):
    whole = scored(scored_index, right_views, protocol, out=tmp_path)
    damaged = sorted((tmp_path / "scenes").glob("*.pt"))[0]
    content = damaged.read_bytes()
    damaged.write_bytes(content[:100])

    assert numbers(scored(scored_index, right_views, protocol, out=tmp_path)) == numbers(whole)
    assert len(damaged.read_bytes()) == len(content)
    state = tmp_path / "evaluation.json"
    state.write_text(json.dumps(json.loads(state.read_text()) | {"format": 5}))
    with pytest.raises(EvaluationError, match="holds scores of other format: 5, where 6"):
        scored(scored_index, right_views, protocol, out=tmp_path)


def test_scores_of_a_scene_that_are_removed_during_a_run_are_named_and_made_by_the_next(
    scored_index, right_views, protocol, tmp_path
):
    def remove_the_first(done, total):
        if done == total:
            for path in (tmp_path / "scenes").iterdir():
                path.unlink()

    with pytest.raises(StorageError, match=rf"\.pt: the scores of {keys(scored_index)[0]} were re"):
        scored(scored_index, right_views, protocol, out=tmp_path, progress=remove_the_first)
    again = scored(scored_index, right_views, protocol, out=tmp_path)

    assert numbers(again) == numbers(scored(scored_index, right_views, protocol))


def test_views_that_changed_since_are_scored_again(scored_index, copied, protocol, tmp_path):
    out = tmp_path / "out"
    before = scored(scored_index, copied, protocol, out=out)
    scene = keys(scored_index)[0]
    changed = copied / item_name(scene, (0, 1)) / frame_name(0)
    Image.new("RGB", SIZE[::-1]).save(changed)

    after = scored(scored_index, copied, protocol, out=out)

    assert numbers(after) == numbers(scored(scored_index, copied, protocol))
    assert numbers(after) != numbers(before)


def test_a_gap_that_was_filled_since_is_scored(scored_index, copied, protocol, tmp_path):
    scene = keys(scored_index)[0]
    item = copied / item_name(scene, (0, 1))
    item.rename(copied / "aside")
    out = tmp_path / "out"
    gaps = scored(scored_index, copied, protocol, out=out, allow_missing=1)
    again = scored(scored_index, copied, protocol, out=out, allow_missing=1)
    (copied / "aside").rename(item)
    filled = scored(scored_index, copied, protocol, out=out)

    assert [bool(pair.problem) for pair in gaps.pairs] == [True, False, False]
    assert numbers(again) == numbers(gaps)
    assert not any(pair.problem for pair in filled.pairs)


class MeanColours:
    """In place of a network: the mean colours of a picture, or of the frames of a clip."""

    name = "mean colours"
    min_frames = FRAMES
    settings: ClassVar = {}

    def __call__(self, pictures):
        return pictures.mean(axis=(-2, -1)).reshape(len(pictures), -1)


def test_distances_between_sets_are_of_branches(
    scored_index, right_views, other_views, tmp_path, monkeypatch
):
    monkeypatch.setattr(inception, "InceptionFeatures", MeanColours)
    monkeypatch.setattr(i3d, "I3dFeatures", MeanColours)
    protocol = EvaluationProtocol(metrics=("fid", "fvd"), size=SIZE, batch_frames=3)
    same = scored(scored_index, right_views, protocol).distances
    other = scored(scored_index, other_views, protocol, out=tmp_path / "out").distances

    assert set(same) == {("seen_map", "Uniform"), ("unseen_map", "IPD_Gaussian")}
    for branch, found in same.items():
        assert found["fid"].value == pytest.approx(0, abs=1e-6)
        assert other[branch]["fid"].value > 0.01
    uniform = other["seen_map", "Uniform"]
    assert (uniform["fid"].samples, uniform["fid"].dim) == ((2 * FRAMES, 2 * FRAMES), 3)
    assert (uniform["fvd"].samples, uniform["fvd"].dim) == ((2, 2), 3 * FRAMES)
    assert not uniform["fid"].underdetermined
    assert uniform["fvd"].underdetermined


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": ("clips", 2)}, "frames must be 'all', 'first', numbers of frames"),
        ({"pairs": "sweep"}, r"left view .* choose pairs='primary', 'adjacent'"),
        (
            {"direction": "right_to_left"},
            r"left view .* choose pairs='primary', 'adjacent'",
        ),
        ({"predictions": Path("nowhere")}, r"nowhere: is not a folder\. Pass "),
    ],
)
def test_what_cannot_be_scored_is_refused(scored_index, right_views, protocol, options, message):
    with pytest.raises(EvaluationError, match=message):
        scored(scored_index, **({"predictions": right_views, "protocol": protocol} | options))


def test_scores_are_the_same_on_one_thread_and_on_three_whose_number_is_left_as_it_was(
    scored_index, other_views
):
    before = cv2.getNumThreads(), torch.get_num_threads()
    protocol = EvaluationProtocol(metrics=("psnr", "ssim", "p_psnr", "e_match"), size=SIZE)
    results = []
    try:
        for threads in (1, 3):
            cv2.setNumThreads(threads)
            torch.set_num_threads(threads)
            results.append(numbers(scored(scored_index, other_views, protocol, frames=[0])))
            assert (cv2.getNumThreads(), torch.get_num_threads()) == (threads, threads)
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])

    assert results[0] == results[1]


def test_predictions_of_some_frames_suffice_where_these_are_scored(
    scored_index, protocol, tmp_path
):
    folder = write_pngs(tmp_path / "some", scored_index, frames=[0, 2])
    scores = scored(scored_index, folder, protocol, frames=("every", 2))

    assert [pair.frames for pair in scores.pairs] == [2, 2, 2]


def test_baselines_that_poses_contradict_are_not_scored_by_any_metric(
    scored_index, right_views, tmp_path, rewrite
):
    key = keys(scored_index)[0]
    folder = tmp_path / "tree" / key
    shutil.copytree(Path(scored_index.root, key), folder, copy_function=shutil.copyfile)

    def move(document):
        for frame in document["frames"]:
            for pose in frame["cameras"]:
                pose["location"] = {axis: 0.9 * cm for axis, cm in pose["location"].items()}

    rewrite(folder / "trajectory.json", move)

    with pytest.raises(StorageError, match=r"baseline_m.* cm apart"):
        scored(tmp_path / "tree", right_views, QUICK, tier="G2")


def test_conventions_are_taken_where_a_folder_is_opened(
    scored_index, right_views, protocol, tmp_path
):
    file = tmp_path / "conventions.toml"
    file.write_text("[depth]\nunit_m = 0.001\n")

    scores = scored(scored_index.root, right_views, protocol, frames=[0], conventions=file)

    assert all(scores.index.scene(row).conventions for row in range(3))
    with pytest.raises(FieldError, match="open already"):
        scored(scored_index, right_views, protocol, conventions=file)
