"""Scores: averages, intervals by hand, tables in order, no nan."""

import csv
import io
import json
import math
from dataclasses import replace

import pytest

from stereogenbench_data import EvaluationError, EvaluationProtocol, tables_of, write_report
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance
from stereogenbench_data.evaluation.report import document, latex, markdown
from stereogenbench_data.evaluation.tables import (
    PairMeans,
    Scores,
    cell,
    strata,
    table_of,
    tallies,
    tally,
)

PAPERS = EvaluationProtocol()
INF, NAN = float("inf"), float("nan")
BASELINES_CM = (5.0, 20.0, 150.0, 12.0)


@pytest.fixture
def scores(scored_index):
    """Made-up scores of the three scenes' primary pairs, and of one wide pair."""

    def made(name="ours", *, tier="G0", protocol=PAPERS, psnr=((30, 32), (20, 24), (10, 12))):
        pairs = []
        for row, frames in enumerate((*psnr, (8, 8))):
            scene = scored_index.scene(min(row, 2))
            columns = {
                "psnr": frames,
                "ssim": (0.5, 0.75),
                "e_match": (1, NAN),
                "sd_filtered": (0.25, 0.75),
                "sd_least_squares": (0.5, 1.5),
            }
            pairs.append(
                PairMeans(
                    row=min(row, 2), scene=scene.id.key, pair=(0, 1) if row < 3 else (0, 5),
                    is_primary=row < 3, baseline_cm=BASELINES_CM[row], frames=2,
                    tallies={key: tally(values) for key, values in columns.items()},
                )
            )  # fmt: skip
        return Scores(name, tier, protocol, {"size": "832x480"}, scored_index, tuple(pairs))

    return made


def rows(table):
    return [(row.method, *row.labels) for row in table.rows]


def test_a_row_averages_the_scenes_of_its_branch(scores):
    table = table_of([scores(tier="G1")], "branches")

    assert rows(table) == [("ours", "seen_map", "Uniform"), ("ours", "unseen_map", "IPD_Gaussian")]
    assert table.rows[0].values["psnr"].mean == (31 + 22) / 2
    assert (table.rows[0].scenes, table.rows[0].frames) == (2, 4)


def test_bins_are_in_order(scores):
    table = table_of([scores(tier="G1")], "bins_primary")

    assert rows(table) == [
        ("ours", "seen_map", "Uniform", "[1,10)"),
        ("ours", "seen_map", "Uniform", "[10,30)"),
        ("ours", "unseen_map", "IPD_Gaussian", "[100,150]"),
    ]


def test_a_column_of_the_index_makes_strata(scores, scored_index):
    by_map, by_focal = tables_of([scores()], by=["map_name", "focal_mm"])[3:5]
    focals_mm = {f"{scored_index.scene(row).rig.focal_mm:g}" for row in range(3)}

    assert [row.labels[2] for row in by_map.rows] == ["SynthStage", "SynthYard"]
    assert {row.labels[2] for row in by_focal.rows} == focals_mm
    with pytest.raises(EvaluationError, match="baselines_cm has 15 values a scene"):
        tables_of([scores()], by=["baselines_cm"])


def test_methods_of_one_tier_share_a_table_and_those_of_two_do_not(scores):
    both = table_of([scores("one"), scores("two")], "branches")

    assert [row.method for row in both.rows] == ["one", "two"] * 2
    with pytest.raises(EvaluationError, match=r"their tier differs \(G0 and G2\)"):
        tables_of([scores("one"), scores("two", tier="G2")])
    for change in ({"size": (240, 416)}, {"metrics": ("psnr",)}):
        other = EvaluationProtocol(**change)
        with pytest.raises(EvaluationError, match="their protocol differs"):
            tables_of([scores("one"), scores("two", protocol=other)])


def test_columns_name_the_matchers_that_they_were_measured_with(scores):
    text = markdown(table_of([scores(protocol=EvaluationProtocol(size=(240, 416)))], "branches"))
    mine = EvaluationProtocol(
        keypoint_matcher="mine.py:DeDoDe", stereo_matcher="mine.py:FoundationStereo"
    )

    assert "0.5000 ± 0.0000 [0.5000]" in text
    assert "1.0000 ± 0.0000 [1.0000]" in text
    assert "E_match (sift)↓" in text
    assert "SD filtered (sgbm)↓" in text
    assert "SD least squares (sgbm)↓" in text
    assert "| E_match (DeDoDe)↓ |" in markdown(table_of([scores(protocol=mine)], "branches"))


def test_identical_and_undefined_frames_are_counted_in_the_cell(scores):
    text = markdown(table_of([scores(psnr=((INF, INF), (INF, INF), (10, INF)))], "branches"))

    assert "∞ (4 identical)" in text
    assert "10.00 (1 identical)" in text
    assert "(2 undefined)" in text


def test_a_line_that_explains_hardly_anything_marks_its_number_in_every_table_and_text(scores):
    one = scores()
    columns = {
        "sd_filtered": (17.0, 7220.0, 0.1), "sd_filtered_r2": (0.004, NAN, 0.9),
        "sd_least_squares": (0.2, 0.3, 0.4), "sd_least_squares_r2": (0.1, 0.8, 0.9),
        "sd_beyond": (0.0, 0.5, 0.1),
    }  # fmt: skip
    loose = replace(one, pairs=(replace(one.pairs[0], frames=3, tallies=tallies(columns)),))
    table = table_of([loose], "branches")
    text = markdown(table)

    assert tallies(columns)["sd_filtered"].loose == 2
    assert "| 2412.3667 [2412.3667] (2 with R2 below 0.1, 20.0% beyond range) |" in text
    assert "| 0.3000 [0.3000] (20.0% beyond range) |" in text
    assert "R2 below" not in markdown(table_of([one], "branches"))


