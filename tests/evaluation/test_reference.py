"""The paper's tables as data: cells read off the paper, sums that it states, its discrepancies."""

import re

import pytest

from stereogenbench_data.audit.paper_numbers import paper_table
from stereogenbench_data.schema.release import BASELINE_BINS
from tests.conftest import SHARED


def reference_rows(table, **where):
    rows = paper_table(table)
    return [row for row in rows if all(row[key] == value for key, value in where.items())]


@pytest.mark.parametrize(
    ("table", "where", "column", "printed"),
    [
        ("bins", {"method": "SVG", "baseline": "[60,100)"}, "sd_ci95", "0.0942"),
        ("bins", {"method": "ZeroStereo", "baseline": "[1,10)"}, "psnr", "35.50"),
    ],
)
def test_a_cell_is_as_printed(table, where, column, printed):
    (row,) = reference_rows(table, **where)

    assert row[column] == printed


def test_the_bins_of_every_method_cover_the_281_scenes():
    for method in {row["method"] for row in paper_table("bins")}:
        rows = reference_rows("bins", method=method)

        assert [int(row["n_scenes"]) for row in rows] == [52, 65, 70, 55, 39]
        assert [row["baseline"] for row in rows] == list(BASELINE_BINS)[1:6]


def printed(label):
    """Return the source of one of the paper's tables."""
    paper = SHARED / "paper" / "stereogenbench.tex"
    if not paper.is_file():
        pytest.skip("needs the paper's source, which stands beside the project")
    return paper.read_text().partition(f"\\label{{{label}}}")[2].partition(r"\end{tabular}")[0]


def test_every_number_of_the_bins_stands_in_the_paper():
    there = re.findall(r"\d+\.\d+", printed("tab:app-baseline-bins"))
    cells = (value for row in paper_table("bins") for value in row.values())
    ours = [value for value in cells if re.fullmatch(r"\d+\.\d+", value)]

    assert sorted(there) == sorted(ours) != []


@pytest.mark.parametrize(
    ("table", "label"),
    [
        ("train_maps", "tab:app-map-counts-train"),
        ("eval_maps", "tab:app-map-counts-eval"),
        ("adjacent", "tab:baseline-stats"),
    ],
)
def test_every_row_of_the_release_stands_in_the_paper(table, label):
    lines = printed(label).replace("---", "0").replace("-map", "_map").splitlines()
    plain = [re.sub(r"\\texttt|[\\{},]", "", line) for line in lines if "&" in line]
    there = [tuple(cell.strip() for cell in line.split("&")) for line in plain]
    ours = [tuple(row[name] for name in row if name != "median") for row in paper_table(table)]

    # Beside them stand the head and, of maps, the sum.
    assert [row for row in there if row in ours] == ours
    assert len(there) - len(ours) == 2 - (table == "adjacent")
