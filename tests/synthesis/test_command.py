import re

import pytest

from tests.cli.command import invoke, one_line

SMALL = ("--size", "32", "--frames", "1", "--workers", "1")


def test_the_command_plans_then_writes_scenes_and_says_where(tmp_path):
    options = ["--family", "Uniform", "--scenes", "2", "--map", "all"]
    planned = invoke("synth", tmp_path, *SMALL, *options, "--plan-only")
    assert "all maps" in planned.stdout
    assert not list(tmp_path.iterdir())

    result = invoke("synth", tmp_path, *SMALL, *options, "--part", "1/2", "--depth-unit-m", "0.1")

    assert result.exit_code == 0
    assert f"{tmp_path}: 1 scene in train/Uniform/" in result.stdout
    assert "6/6" in result.stderr
    (marker,) = tmp_path.rglob("_scene_complete.json")
    assert "depth_unit_m=0.1, " in marker.read_text()


def test_all_maps_and_a_map_of_its_own_contradict_each_other(tmp_path):
    options = ["--map", "all", "--map", "SynthRoom"]

    result = invoke("synth", tmp_path, *SMALL, *options)

    assert result.exit_code == 2
    assert "give it alone" in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "near"), [("synthhall", "SynthHall"), ("Stylised_Egypt", "Stylized_Egypt")]
)
@pytest.mark.parametrize("plan", [[], ["--plan-only"]])
def test_a_misspelt_map_names_the_nearest_and_leaves_nothing(tmp_path, name, near, plan):
    options = ["--map", "SynthStage", "--map", name, *plan]

    result = invoke("synth", tmp_path, *SMALL, *options)

    assert result.exit_code == 2
    assert re.search(rf"no map '{name}'; did you mean '{near}'.*--map .*all", result.stderr)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("part", ["0/3", "3/2", "a/b", "1"])
def test_what_is_no_part_is_told(tmp_path, part):
    result = invoke("synth", tmp_path, *SMALL, "--part", part)

    assert result.exit_code == 2
    assert "--part" in result.stderr
    assert f"{part!r} is not a part: write I/N" in one_line(result.stderr)
    assert not list(tmp_path.iterdir())
