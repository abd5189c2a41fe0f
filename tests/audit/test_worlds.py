"""Which reading of the poses is right, by depth from frame to frame."""

import json
from contextlib import closing

import pytest

from stereogenbench_data.audit.contract.matching import SceneFrames
from stereogenbench_data.audit.contract.worlds import explained_shares, judge_worlds
from stereogenbench_data.audit.scene_access import SceneAccess
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.pose_forms import readings
from stereogenbench_data.index.assumptions import AssumptionWarning
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.trajectory import record_poses
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

RIGHT, WRONG = "opencv", "opengl"


def scenes(*shares):
    return [{RIGHT: right, WRONG: wrong} for right, wrong in shares]


def test_a_reading_that_explains_most_pixels_and_is_well_ahead_is_right():
    verdict = judge_worlds(scenes((0.9, 0.5), (0.95, 0.6), (0.8, 0.02), (0.97, 0.9)))

    assert verdict.chosen == RIGHT
    assert verdict.shares[WRONG] == pytest.approx((0.26, 0.75))


@pytest.mark.parametrize(
    ("shares", "reason"),
    [
        ([(0.9, 0.5)], "fewer than two scenes"),
        ([(0.5, 0.1), (0.5, 0.1)], "no reading explains 60% of the pixels of the scenes that cho"),
        ([(0.95, 0.9), (0.95, 0.9)], "no reading is 20% ahead in the scenes that choose"),
        ([(0.95, 0.3), (0.3, 0.95)], "no reading explains 60% of the pixels of the scenes that co"),
        ([(0.95, 0.3), (0.95, 0.9)], "no reading is 20% ahead in the scenes that confirm"),
    ],
)
def test_what_pictures_cannot_tell_stays_open(shares, reason):
    verdict = judge_worlds(scenes(*shares))

    assert verdict.chosen == ""
    assert verdict.reason.startswith(reason)


def test_depth_tells_which_way_a_camera_looks(tmp_path):
    request = SynthRequest(family="Uniform", scenes=1, size_px=64, frames=9, seed=6)
    synthesise(tmp_path, request)
    (path,) = tmp_path.rglob("trajectory.json")
    document = json.loads(path.read_text())
    reading = next(readings(record_poses(path.read_bytes(), where="trajectory.json")))
    as_unreal = CameraPoses.from_trajectory(reading.trajectory)
    for frame, poses in enumerate(document["frames"]):
        for camera, pose in enumerate(poses["cameras"]):
            pose.pop("rotation"), pose.pop("location")
            pose["pose"] = as_unreal.world_from_cam(frame, camera).tolist()
    del document["rotation_representation"]
    path.write_text(json.dumps(document | {"unit": "m"}))

    with pytest.warns(AssumptionWarning, match="several readings of the poses fit"):
        index = SceneIndex.open(tmp_path)
    scene = index.scene(0)
    source = SceneAccess.of(index, scene).source()
    with closing(Streams(source)) as streams:
        views = SceneFrames(scene, streams, encoding=DepthEncoding())
        text = source.read(scene, "trajectory.json")
        shares = explained_shares(views, text, scene.pose_form.split("|"))

    (right, most), (wrong, least) = sorted(shares.items(), key=lambda each: -each[1])
    assert "opencv axes" in right
    assert "opengl axes" in wrong
    assert most > 0.8
    assert most - least > 0.1
