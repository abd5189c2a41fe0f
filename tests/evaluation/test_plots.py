"""Plots: one of each metric that has numbers, of one tier alone."""

import numpy as np
import pytest
from PIL import Image

from stereogenbench_data import EvaluationProtocol, score_controls
from stereogenbench_data.evaluation.report import write_plots
from tests.evaluation.conftest import SIZE


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


def test_a_metric_without_a_finite_number_has_no_plot(results, tmp_path):
    files = write_plots(tmp_path, results[:1])

    assert "psnr_by_baseline.png" not in [path.name for path in files]
