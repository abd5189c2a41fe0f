"""Scored disparity: by the definitions of KITTI and Middlebury, from files and from callables."""

import json
import math
import struct
import zipfile

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch import multiprocessing

from stereogenbench_data import (
    DisparityError,
    DisparityProtocol,
    EvaluationError,
    StereoPairs,
    disparity_tables,
    evaluate_disparity,
    tables_of,
)
from stereogenbench_data.errors import PredictionError
from stereogenbench_data.evaluation.disparity_maps import read_disparity
from stereogenbench_data.evaluation.metrics.disparity import MEASURES, RANGES_PX, frame_scores
from stereogenbench_data.evaluation.report import document, page
from tests.cli.command import succeed
from tests.evaluation.conftest import FRAMES

FIELDS = ("left", "right", "disparity", "valid", "visible", "scene", "frame_index", "__key__")
WHOLE = {"split": "eval", "frames": "all", "workers": 1}


def expected(found, truth, scored):
    """Return the measures of some pixels, each straight from its definition."""
    found, truth = found[scored].astype(float), truth[scored].astype(float)
    if not truth.size:
        return dict.fromkeys(MEASURES, math.nan)
    answered = np.isfinite(found)
    error = np.abs(found - truth)
    wrong = {
        f"bad_{t:g}": np.mean(~answered | (np.nan_to_num(error, posinf=0) > t))
        for t in (0.5, 1, 2, 3, 4)
    }
    far, relative = (error > limit for limit in (3, 0.05 * truth))
    measures = {
        **wrong,
        "d1": np.mean(~answered | (far & relative)),
        "invalid": 1 - answered.mean(),
    }
    error = error[answered]
    of_answers = dict.fromkeys(("epe", "rms", "a50", "a90", "a95", "a99"), math.nan)
    if error.size:
        of_answers = {"epe": error.mean(), "rms": np.sqrt(np.mean(error**2))}
        of_answers |= {f"a{share}": np.quantile(error, share / 100) for share in (50, 90, 95, 99)}
    return measures | of_answers


def score(found, truth, valid, visible=None, most=None):
    maps = [None if each is None else torch.from_numpy(each) for each in (valid, visible)]
    return frame_scores(
        torch.from_numpy(found), torch.from_numpy(truth), valid=maps[0], visible=maps[1],
        max_disparity_px=most,
    )  # fmt: skip


@pytest.fixture(scope="module")
def samples(scored_index):
    """Every frame of every primary pair, with its truth."""
    return list(StereoPairs(scored_index, split="eval", frames="all", fields=FIELDS))


def guess(sample):
    """Return a map with errors of all sizes and some pixels without an answer."""
    generator = np.random.default_rng(int(sample["frame_index"]))
    truth = sample["disparity"][0].numpy()
    found = np.abs(truth + generator.normal(scale=2, size=truth.shape)).astype(np.float32)
    found[generator.random(truth.shape) < 0.1] = np.nan
    return found


def write_maps(folder, samples, write, frames=FRAMES):
    """Write the guesses of all frames; return the folder."""
    for sample in samples[: frames * 3]:
        place = folder / sample["scene"] / "00-01"
        place.mkdir(parents=True, exist_ok=True)
        write(place / f"{int(sample['frame_index']):03d}", guess(sample))
    return folder


