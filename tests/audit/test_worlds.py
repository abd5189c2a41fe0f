"""Which reading of the poses is right, by depth from frame to frame."""

import json
import re

import pytest
import torch

from stereogenbench_data.audit.contract.worlds import judge_worlds
from stereogenbench_data.datasets.mapped import SceneViews
from stereogenbench_data.geometry.pose_forms import readings
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.pose_search import recorded_in
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.audit.corruption import copied
from tests.cli.command import invoke, succeed

RIGHT, WRONG = "opencv", "opengl"


def scenes(*shares):
    return [{RIGHT: (right, right), WRONG: (wrong, wrong)} for right, wrong in shares]


def test_a_reading_that_explains_most_pixels_and_is_well_ahead_is_right():
    verdict = judge_worlds(scenes((0.9, 0.5), (0.95, 0.6), (0.8, 0.02), (0.97, 0.9)))

    assert verdict.chosen == RIGHT
    assert verdict.shares[WRONG] == pytest.approx((0.26, 0.75))


@pytest.mark.parametrize(
    ("shares", "reason"),
    [
        ([(0.9, 0.8)], "no reading is 20% ahead in the choosing camera"),
        ([(0.5, 0.1), (0.5, 0.1)], "no reading explains 60% of the pixels of the choosing scenes"),
        ([(0.95, 0.9), (0.95, 0.9)], "no reading is 20% ahead in the choosing scenes"),
        ([(0.95, 0.3), (0.3, 0.95)], "no reading explains 60% of the pixels of the confirming sce"),
        ([(0.95, 0.3), (0.95, 0.9)], "no reading is 20% ahead in the confirming scenes"),
    ],
)
def test_what_pictures_cannot_tell_stays_open(shares, reason):
    verdict = judge_worlds(scenes(*shares))

    assert verdict.chosen == ""
    assert verdict.reason.startswith(reason)


def test_a_second_camera_must_confirm_what_one_camera_of_one_scene_chooses():
    verdict = judge_worlds([{RIGHT: (0.9, 0.3), WRONG: (0.1, 0.9)}])

    assert verdict.chosen == ""
    assert "confirming camera" in verdict.reason
    assert judge_worlds(scenes((0.9, 0.1))).chosen == RIGHT
    assert judge_worlds([{RIGHT: (0.9, 0.9)}, {WRONG: (0.1, 0.1)}]).chosen == ""


def test_conventions_that_state_another_reading_are_wrong():
    assert judge_worlds(scenes((0.9, 0.1), (0.9, 0.1)), stated=WRONG).is_wrong
    assert not judge_worlds(scenes((0.9, 0.1), (0.9, 0.1)), stated=RIGHT).is_wrong
    assert not judge_worlds(scenes((0.9, 0.8), (0.9, 0.8)), stated=WRONG).is_wrong


def write_matrices(root, *, still=False):
    """Write the poses of a tree's only scene as OpenCV's matrices, and say OpenGL or OpenCV."""
    (path,) = root.rglob("trajectory.json")
    document = json.loads(path.read_text())
    as_unreal = next(readings(recorded_in(document, where="trajectory.json"))).poses
    for frame, poses in enumerate(document["frames"]):
        for camera, pose in enumerate(poses["cameras"]):
            pose.pop("rotation"), pose.pop("location")
            pose["pose"] = as_unreal.world_from_cam(0 if still else frame, camera).tolist()
    said = {"coordinate_system": "OpenGL or OpenCV", "unit": "m"}
    path.write_text(json.dumps(said | {"frames": document["frames"]}))


def test_conventions_of_poses_that_depth_does_not_tell_stay_open_and_say_what_is_refused(
    tmp_path,
):
    root, file = tmp_path / "still", tmp_path / "c.toml"
    synthesise(root, SynthRequest(family="Uniform", scenes=1, size_px=64, frames=2, seed=6))
    write_matrices(root, still=True)

    result = invoke("conventions", root, "-o", file, "--pictures", 1, "--workers", 1)

    assert result.exit_code == 1
    assert Conventions.read(file).shapes[0].poses is None
    for told in (result.stderr, file.read_text()):
        assert "opencv axes" in told
        assert "opengl axes" in told
        assert "world_from_left" in told
        assert re.search(r"\d%.*cannot tell", told)


def moved(root, **options):
    """The motion of camera 0 from the first frame to the last."""
    views = SceneViews(root, cameras=(0,), fields=("world_from_cam",), frames=(0, 6), **options)
    first, later = (views[row]["world_from_cam"] for row in (0, 1))
    return torch.linalg.inv(first) @ later


def test_conventions_take_the_reading_that_depth_confirms_and_refuse_another(
    small_release, tmp_path
):
    root, file, edited = (tmp_path / name for name in ("tree", "c.toml", "edited.toml"))
    copied(small_release / "train/Uniform/SynthStage/scene_000000", root)
    plain = moved(root)
    write_matrices(root)
    options = ("--pictures", 1, "--workers", 1)

    succeed("conventions", root, "-o", file, *options)
    edited.write_text(file.read_text().replace('axes = "opencv"', 'axes = "opengl"'))
    checked = invoke("conventions", root, "--check", edited, *options)

    assert re.search(r"# .*97%.*opencv axes.*\n\[poses\]", file.read_text())
    torch.testing.assert_close(moved(root, conventions=file), plain)
    assert checked.exit_code == 1
    assert re.search(r"97%.*opencv.*WRONG.*opengl", checked.stderr)
