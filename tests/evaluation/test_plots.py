"""Plots: one of each metric that has numbers, of one tier alone."""

import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from stereogenbench_data import EvaluationError, EvaluationProtocol, score_controls
from stereogenbench_data.evaluation import plots
from stereogenbench_data.evaluation.aggregate import tally
from stereogenbench_data.evaluation.columns import Column
from stereogenbench_data.evaluation.plots import write_plots
from tests.evaluation.conftest import SIZE, scored


@pytest.fixture(scope="module")
def results(scored_index):
    protocol = EvaluationProtocol(metrics=("psnr", "ssim", "p_psnr"), size=SIZE)
    return score_controls(scored_index, protocol=protocol, frames="first", pairs="all", workers=1)


def test_each_headline_metric_with_numbers_has_a_plot(results, tmp_path):
    files = write_plots(tmp_path, results)

    assert [path.name for path in files] == [
        "psnr_by_baseline.png", "ssim_by_baseline.png", "p_psnr_by_baseline.png",
    ]  # fmt: skip
    for path in files:
        pixels = np.asarray(Image.open(path).convert("RGB"))

        assert pixels.shape[1] > pixels.shape[0] > 300
        assert (pixels != 255).any(axis=2).mean() > 0.01


def test_a_plot_of_other_scenes_than_the_papers_says_so(results):
    axes = Figure().add_subplot()
    plots._draw(axes, results, "psnr")

    (said,) = [each.get_text() for each in axes.texts]
    assert "3 of 3 scenes on maps that the release does not have" in said
    assert "not comparable" in said


def test_a_metric_without_a_finite_number_has_no_plot(results, tmp_path):
    files = write_plots(tmp_path, results[:1])

    assert "psnr_by_baseline.png" not in [path.name for path in files]


def test_the_papers_sd_is_drawn_beside_the_filtered_fit_alone(results, tmp_path, monkeypatch):
    protocol = EvaluationProtocol(
        metrics=("sd",), size=SIZE, stereo_matcher="mine.py:FoundationStereo"
    )
    with_sd = [
        replace(
            one,
            protocol=protocol,
            pairs=tuple(
                replace(
                    pair,
                    tallies={"sd_filtered": tally([0.2]), "sd_least_squares": tally([0.4])},
                )
                for pair in one.pairs
            ),
        )
        for one in results
    ]
    asked = []
    monkeypatch.setattr(plots, "reference_rows", lambda table, tier: asked.append(table) or [])
    files = write_plots(tmp_path, with_sd)

    assert [path.name for path in files] == [
        "sd_filtered_by_baseline.png", "sd_least_squares_by_baseline.png",
    ]  # fmt: skip
    assert asked == ["bins"]


def test_a_metric_that_the_paper_does_not_report_is_drawn_alone(results, tmp_path, monkeypatch):
    column = Column("MAE", "lower", 2, "grey levels; mean absolute difference")
    monkeypatch.setitem(plots.COLUMNS, "mae", column)
    monkeypatch.setitem(plots.FRAME_METRICS, "mae", ("mae",))
    with_mae = [
        replace(
            one, pairs=tuple(replace(pair, tallies={"mae": tally([3.0])}) for pair in one.pairs)
        )
        for one in results
    ]

    files = write_plots(tmp_path, with_mae)

    assert [path.name for path in files] == ["mae_by_baseline.png"]


def test_methods_of_two_tiers_are_not_drawn_together(scored_index, tmp_path, protocol):
    both = [
        scored(scored_index, lambda inputs: inputs["left"], protocol, tier=tier, frames=[0])
        for tier in ("G1", "G2")
    ]

    assert not math.isnan(both[0].pairs[0].tallies["psnr"].mean)
    with pytest.raises(EvaluationError, match=r"cannot share a table: their tier differs"):
        write_plots(tmp_path, both)