def write_pfm(path, found, order="<", scale=None):
    """Write a PFM by hand: from the bottom row up, with a scale whose size means nothing."""
    scale = scale or {"<": b"-3.5", ">": b"7"}[order]
    head = b"Pf\n%d %d\n%s\n" % (found.shape[1], found.shape[0], scale)
    rows = [struct.pack(f"{order}{len(row)}f", *row) for row in found[::-1].tolist()]
    path.with_suffix(".pfm").write_bytes(head + b"".join(rows))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 7),
    width=st.integers(1, 9),
    unanswered=st.sampled_from([0.0, 0.3, 1.0]),
    most=st.sampled_from([None, 40.0]),
)
def test_every_measure_is_what_its_definition_says(seed, height, width, unanswered, most):
    generator = np.random.default_rng(seed)
    truth = generator.exponential(60, (height, width)).astype(np.float32)
    found = np.abs(truth + generator.normal(scale=3, size=truth.shape)).astype(np.float32)
    found[generator.random(truth.shape) < unanswered] = np.inf
    valid, visible = (generator.random(truth.shape) < 0.7 for _ in range(2))
    scored = valid if most is None else valid & (truth < most)

    scores = score(found, truth, valid, visible, most)

    parts = {"": True, "_visible": visible, "_occluded": ~visible}
    parts |= {
        f"_{name}": (truth >= low) & (truth < high) for name, (low, high) in RANGES_PX.items()
    }
    for ending, part in parts.items():
        for name, number in expected(found, truth, scored & part).items():
            assert scores[f"{name}{ending}"] == pytest.approx(number, nan_ok=True, abs=1e-12)
    left_out = 1 - scored.sum() / valid.sum() if valid.any() else math.nan
    assert scores["beyond"] == pytest.approx(left_out, nan_ok=True)


def test_hand_worked_numbers():
    truth = np.array([[10.0, 20.0, 100.0, 200.0, 50.0]])
    found = np.array([[10.5, 23.5, 104.0, 215.0, np.nan]])

    scores = score(found, truth, np.ones((1, 5), dtype=bool))

    # 4 px of 100 are no more than 5 %; 3.5 px of 20 and 15 of 200 are; the last has no answer.
    assert scores["d1"] == pytest.approx(3 / 5)
    assert scores["bad_3"] == pytest.approx(4 / 5)
    assert scores["bad_0.5"] == pytest.approx(4 / 5)
    assert scores["epe"] == pytest.approx((0.5 + 3.5 + 4 + 15) / 4)
    assert scores["invalid"] == pytest.approx(1 / 5)
    assert scores["a50"] == pytest.approx(3.75)


def test_written_in_any_kind_of_file_and_returned_by_a_call_the_scores_are_the_same(
    scored_index, samples, tmp_path
):
    known = {sample["left"].numpy().tobytes(): guess(sample) for sample in samples}

    def method(batch):
        assert batch["right"].shape == batch["left"].shape
        return torch.stack(
            [torch.from_numpy(known[left.numpy().tobytes()]) for left in batch["left"]]
        )

    kinds = {
        "npy": lambda path, found: np.save(path, found[None]),
        "npz": lambda path, found: np.savez_compressed(path, disparity=found, other=found[:1]),
        "one": lambda path, found: np.savez(path, found.astype(np.float64)),
        "pfm": write_pfm,
        "big": lambda path, found: write_pfm(path, found, ">"),
    }
    folders = {name: write_maps(tmp_path / name, samples, kind) for name, kind in kinds.items()}
    called = evaluate_disparity(scored_index, method, **WHOLE)
    for folder in folders.values():
        written = evaluate_disparity(scored_index, folder, **WHOLE)
        assert repr([each.tallies for each in written.pairs]) == repr(
            [each.tallies for each in called.pairs]
        )
        assert written.views_sha256 == called.views_sha256
    for pair in called.pairs:
        of_pair = [each for each in samples if each["scene"] == pair.scene]
        truth = [
            expected(guess(each), each["disparity"][0].numpy(), each["valid"][0].numpy())
            for each in of_pair
        ]
        for name in MEASURES:
            assert pair.tallies[name].mean == pytest.approx(np.mean([one[name] for one in truth]))


def test_kittis_png_has_steps_of_a_256th_and_0_for_no_answer(tmp_path):
    found = np.array([[1.0, 2.50390625, np.nan, 255.99609375]])
    stored = np.where(np.isnan(found), 0, np.round(found * 256)).astype(np.uint16)
    Image.fromarray(stored).save(tmp_path / "000.png")
    cv2.imwrite(str(tmp_path / "001.png"), stored)

    for name in ("000.png", "001.png"):
        read = read_disparity(tmp_path / name, size=(1, 4), where="here")
        np.testing.assert_array_equal(read, found)