def test_p_psnr_above_the_targets_is_told_beside_the_number(scores):
    one = scores(protocol=EvaluationProtocol(metrics=("p_psnr",)))

    def text(own_db, target_db):
        columns = {"p_psnr": [own_db], "p_psnr_ceiling": [target_db]}
        pair = replace(one.pairs[0], tallies=tallies(columns))
        return markdown(table_of([replace(one, pairs=(pair,))], "branches"))

    assert "| 45.57 (above the target's 23.13, so not better) |" in text(45.57, 23.126)
    for known in (text(23.126, 23.126), text(20.0, 23.126), text(NAN, NAN)):
        assert "above" not in known


def test_a_gap_is_a_column_of_the_table(scores):
    whole = scores()
    gap = PairMeans(
        row=1, scene=whole.pairs[1].scene, pair=(0, 1), is_primary=True, baseline_cm=20.0,
        frames=2, tallies={}, problem="has no prediction",
    )  # fmt: skip
    holed = Scores("ours", "G0", PAPERS, {}, whole.index, (whole.pairs[0], gap, *whole.pairs[2:]))
    table = table_of([holed], "branches")

    assert "| missing |" in markdown(table)
    assert (table.rows[0].missing, table.rows[0].scenes) == (1, 1)
    assert "missing" not in markdown(table_of([whole], "branches")).partition("\n\n")[2]


def test_a_distance_says_its_sample_and_its_dimension(scores):
    distance = FrechetDistance(value=12.5, samples=(6, 6), dim=66, underdetermined=True)
    protocol = EvaluationProtocol(metrics=("psnr", "fid"))
    one = scores(protocol=protocol)
    told = Scores(
        "ours", "G0", protocol, {}, one.index, one.pairs,
        {("seen_map", "Uniform"): {"fid": distance}},
    )  # fmt: skip
    text = markdown(table_of([told], "branches"))

    assert "FID↓" in text
    assert "12.50 (N 6 ≤ D 66: biased upwards)" in text


def test_no_output_holds_nan_and_json_reads_back(scores, tmp_path):
    results = [scores(psnr=((INF, INF), (20, 24), (NAN, NAN)))]
    made = tables_of(results, by=["focal_mm"])
    files = write_report(tmp_path, results, made)
    told = json.loads(
        (tmp_path / "results.json").read_text(), parse_constant=lambda text: pytest.fail(text)
    )

    texts = ["results.json", "report.md", "tables.tex", "pairs.csv"]
    assert [path.name for path in files[: len(texts)]] == texts
    assert told == document(results, made)
    for path in files[: len(texts)]:
        assert "nan" not in path.read_text().replace("nan (", "").lower().split(), path
    assert told["tables"][0]["rows"][0]["values"]["psnr"]["infinite"] == 2
    pairs = list(csv.DictReader(io.StringIO((tmp_path / "pairs.csv").read_text())))
    assert [line["psnr"] for line in pairs] == ["inf", "22.0", "", "8.0"]


def test_latex_has_its_signs_escaped_and_its_columns_counted(scores):
    text = latex(table_of([scores("[50 % & more_{x} < y|")], "branches"))
    rows_of_text = [line for line in text.splitlines() if r"\\" in line]

    assert r"{[}50 \% \& more\_\{x\} $<$ y$|$" in text
    assert r"$\pm$" in text
    assert len({line.replace(r"\&", "").count("&") for line in rows_of_text}) == 1
    assert text.count(r"\begin{") == text.count(r"\end{") == 2
    assert r"\caption{Evaluation branches, primary pairs (tier G0).}" in text


def pair(scene, numbers, *, cameras=(0, 1)):
    return PairMeans(
        row=0, scene=scene, pair=cameras, is_primary=cameras == (0, 1), baseline_cm=6.0,
        frames=len(numbers), tallies={"psnr": tally(numbers)},
    )  # fmt: skip


def test_frames_are_averaged_before_pairs_and_these_before_scenes():
    pairs = [pair("a", [0, 20]), pair("a", [30], cameras=(0, 2)), pair("b", [50])]

    found = cell(pairs, "psnr")

    assert found.mean == 35
    assert found.scenes == 2


def test_identical_frames_and_those_without_a_score_are_counted_and_not_averaged():
    same = cell([pair("a", [10, INF]), pair("b", [INF, INF])], "psnr")
    none = cell([pair("a", [10, NAN]), pair("b", [NAN]), pair("c", [20])], "psnr")

    assert (same.mean, same.infinite, same.scenes, same.ci95) == (10, 3, 1, None)
    assert (none.mean, none.undefined, none.scenes) == (15, 2, 2)


def test_the_interval_of_three_scenes_is_the_hand_worked_one():
    found = cell([pair("a", [1]), pair("b", [2]), pair("c", [3])], "psnr")

    # t of 0.975 with 2 degrees of freedom is 4.302653, s is 1.
    assert found.ci95 == pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)
    assert found.median == 2


def test_texts_and_few_numbers_are_strata_themselves():
    assert strata(["Town", "", "Egypt"], name="map_name") == ["Town", "not recorded", "Egypt"]
    assert strata([24, 50.5, 24], name="focal_mm") == ["24", "50.5", "24"]


def test_many_numbers_fall_into_quarters():
    found = strata([float(number) for number in range(101)], name="focal_mm")

    assert {each: found.count(each) for each in dict.fromkeys(found)} == {
        "[0,25)": 25, "[25,50)": 25, "[50,75)": 25, "[75,100]": 26,
    }  # fmt: skip


def test_a_column_that_is_not_known_is_refused():
    with pytest.raises(EvaluationError, match="valid_depth_ratio is not known for any scene"):
        strata([math.nan, math.nan], name="valid_depth_ratio")
