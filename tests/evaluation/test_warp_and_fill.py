"""The shipped example: right in its filling, and worse the wider the baseline."""

import runpy
from pathlib import Path

import torch

from stereogenbench_data import EvaluationProtocol, evaluate, tables_of

ROOT = Path(__file__).resolve().parents[2]


warp_and_fill = runpy.run_path(str(ROOT / "examples" / "warp_and_fill.py"))["warp_and_fill"]


def test_holes_take_the_next_pixel_to_the_right_else_to_the_left():
    row = torch.tensor([0, 5, 0, 0, 7, 0], dtype=torch.uint8)
    inputs = {
        "warped_right": row.expand(1, 3, 1, 6).clone(),
        "hole": (row == 0).expand(1, 1, 1, 6).clone(),
    }

    assert warp_and_fill(inputs)[0, :, 0].tolist() == [[5, 5, 7, 7, 7, 7]] * 3


def test_scores_fall_from_bin_to_bin_of_baseline():
    scores = evaluate(
        ROOT / "shards", warp_and_fill, tier="G0", split="eval", family="Uniform", pairs="all",
        frames=[0, 40], protocol=EvaluationProtocol(metrics=("psnr", "ssim"), size=(72, 72)),
    )  # fmt: skip
    table = next(table for table in tables_of([scores]) if table.name == "bins_all")
    for subset, bins in (("seen_map", 5), ("unseen_map", 5)):
        for column in ("psnr", "ssim"):
            means = [row.values[column].mean for row in table.rows if row.labels[0] == subset]

            assert len(means) == bins
            assert means == sorted(means, reverse=True), (subset, column)