def test_a_pfm_is_read_as_opencv_reads_it(tmp_path):
    found = np.random.default_rng(0).random((5, 7)).astype(np.float32)
    cv2.imwrite(str(tmp_path / "000.pfm"), found)
    write_pfm(tmp_path / "001", found, scale=b"-1.0")  # by which it would multiply

    opencvs = cv2.imread(str(tmp_path / "001.pfm"), cv2.IMREAD_UNCHANGED)
    for name, expected_px in (("000.pfm", found), ("001.pfm", opencvs)):
        read = read_disparity(tmp_path / name, size=(5, 7), where="here")
        np.testing.assert_array_equal(read, expected_px)


def bomb(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("disparity.npy", bytes(1 << 24))


UNUSABLE = {
    "cut.pfm": lambda path: path.write_bytes(b"Pf\n4 3\n-1\n" + bytes(47)),
    "long.pfm": lambda path: path.write_bytes(b"Pf\n4 3\n-1\n" + bytes(49)),
    "colour.pfm": lambda path: path.write_bytes(b"PF\n4 3\n-1\n" + bytes(144)),
    "no scale.pfm": lambda path: path.write_bytes(b"Pf\n4 3\n0\n" + bytes(48)),
    "large.pfm": lambda path: path.write_bytes(b"Pf\n999999999 999999999\n-1\n"),
    "empty.pfm": lambda path: path.write_bytes(b""),
    "8 bits.png": lambda path: Image.new("L", (4, 3)).save(path),
    "colour.png": lambda path: Image.new("RGB", (4, 3)).save(path),
    "other size.png": lambda path: Image.new("I;16", (3, 4)).save(path),
    "text.png": lambda path: path.write_text("no picture"),
    "other size.npy": lambda path: np.save(path, np.zeros((4, 3))),
    "two.npy": lambda path: np.save(path, np.zeros((2, 3, 4))),
    "objects.npy": lambda path: np.save(path, np.array([[{}] * 4] * 3)),
    "texts.npy": lambda path: np.save(path, np.array([["a"] * 4] * 3)),
    "complex.npy": lambda path: np.save(path, np.zeros((3, 4), dtype=complex)),
    "cut.npy": lambda path: path.write_bytes(b"\x93NUMPY"),
    "two.npz": lambda path: np.savez(path, a=np.zeros((3, 4)), b=np.zeros((3, 4))),
    "none.npz": lambda path: zipfile.ZipFile(path, "w").close(),
    "bomb.npz": bomb,
    "text.npz": lambda path: path.write_text("no archive"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_file_that_is_no_such_map_is_an_error_that_names_it(tmp_path, name):
    UNUSABLE[name](tmp_path / name)

    with pytest.raises(PredictionError, match=name.replace(".", r"\.")) as raised:
        read_disparity(tmp_path / name, size=(3, 4), where="scene, cameras 00-01")
    assert str(raised.value).startswith("scene, cameras 00-01: ")


def test_truth_that_a_png_cannot_hold_refuses_the_pair(
    scored_index, samples, tmp_path, monkeypatch
):
    def as_png(path, found):
        stored = np.where(np.isnan(found), 0, np.round(found * 256)).astype(np.uint16)
        Image.fromarray(stored).save(path.with_suffix(".png"))

    folder = write_maps(tmp_path / "maps", samples, as_png)
    whole = evaluate_disparity(scored_index, folder, **WHOLE)
    assert not any(pair.problem for pair in whole.pairs)

    monkeypatch.setattr("stereogenbench_data.evaluation.disparity_maps.PNG_ENDS_PX", 2.0)
    with pytest.raises(PredictionError, match=r"ends at 2\.000 px.*PFM or npy"):
        evaluate_disparity(scored_index, folder, **WHOLE)
    within = DisparityProtocol(max_disparity_px=2.0)
    found = evaluate_disparity(scored_index, folder, protocol=within, **WHOLE)
    assert any(pair.tallies["beyond"].mean > 0 for pair in found.pairs)


def test_the_flow_of_raft_stereo_is_refused_with_the_cure(scored_index):
    truth = torch.full((4, 4), 8.0)
    with pytest.raises(EvaluationError, match="pass -flow"):
        DisparityError().update(-truth, truth, truth > 0)
    with pytest.raises(PredictionError, match=r"cameras 00-01: flow: .*pass -flow"):
        evaluate_disparity(
            scored_index, lambda batch: -torch.ones(batch["left"][:, :1].shape), name="flow",
            split="eval", frames="first",
        )  # fmt: skip


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (lambda batch: torch.ones(len(batch["left"]), 3, 4), "expected floats"),
        (lambda batch: torch.ones(batch["left"][:, 0].shape, dtype=torch.int32), "int32"),
        (lambda batch: [None], "not one array"),
    ],
)
def test_a_callable_that_returns_something_else_is_told_what_is_expected(
    scored_index, returned, told
):
    with pytest.raises(PredictionError, match=told):
        evaluate_disparity(scored_index, returned, split="eval", frames="first")


def test_missing_maps_are_counted_where_they_are_allowed(scored_index, samples, tmp_path):
    folder = write_maps(tmp_path / "maps", samples, np.save)
    first = samples[0]["scene"]
    (folder / first / "00-01" / "002.npy").unlink()
    with pytest.raises(PredictionError, match=r"no 002 of \.png, \.pfm, \.npy, \.npz"):
        evaluate_disparity(scored_index, folder, **WHOLE)
    found = evaluate_disparity(scored_index, folder, allow_missing=1, **WHOLE)
    assert [bool(pair.problem) for pair in found.pairs] == [
        pair.scene == first for pair in found.pairs
    ]
    assert sum(row.missing for row in disparity_tables([found])[0].rows) == 1


def test_a_stopped_run_goes_on_and_another_method_is_refused(scored_index, tmp_path):
    calls = []

    def method(batch):
        calls.append(len(batch["left"]))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return torch.ones(batch["left"][:, :1].shape)

    kept = {"split": "eval", "frames": "all", "out": tmp_path}
    with pytest.raises(EvaluationError, match="Pass name="):
        evaluate_disparity(scored_index, method, **kept)
    with pytest.raises(KeyboardInterrupt):
        evaluate_disparity(scored_index, method, name="ones", **kept)
    whole = evaluate_disparity(scored_index, method, name="ones", **kept)

    assert len(whole.pairs) == 3
    assert calls == [FRAMES] * 4  # the third scene alone came again
    with pytest.raises(EvaluationError, match="of other methods"):
        evaluate_disparity(scored_index, method, name="others", **kept)
    limited = DisparityProtocol(max_disparity_px=5)
    with pytest.raises(EvaluationError, match="scored"):
        evaluate_disparity(scored_index, method, name="ones", protocol=limited, **kept)


def test_scored_at_another_size_disparity_is_in_its_pixels(scored_index):
    halves = {"left": [], "truth": []}
    for sample in StereoPairs(
        scored_index, split="eval", fields=("left", "disparity", "valid"), size=(32, 64)
    ):
        halves["left"].append(sample["left"].numpy().tobytes())
        halves["truth"].append(sample["disparity"])

    def truth(batch):
        places = [halves["left"].index(left.numpy().tobytes()) for left in batch["left"]]
        return torch.stack([halves["truth"][place] for place in places])

    protocol = DisparityProtocol(size=(32, 64))
    found = evaluate_disparity(scored_index, truth, split="eval", frames="first", protocol=protocol)
    assert [pair.tallies["epe"].mean for pair in found.pairs] == [0.0] * 3


def test_a_validation_loop_gets_the_number_of_the_report(scored_index, samples, tmp_path):
    folder = write_maps(tmp_path / "maps", samples, np.save)
    report = evaluate_disparity(scored_index, folder, **WHOLE)
    table = {table.name: table for table in disparity_tables([report])}["regions"]
    error = DisparityError()
    for sample in samples:
        error.update(
            torch.from_numpy(guess(sample))[None, None], sample["disparity"], sample["valid"],
            sample["visible"],
        )  # fmt: skip
    found = error.compute()

    assert found["frames"] == 3 * FRAMES
    for row in table.rows:
        ending = {"all": ""}.get(row.labels[0], f"_{row.labels[0]}")
        for name in MEASURES:
            assert found[f"{name}{ending}"] == pytest.approx(row.values[name].mean)
    error.reset()
    assert math.isnan(error.compute()["epe"])
    with pytest.raises(EvaluationError, match="different shapes"):
        error.update(torch.ones(2, 3, 4), torch.ones(1, 3, 4), torch.ones(1, 3, 4) > 0)


def share_of_frames(rank, folder, maps):
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/group", rank=rank, world_size=2
    )
    error = DisparityError()
    for found, truth in maps[: 1 if rank else 2]:
        error.update(found, truth, truth > 0)
    (folder / f"{rank}.json").write_text(json.dumps(error.compute()))
    torch.distributed.destroy_process_group()


