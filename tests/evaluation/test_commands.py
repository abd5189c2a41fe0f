"""The commands that score, run as a user runs them."""

import json

import pytest

from tests.cli.command import refused, succeed

SMALL = ("--metrics", "psnr,ssim", "--size", "64x48", "--workers", "1")


@pytest.fixture
def scenes(scored_index):
    return scored_index.root


def test_predictions_are_scored_and_reported(scenes, other_views, tmp_path):
    out = tmp_path / "report"
    shown = succeed(
        "eval", "score", scenes, other_views, "--tier", "G1", "--where", "subset=seen_map",
        "--name", "next camera", "--by", "map_name", "--out", out, *SMALL,
    )  # fmt: skip

    assert "# next camera, tier G1: calibrated target camera" in shown.stdout
    assert "By map_name" in shown.stdout
    assert {path.name for path in out.iterdir()} == {
        "results.json", "report.md", "tables.tex", "pairs.csv", "plots", "partial",
    }  # fmt: skip
    assert {path.name for path in (out / "plots").iterdir()} == {
        "psnr_by_baseline.png", "ssim_by_baseline.png",
    }  # fmt: skip


def test_json_is_one_document_alone_on_stdout(scenes, right_views, tmp_path):
    shown = succeed(
        "eval", "score", scenes, right_views, "--tier", "G2", "--json",
        "--out", tmp_path, *SMALL,
    )  # fmt: skip
    told = json.loads(shown.stdout)

    assert told["tier"] == "G2"
    assert told["coverage"][0]["pairs"] == 3
    assert told["settings"]["size"] == "64x48"


def test_an_evaluation_that_scored_nothing_does_not_hinder_another_one(
    scenes, right_views, tmp_path
):
    (tmp_path / "none").mkdir()
    out = ("--name", "views", "--tier", "G0", "--out", tmp_path / "out")
    failed = refused("eval", "score", scenes, tmp_path / "none", *out, *SMALL)
    succeed("eval", "score", scenes, right_views, *out, "--metrics", "psnr", *SMALL[2:])

    assert "3 predictions missing or unusable, and 0 allowed" in failed


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--by", "nope", "has no column 'nope'"),
        ("--metrics", "mse", "there is no metric 'mse'"),
        ("--stereo-matcher", "eyes", "'eyes'"),
        ("--tier", "G9", "there is no tier 'G9': choose one of G0 (oracle geometry"),
    ],
)
def test_an_option_that_is_off_is_reported(scenes, right_views, tmp_path, option, value, message):
    scoring = ("eval", "score", scenes, right_views, "--tier", "G0", "--out", tmp_path)

    assert message in refused(*scoring, option, value)


def test_inputs_are_exported(scenes, tmp_path):
    shown = succeed("eval", "inputs", scenes, tmp_path / "in", "--tier", "G2", "--size", "64x48",
                    "--frames", "0,2", "--workers", "1")  # fmt: skip

    assert "3 items of tier G2" in shown.stdout
    assert len(list((tmp_path / "in").glob("*/left/*.png"))) == 6


def test_controls_are_scored_by_name(scenes, tmp_path):
    shown = succeed("eval", "controls", scenes, "--frames", "first", "--out", tmp_path, *SMALL)

    assert "| rendered target | " in shown.stdout
