"""The paper's own figures as it prints them, since the last digit of a figure is part of it.

Each table is a CSV file in ``paper_tables``, in which an empty cell stands for a dash.

Source: "StereoGenBench: A Synthetic Multi-Camera Benchmark for Stereo Generation under Controlled
Baseline Regimes".

The paper does not contradict itself in them, but for what its words leave open:

- its first table says that baselines are of 1-150 cm, which holds for adjacent cameras only:
  pairs of a Pairwise_Uniform rig reach 200 cm, and those of a Uniform rig may reach 750 cm;
- Pairwise_Uniform is meant for pairs of 10-200 cm, and 150 of its baselines are shorter;
- whether standard deviations divide by n or by n - 1 is not stated; ours divide by n, as those of
  the dataset's viewer do.
"""

import csv
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Final, Literal

PaperTable = Literal["bins", "adjacent", "all_pairs", "train_maps", "eval_maps"]
PaperRow = Mapping[str, str]

AUDIT: Final = {
    "intrinsics": "0 px",
    "baseline": "6.68e-12 cm",
    "valid_depth": "94.59 %",
    "reprojection": "1.20e-06 px / 4.39e-03 px",
}
"""Its table of the geometry consistency audit: maximum deviation of fx, fy; maximum deviation of
pose-derived baselines; mean valid-depth ratio; median and 95th percentile of the reprojection error
of non-occluded pixels, of the primary pair and of cameras 0 and 5."""


@cache
def paper_table(name: PaperTable) -> tuple[PaperRow, ...]:
    """Return the rows of one of the paper's tables, by column, as printed.

    Args:
        name: "bins" (baseline bins of seen-map Uniform), "adjacent" and "all_pairs" (baselines in
            cm; medians are from the appendix), "train_maps" and "eval_maps" (scenes).

    >>> paper_table("bins")[0]["n_scenes"]
    '52'
    """
    text = files(__package__).joinpath("paper_tables", f"{name}.csv").read_text("utf-8")
    return tuple(csv.DictReader(text.splitlines()))