def test_ranks_with_unequal_shares_compute_one_and_the_same_mean(tmp_path):
    generator = torch.Generator().manual_seed(0)
    truth = [50 * torch.rand(4, 5, generator=generator) + 1 for _ in range(2)]
    maps = [(each + torch.rand(4, 5, generator=generator), each) for each in truth]
    multiprocessing.spawn(share_of_frames, (tmp_path, maps), nprocs=2)
    of_ranks = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    alone = DisparityError()
    for found, true in (*maps, maps[0]):
        alone.update(found, true, true > 0)

    assert repr(of_ranks[0]) == repr(of_ranks[1])
    assert of_ranks[0] == pytest.approx(alone.compute(), nan_ok=True)


def test_a_report_says_what_each_number_is_over(scored_index, samples, tmp_path):
    folder = write_maps(tmp_path / "maps", samples, np.save)
    told = succeed("eval", "disparity", scored_index.where, folder, "-o", tmp_path / "out").stdout

    assert "EPE px, answered" in told
    assert "D1, scored" in told
    written = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [table["name"] for table in written["tables"]] == [
        "branches", "bins_primary", "by_map_name", "regions", "ranges",
    ]  # fmt: skip
    assert {path.name for path in (tmp_path / "out" / "plots").iterdir()} == {
        "epe_by_baseline.png", "bad_2_by_baseline.png", "d1_by_baseline.png",
    }  # fmt: skip


