"""Statistics of an index, against numbers worked out by hand and against the paper's."""

import dataclasses
import json
import statistics as plain_statistics

import pytest

from stereogenbench_data import SceneIndex
from stereogenbench_data.audit.statistics import compared, statistics, statistics_markdown
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import CAMERA_PAIRS
from tests.audit.release_counts import paper_scenes
from tests.cli.command import succeed

PLACES_CM = (0.0, 10.0, 25.0, 31.0, 61.0, 211.0)


@pytest.fixture(scope="module")
def release(indexed_release, tmp_path_factory):
    """The index of 8,493 scenes that are spread as the paper says."""
    scenes = paper_scenes(SceneIndex.open(indexed_release).scene(0))
    return SceneIndex.from_scenes(scenes, tmp_path_factory.mktemp("release"))


@pytest.fixture(scope="module")
def written_release(release):
    """The same as a file."""
    path = f"{release.root}/index.parquet"
    release.write(path)
    return path


@pytest.fixture
def three(indexed_release):
    """Three scenes: one whose cameras stand at `PLACES_CM`, two like it twice as far apart."""
    scene = SceneIndex.open(indexed_release).scene(0)

    def placed(number, factor, focal_mm):
        baselines = tuple(factor * (PLACES_CM[b] - PLACES_CM[a]) for a, b in CAMERA_PAIRS)
        key = f"train/Uniform/Car_Dealer/scene_{number:06d}"
        return dataclasses.replace(
            scene,
            id=parse_scene_key(key),
            rig=dataclasses.replace(scene.rig, baselines_cm=baselines, focal_mm=focal_mm,
                                    primary_pair=(1, 2)),
        )  # fmt: skip

    return SceneIndex.from_scenes(
        [placed(0, 1.0, 20.0), placed(1, 2.0, 85.0), placed(2, 2.0, 90.0)], indexed_release
    )


def test_baselines_bins_and_focal_lengths_of_three_scenes(three):
    found = statistics(three)

    (family,) = found.families
    gaps = [10.0, 15.0, 6.0, 30.0, 150.0]
    adjacent = [*gaps, *(2 * gap for gap in gaps), *(2 * gap for gap in gaps)]
    of = (family.split, family.subset, family.family, family.scenes, family.maps)
    assert of == ("train", "", "Uniform", 3, {"Car_Dealer": 3})
    assert family.adjacent_cm == {
        "count": 15, "min": 6.0, "max": 300.0,
        "mean": pytest.approx(plain_statistics.mean(adjacent)),
        "std": pytest.approx(plain_statistics.pstdev(adjacent)),
        "median": plain_statistics.median(adjacent),
    }  # fmt: skip
    assert family.all_pairs_cm["max"] == 422.0
    # Primary 1-2: 15, 30, 30 cm. Of the adjacent ones 150 cm is the last value of its bin.
    primary_and_adjacent = {name: counts[:2] for name, counts in family.bins.items()}
    assert primary_and_adjacent == {
        "[1,10)": (0, 1), "[10,30)": (1, 2 + 4), "[30,60)": (2, 1 + 2), "[60,100)": (0, 2),
        "[100,150]": (0, 1), "(150,inf)": (0, 2),
    }  # fmt: skip
    assert sum(every for _, _, every in family.bins.values()) == 45
    assert [family.focal_mm[name] for name in ("min", "median", "max")] == [20, 85, 90]


def test_a_map_of_train_in_a_scene_of_unseen_map_is_a_finding(three):
    scenes = [three.scene(row) for row in range(3)]
    place = parse_scene_key("eval/MapUnseenInTrain/Uniform/Car_Dealer/s_3")
    index = SceneIndex.from_scenes([*scenes[:2], dataclasses.replace(scenes[2], id=place)], "x")

    (finding,) = statistics(index).findings

    assert finding.startswith("Car_Dealer is a map of train, and 1 scene of unseen_map has it")
    assert finding in statistics_markdown(statistics(index)).replace("\\", "")
    assert index.seen_maps_called_unseen() == {place.key: "Car_Dealer"}
    assert statistics(three).findings == ()


def test_filters_choose_what_is_counted(three):
    assert statistics(three, focal_mm=(15, 30)).scenes == 1
    with pytest.raises(SelectionError, match="split eval matches none of 3 scenes"):
        statistics(three, split="eval")


def test_an_index_with_the_papers_figures_agrees_with_all_of_its_tables(release):
    lines = compared(statistics(release))

    assert [line.item for line in lines if not line.agrees] == []
    assert len(lines) == 130
    assert len({line.table for line in lines}) == 6


def test_one_scene_less_is_seen_in_every_figure_that_it_moves(release):
    keys = release.column("key").tolist()
    last = max(key for key in keys if "/Scene_Saloon/" in key)

    found = statistics(release, scenes=[key for key in keys if key != last])
    lines = compared(found)
    markdown = statistics_markdown(found, lines)

    items = {line.item: line for line in lines if not line.agrees}
    assert items["scenes, train IPD_Gaussian Scene_Saloon"].ours == "11"
    assert items["scenes, train IPD_Gaussian"].ours == "3288"
    assert items["adjacent, train IPD_Gaussian: count"].ours == "16440"
    assert not any("eval" in item for item in items)
    assert f"## Against the paper: {130 - len(items)} of 130 figures agree" in markdown
    assert markdown.rindex("| **differs** | ") < markdown.index("| same | ")


def test_the_command_compares_a_release_by_itself(written_release):
    result = succeed("stats", written_release)
    evaluated = succeed("stats", written_release, "--split", "eval", "--json")

    row = "| train | Uniform | 3,870 | 1.0113 | 149.8906 | 52.7908 | 38.9500 | 43.2916 |"
    assert row in result.stdout
    assert "## Against the paper: 130 of 130 figures agree" in result.stdout
    assert "| same | scenes, train Uniform | 774 | 774 |" in result.stdout
    compared = json.loads(evaluated.stdout)["paper"]
    assert len(compared) > 40
    assert all(line["agrees"] and "train" not in line["item"] for line in compared)


def test_the_command_writes_other_data_without_the_papers_figures(small_shards, tmp_path):
    told = succeed(
        "stats", small_shards, "--split", "train", "--json", "-o", tmp_path / "out" / "stats.json"
    )
    shown = succeed("stats", small_shards, "-o", tmp_path / "out" / "stats.md")

    assert "| train | - | Uniform | 2 |" in shown.stdout
    assert "Against the paper" not in shown.stdout
    document = json.loads(told.stdout)
    assert document == json.loads((tmp_path / "out" / "stats.json").read_text())
    assert document["scenes"] == 3
    assert document["paper"] == []
    assert (tmp_path / "out" / "stats.md").read_text().startswith("# Statistics of ")
