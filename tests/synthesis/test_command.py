import re

import pytest

from tests.cli.command import refused, succeed

SMALL = ("--size", "32", "--frames", "1", "--workers", "1")


def test_the_command_writes_scenes_and_says_where(tmp_path):
    options = ["--family", "Uniform", "--scenes", "2", "--map", "all"]
    result = succeed("synth", tmp_path, *SMALL, *options, "--part", "1/2", "--depth-unit-m", "0.1")

    assert f"{tmp_path}: 1 scene in train/Uniform/" in result.stdout
    assert "6/6" in result.stderr
    (marker,) = tmp_path.rglob("_scene_complete.json")
    assert "depth_unit_m=0.1, " in marker.read_text()


@pytest.mark.parametrize(
    ("maps", "told"),
    [
        (["SynthStage", "synthhall"], "no map 'synthhall'; did you mean 'SynthHall'.*--map .*all"),
        (["SynthStage", "Stylised_Egypt"], "no map 'Styl.*; did you mean 'Stylized_Egypt'.*all"),
        (["all", "SynthRoom"], "give it alone"),
    ],
)
def test_maps_that_cannot_be_are_told_with_the_cure_and_leave_nothing(tmp_path, maps, told):
    assert re.search(told, refused("synth", tmp_path, *SMALL, *(f"--map={name}" for name in maps)))
    assert not list(tmp_path.iterdir())
