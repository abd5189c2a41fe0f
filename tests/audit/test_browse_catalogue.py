"""What the page lists: scenes, pairs and counts as selection has them, and lines that run."""

import dataclasses

import pytest

from stereogenbench_data import SceneIndex, SelectionError
from stereogenbench_data.audit.browser.catalogue import Catalogue, parse_choice
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import BASELINE_BINS, CAMERA_PAIRS, baseline_bin
from tests.audit.browsing import run

SCENE = "train/Uniform/SynthStage/scene_000001"


@pytest.fixture(scope="module")
def index(indexed_release):
    return SceneIndex.open(indexed_release)


@pytest.fixture(scope="module")
def catalogue(index, indexed_release):
    return Catalogue(index, shown_data=str(indexed_release))


QUERIES = [
    {},
    {"family": ["Uniform", "IPD_Gaussian"], "split": ["train"]},
    {"subset": ["seen_map"], "pairs": ["primary"]},
    {"baseline_low": ["10"], "baseline_high": ["60.5"], "pairs": ["adjacent"]},
    {"bin": ["[10,30)", "(150,inf)"]},
    {"caption": ["figure  WALKS"], "focal_low": ["18"], "focal_high": ["85"]},
    {"map": ["SynthStage"], "split": ["eval"]},
]


@pytest.mark.parametrize("query", QUERIES, ids=str)
def test_the_line_of_a_choice_selects_what_the_page_counts(catalogue, query):
    choice = parse_choice(query)
    told = catalogue.summary(choice)
    pairs = run(told["line"])["pairs"]
    listed = catalogue.listed(choice, first=0, count=100)

    assert told["reason"] == ""
    assert told["pairs"] == len(pairs.plan.pairs)
    assert told["scenes"] == listed["total"] == len(pairs.plan.scene_rows)
    assert [row["key"] for row in listed["rows"]] == pairs.index.column("key")[
        pairs.plan.scene_rows
    ].tolist()


def test_the_edges_of_bins_belong_where_the_paper_puts_them(index):
    scene = index.scene(0)
    edges = (0.5, 1.0, 9.99, 10.0, 30.0, 60.0, 100.0, 149.0, 150.0, 150.1, 2.0, 3.0, 4.0, 5.0, 6.0)
    odd = dataclasses.replace(scene, rig=dataclasses.replace(scene.rig, baselines_cm=edges))
    catalogue = Catalogue(SceneIndex.from_scenes([odd], index.root), shown_data="x")

    found = [baseline_bin(cm) for cm in edges]
    counts = catalogue.summary({})["counts"]["bin"]
    assert counts == {name: found.count(name) for name in BASELINE_BINS}


def test_a_scenes_pairs_go_from_the_narrowest_to_the_widest(catalogue, index):
    scene = catalogue.scene(
        SCENE, parse_choice({"baseline_low": ["100"], "baseline_high": ["150"]})
    )
    baselines = [pair["baseline_cm"] for pair in scene["pairs"]]
    row = catalogue.row(SCENE)

    assert sorted(map(tuple, (pair["cameras"] for pair in scene["pairs"]))) == list(CAMERA_PAIRS)
    assert baselines == sorted(index.column("baselines_cm")[row].tolist())
    assert [pair["chosen"] for pair in scene["pairs"]] == [100 <= cm <= 150 for cm in baselines]
    assert sum(pair["primary"] for pair in scene["pairs"]) == 1


def test_a_long_list_comes_in_parts(index):
    scene = dataclasses.replace(index.scene(0), members={})
    folder = "train/Uniform/Town"
    ids = [parse_scene_key(f"{folder}/scene_{number:06d}") for number in range(450)]
    scenes = [dataclasses.replace(scene, id=each) for each in ids]
    catalogue = Catalogue(SceneIndex.from_scenes(scenes, index.root), shown_data="x")
    listed = catalogue.listed({}, first=400, count=10_000)

    assert (listed["total"], listed["first"], len(listed["rows"])) == (450, 400, 50)
    assert len(catalogue.listed({}, first=0, count=10_000)["rows"]) == 200
    assert catalogue.place({}, f"{folder}/scene_000321") == 321


def test_a_bin_that_is_none_leaves_nothing_and_says_why(catalogue):
    told = catalogue.summary(parse_choice({"bin": ["[1,2)"]}))

    assert (told["scenes"], told["pairs"]) == (0, 0)
    assert "no baseline bin '[1,2)'" in told["reason"]


@pytest.mark.parametrize(
    ("query", "told"),
    [
        ({"pairs": ["sweep"]}, "no choice 'sweep'"),
        ({"pairs": ["0-5"]}, "no choice '0-5'"),
        *(({"focal_low": [each]}, rf"focal must be of numbers, got \['{each}', ''\]")
          for each in ("wide", "inf", "nan")),
    ],
)  # fmt: skip
def test_what_the_page_cannot_choose_by_is_refused(query, told):
    with pytest.raises(SelectionError, match=told):
        parse_choice(query)
