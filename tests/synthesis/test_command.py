import pytest
import typer
from typer.testing import CliRunner

from stereogenbench_data.cli.synth import synth
from stereogenbench_data.errors import SynthesisError

app = typer.Typer()
app.command()(synth)
SMALL = ("--size", "32", "--frames", "1", "--workers", "1")


def test_the_command_writes_scenes_and_says_where(tmp_path):
    arguments = [str(tmp_path), *SMALL, "--family", "Uniform", "--scenes", "2", "--map", "Downtown"]

    result = CliRunner().invoke(app, arguments, catch_exceptions=False)

    assert result.exit_code == 0
    assert f"{tmp_path}: 2 scenes in train/Uniform/Downtown" in result.stdout
    assert "12/12" in result.stderr
    assert len(list(tmp_path.rglob("_scene_complete.json"))) == 2


def test_the_command_passes_the_contract_on(tmp_path):
    options = ["--rotation", "matrix", "--depth-tag", "", "--depth-unit-m", "0.1"]

    CliRunner().invoke(app, [str(tmp_path), *SMALL, *options], catch_exceptions=False)

    (trajectory,) = tmp_path.rglob("trajectory.json")
    (marker,) = tmp_path.rglob("_scene_complete.json")
    assert '"rotation_representation": "matrix_3x3"' in trajectory.read_text()
    assert "depth_unit_m=0.1, depth_tag=None" in marker.read_text()


def test_an_impossible_request_ends_the_command(tmp_path):
    with pytest.raises(SynthesisError, match="Pairwise_Uniform exists only in train"):
        CliRunner().invoke(
            app,
            [str(tmp_path), *SMALL, "--family", "Pairwise_Uniform", "--split", "eval"],
            catch_exceptions=False,
        )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--renderer", "blender"], r"no assets are named.*--assets"),
        (["--assets", "assets.toml"], r"renderer ray-casting: it takes no --assets.*blender"),
        (["--blender-python", "python3"], r"no --blender-python.*--renderer blender"),
        (["--renderer", "blender", "--assets", "absent.toml"], r"absent\.toml: cannot be read"),
    ],
)
def test_a_renderer_and_its_assets_go_together(tmp_path, options, says):
    with pytest.raises(SynthesisError, match=says):
        CliRunner().invoke(app, [str(tmp_path), *SMALL, *options], catch_exceptions=False)


def test_all_maps_and_a_map_of_its_own_contradict_each_other(tmp_path):
    options = ["--map", "all", "--map", "SynthRoom"]

    result = CliRunner().invoke(app, [str(tmp_path), *SMALL, *options], catch_exceptions=False)

    assert result.exit_code == 2
    assert "give it alone" in result.stderr
    assert not list(tmp_path.iterdir())


def test_a_holdout_list_that_is_no_text_is_told(tmp_path):
    refused = tmp_path / "refused.png"
    refused.write_bytes(b"\x89PNG\xff")
    options = ["--holdout", str(refused)]

    result = CliRunner().invoke(app, [str(tmp_path), *SMALL, *options], catch_exceptions=False)

    assert result.exit_code == 2
    assert "is not text" in result.stderr