def test_scores_of_disparity_and_of_right_views_share_no_table(scored_index):
    found = evaluate_disparity(
        scored_index, lambda batch: torch.ones(batch["left"][:, :1].shape), split="eval"
    )
    with pytest.raises(EvaluationError, match="disparity_tables"):
        tables_of([found])
    tables = disparity_tables([found])
    assert "nan" not in json.dumps(document([found], tables), allow_nan=False).lower().split()
    assert "right view" not in page([found], tables)


def test_middleburys_cones_are_scored_as_the_definitions_say(ground_truth):
    folder = ground_truth / "cones"
    left, right = (cv2.imread(str(folder / f"{side}.png")) for side in ("left", "right"))
    truth = np.asarray(Image.open(folder / "disp_left.tif")).astype(np.float32)
    matcher = cv2.StereoSGBM_create(0, 64, 5, P1=8 * 3 * 25, P2=32 * 3 * 25)
    found = matcher.compute(left, right).astype(np.float32) / 16
    found[found < 0] = np.nan
    valid = (truth > 0) & np.isfinite(truth)

    scores = score(found, truth, valid)

    for name, number in expected(found, truth, valid).items():
        assert scores[name] == pytest.approx(number)
    assert 0.1 < scores["invalid"] < scores["bad_2"] < 0.5
