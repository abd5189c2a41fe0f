"""``stereogenbench conventions`` as a user runs it."""

import re
import shutil

import pytest

from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import ExportContract, SynthRequest
from tests.audit.corruption import as_range, rewrite_depth
from tests.cli.command import invoke, succeed


@pytest.fixture(scope="module")
def untagged(tmp_path_factory):
    """Two scenes of which nothing states the unit of depth, which is 0.001 m."""
    root = tmp_path_factory.mktemp("untagged")
    contract = ExportContract(depth_unit_m=0.001, depth_tag=None)
    synthesise(
        root,
        SynthRequest(
            family="IPD_Gaussian", scenes=2, size_px=160, frames=2, seed=6, contract=contract
        ),
        workers=1,
    )
    return root


def test_a_unit_that_nothing_states_is_measured_and_written(untagged, tmp_path):
    out = tmp_path / "conventions.toml"

    result = succeed("conventions", untagged, "-o", out, "--pictures", 1, "--workers", 1)

    (shape,) = Conventions.read(out).shapes
    assert shape.depth.encoding.unit_m == pytest.approx(0.001, rel=0.005)
    assert "the release's default" in out.read_text()
    assert "2 scenes of 2 read" in result.stderr


def test_conventions_that_pictures_contradict_end_with_1_and_the_figures(
    detailed_release, tmp_path
):
    file = tmp_path / "edited.toml"
    file.write_text("[depth]\nunit_m = 0.01\ninstead_of_tag_m = 0.001\n")

    result = invoke("conventions", detailed_release, "--check", file, "--workers", 1)

    assert result.exit_code == 1
    assert re.search(r"0\.(09|10)\d* x declared", result.stderr)
    assert f"{file}: contradicted" in result.stderr


def test_scenes_that_conventions_leave_alike_unread_are_told_once_with_the_cure(untagged, tmp_path):
    file, root = tmp_path / "edited.toml", tmp_path / "tagged"
    shutil.copytree(untagged, root, copy_function=shutil.copyfile)
    for folder in root.glob("*/*/*/scene_*"):
        rewrite_depth(folder, tags={"DEPTH_Q": "7"})
    file.write_text('[baselines]\nplace = "$.pairwise_pairs"\n')

    silent = invoke("conventions", root, "--check", file, "--workers", 1)
    file.write_text('[baselines]\nplace = "$.gaps"\n')
    wrong = invoke("conventions", root, "--check", file, "--workers", 1)

    assert (silent.exit_code, wrong.exit_code) == (1, 1)
    (unit_m,) = re.findall(r"write unit_m = ([0-9.]+) below \[depth\]", silent.stderr)
    assert float(unit_m) == pytest.approx(0.001, rel=0.005)
    assert wrong.stderr.count("$.gaps is missing") == 1
    assert "(1 more of baseline.json)" in wrong.stderr


def test_what_no_picture_can_test_is_told_beside_the_verdict(tmp_path):
    file, root = tmp_path / "edited.toml", tmp_path / "still"
    synthesise(root, SynthRequest(family="Uniform", size_px=96, frames=1, seed=3), workers=1)
    file.write_text("[depth]\nunit_m = 0.001\nframe_lag = 2\n")

    result = invoke("conventions", root, "--check", file, "--workers", 1)

    assert re.search(rf"{file}: .*could test .*frame_lag = 2.*along the axis", result.stderr)


def test_the_unit_of_a_range_is_not_measured_but_stated(detailed_release, tmp_path):
    root, out = tmp_path / "ranged", tmp_path / "conventions.toml"
    shutil.copytree(detailed_release, root, copy_function=shutil.copyfile)
    for folder in root.glob("*/*/*/scene_*"):
        tags = {"depth_near": "0.5 m", "depth_far": "70 m"}
        rewrite_depth(folder, as_range(0.5, 70, unit_m=0.001), tags=tags)

    learned = invoke("conventions", root, "-o", out, "--workers", 1)

    assert learned.exit_code == 1
    assert "may be the range that stored numbers fill" in out.read_text()
    assert Conventions.read(out).shapes[0].depth is None
    out.write_text(f"[depth]\nunit_m = {69.5 / 65535}\noffset_m = 0.5\n")
    succeed("conventions", root, "--check", out, "--workers", 1)


def test_every_command_refuses_conventions_that_files_contradict(small_release, tmp_path):
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[depth]\nunit_m = 0.5\n")

    checked = invoke("conventions", small_release, "--check", wrong, "--workers", 1)

    assert checked.exit_code == 1
    assert re.search(r"cam_00_depth\.mkv.*0\.001 m.*0\.5 m", checked.stderr)
    for command in (
        ("stats", small_release),
        ("index", small_release, "-o", tmp_path / "i.parquet"),
        ("pack", small_release, tmp_path / "out"),
        ("audit", small_release),
    ):
        result = invoke(*command, "--conventions", wrong)

        assert result.exit_code != 0
        assert "0.5 m" in result.output
