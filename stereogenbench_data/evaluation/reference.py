"""The paper's reference tables as data, to be printed beside a user's own rows.

Each table is a CSV file in ``reference_tables``. Numbers are kept as printed, since the last digit
of a reference is part of it. An empty cell is a dash of the paper.
"""

import csv
from collections import Counter
from collections.abc import Collection, Mapping
from functools import cache
from importlib.resources import files
from typing import Final, Literal

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import TRAIN_MAPS, UNSEEN_MAPS

TableName = Literal["main", "unseen", "bins", "controls"]
ReferenceRow = Mapping[str, str]


SOURCES: Final[dict[str, str]] = {
    "main": "tab:main-results, reference results on the seen-map evaluation split",
    "unseen": "tab:app-unseen-results, unseen-map evaluation",
    "bins": "tab:app-baseline-bins, baseline-stratified diagnostics of the seen-map Uniform branch",
    "controls": "tab:metric-calibration, calibration controls on the full evaluation split",
}
"""Where each table stands in the paper: its LaTeX label and what it is."""

SCENES_SCORED: Final[Mapping[tuple[str, str], int]] = {
    ("seen_map", "IPD_Gaussian"): 265,
    ("seen_map", "Uniform"): 281,
    ("unseen_map", "IPD_Gaussian"): 91,
    ("unseen_map", "Uniform"): 102,
}
"""How many scenes the paper's numbers are of, by subset and family."""

PAPER: Final = (
    "StereoGenBench: A Synthetic Multi-Camera Benchmark for Stereo Generation under Controlled "
    "Baseline Regimes"
)

DISCREPANCIES: Final[dict[str, str]] = {
    "copied-left E_match": (
        "tab:metric-calibration prints an E_match of 0.00 for the copied left. By the paper's own "
        "formula it is 100 (1 - |M_gt| / |M_pred|), since every keypoint of the left matches "
        "itself; that is 0 only if every keypoint is also matched in the rendered pair. This "
        "package computes the formula, and gives more than 0."
    ),
    "copied-left and wrong-baseline rows": (
        "In tab:metric-calibration the two rows agree in PSNR (19.07, 19.08), SSIM (0.6530, "
        "0.6531) and LPIPS (0.1804, 0.1806) although their pictures differ. The gaps between "
        "cameras are drawn independently, so near equality is possible; it is not explained."
    ),
    "bins and branches": (
        "The bins of tab:app-baseline-bins, weighted by their scenes, give the Uniform rows of "
        "tab:main-results to about 0.3 %, SD of G0 methods to 1.2 % (StereoDiffusion 0.2189 "
        "against 0.2163), but not to the printed digits, though both are said to cover the same "
        "281 scenes."
    ),
    "baselines of 1 to 150 cm": (
        "tab:related-datasets gives baselines of 1 to 150 cm; that holds for adjacent cameras. All "
        "pairs of a Uniform rig reach 750 cm, and of a Pairwise_Uniform rig 200 cm."
    ),
    "frames of StereoCrafter-Zero": (
        "tab:app-baseline-bins counts 16 frames a scene for StereoCrafter-Zero and 81 for all "
        "others."
    ),
    "size of FVD's samples": (
        "FVD is computed over 265 and 281 seen-map scenes, and 91 and 102 unseen-map ones. That is "
        "fewer than I3D's 400 logits, if they are its features: the distance is then biased "
        "upwards, the more the fewer scenes there are. Part of the gap between seen and unseen "
        "maps can be that alone."
    ),
}
"""Where the paper's tables disagree with each other or with its formulas, by what it is about."""


@cache
def reference_table(name: TableName) -> tuple[ReferenceRow, ...]:
    """Return the rows of one of the paper's tables, by column, as printed.

    Args:
        name: "main" (seen maps), "unseen", "bins" (baseline bins of seen-map Uniform) or
            "controls".

    Raises:
        EvaluationError: If there is no such table.

    >>> reference_table("controls")[0]["psnr"]
    'inf'
    """
    if name not in SOURCES:
        raise EvaluationError(f"there is no table {name!r}: there are {', '.join(SOURCES)}.")
    text = files(__package__).joinpath("reference_tables", f"{name}.csv").read_text("utf-8")
    return tuple(csv.DictReader(text.splitlines()))


def reference_rows(name: TableName, **where: str) -> list[ReferenceRow]:
    """Return the rows of a table whose columns have the given values.

    Raises:
        EvaluationError: If there is no such table or column.

    >>> [row["psnr"] for row in reference_rows("main", tier="G1", family="Uniform")]
    ['19.71']
    """
    rows = reference_table(name)
    unknown = set(where) - set(rows[0])
    if unknown:
        raise EvaluationError(
            f"table {name!r} has no column {min(unknown)!r}: it has {', '.join(rows[0])}."
        )
    return [row for row in rows if all(row[column] == value for column, value in where.items())]


def release_difference(index: SceneIndex, rows: Collection[int], *, scored: str = "some") -> str:
    """Return how scored scenes differ from those that the paper scored, empty if they do not.

    By their maps, subsets and numbers: what the index tells.

    Args:
        index: The scenes.
        rows: Which of them were scored.
        scored: "some" of the branches of subset and family, or "all" of them.
    """
    chosen = sorted(set(rows))
    names = Counter(index.column("map_name")[chosen].tolist())
    others = sorted(set(names) - TRAIN_MAPS - UNSEEN_MAPS)
    if others:
        count, named = sum(names[name] for name in others), ", ".join(others[:3])
        return f"{count} of {len(chosen)} scenes on maps that the release does not have ({named})"
    branches = Counter(
        zip(
            index.column("subset")[chosen].tolist(),
            index.column("family")[chosen].tolist(),
            strict=True,
        )
    )
    for branch in {**branches, **(SCENES_SCORED if scored == "all" else {})}:
        found, expected = branches[branch], SCENES_SCORED.get(branch, 0)
        if found != expected:
            name = " ".join(filter(None, branch))
            return f"{found} scenes of {name}, of which the paper scored {expected or 'none'}"
    return ""
