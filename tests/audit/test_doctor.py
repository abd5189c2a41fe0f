"""``stereogenbench doctor`` as a user runs it."""

import json
import re
import shutil

import pytest

from tests.audit.corruption import copied, rewrite_depth, scaled
from tests.cli.command import invoke, refused, succeed

FEW = ("--per-scene", "1", "--scenes", "1")


def run(*arguments):
    return invoke("doctor", *arguments, *FEW)


def test_a_right_tree_ends_with_0_and_says_what_was_tested(detailed_release, tmp_path):
    file = tmp_path / "doctor.txt"

    result = succeed("doctor", detailed_release, "-o", file, *FEW)

    assert result.stdout.startswith(("FITS", "CANNOT TELL: nothing contradicts"))
    assert "Depth and pictures tested: cameras 0, 1, 2, 3, 4, 5." in result.stdout
    assert "unit / (focal length x baseline)" in result.stdout
    assert "see `stereogenbench audit`: the sensor's height" in result.stdout
    assert "Paste" not in result.stdout
    assert file.read_text() == result.stdout.rstrip("\n")


def test_a_wrong_quotient_ends_with_1_and_no_unit_to_paste(detailed_release, tmp_path):
    stated = tmp_path / "stated.toml"
    stated.write_text("[depth]\nunit_m = 0.1\ninstead_of_tag_m = 0.001\n")
    text = run(detailed_release, "--conventions", stated)
    result = run(detailed_release, "--json", "--conventions", stated)

    assert text.exit_code == result.exit_code == 1
    assert "One of these explains the depth scale; the pictures cannot tell which:" in text.stdout
    document = json.loads(result.stdout)
    assert "unit / (focal length x baseline)" in document["quotient_means"]
    assert document["is_wrong"]
    (verdict,) = document["verdicts"]
    assert verdict["paste"] is None
    assert verdict["quotient"] == pytest.approx(0.01, rel=0.01)
    choice, _, unit_m = verdict["choices"][0].partition("unit_m=")
    assert choice == "if focal length and baselines are right: DepthEncoding("
    assert float(unit_m.removesuffix(")")) == pytest.approx(0.001, rel=0.01)
    assert verdict["choices"][1].startswith("if unit and baselines are right: a focal length of ")
    assert verdict["choices"][2].startswith("if unit and focal length are right: baselines of ")
    assert verdict["choices"][2].endswith(" x what is recorded")


def test_a_camera_that_does_not_fit_ends_with_1(detailed_release, tmp_path):
    (scene,) = detailed_release.glob("*/*/*/scene_*")
    rewrite_depth(copied(scene, tmp_path), scaled(0.5), cameras=[4])

    result = run(tmp_path)

    assert result.exit_code == 1
    assert result.stdout.startswith("WRONG: ")
    assert "WRONG: depth of camera 4 is 0.5" in result.stdout
    assert "The declared contract fits" not in result.stdout
    assert "Paste" not in result.stdout
    assert "Nothing to paste" in result.stdout


def test_a_scene_that_lacks_a_video_is_left_out_and_the_others_are_judged(
    detailed_release, tmp_path
):
    (scene,) = detailed_release.glob("*/*/*/scene_*")
    copied(scene, tmp_path)
    cut = tmp_path.joinpath(*scene.parts[-4:-1], "scene_009999")
    shutil.copytree(scene, cut)
    (cut / "cam_02_rgb.mp4").write_bytes((cut / "cam_02_rgb.mp4").read_bytes()[:2000])

    result = succeed("doctor", tmp_path, *FEW)

    assert "1 scene," in result.stdout
    assert re.search(r"\S+/scene_009999 .*cam_02_rgb.mp4", result.stdout)

    shutil.rmtree(cut.with_name(scene.name))
    assert "no scene has all videos" in refused("doctor", tmp_path, *FEW)
