"""The written files, read by other means: json, PyAV, scipy, and the release's parser."""

import av
import numpy as np
import pytest
from av.video.frame import PictureType
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.geometry.pose import CameraPoses, rotation_from_rotator_deg
from stereogenbench_data.geometry.pose_forms import readings
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.schema.parse import parse_rig
from stereogenbench_data.schema.pose_search import recorded_in
from stereogenbench_data.schema.release import CAMERA_PAIRS
from stereogenbench_data.schema.trajectory import parse_trajectory
from stereogenbench_data.synthesis.request import ExportContract, SynthRequest

OPENCV_FROM_UNREAL = np.array([[0, 1, 0], [0, 0, -1], [1, 0, 0]])


def small(**changes):
    return {"size_px": 32, "frames": 2, "seed": 3} | changes


def poses_of(scene):
    document = parse_trajectory((scene.folder / "trajectory.json").read_bytes(), where="t")
    return next(readings(recorded_in(document, where="t"))).poses


def rig_of(scene):
    return parse_rig((scene.folder / "baseline.json").read_bytes(), where="baseline")[0]


def tags(path):
    with av.open(str(path)) as container:
        return {key.upper(): value for key, value in container.metadata.items()}


def test_files_have_the_keys_of_a_scene_that_was_rendered_elsewhere(draw, shared_scenes):
    (marker,) = shared_scenes.rglob("_scene_complete.json")
    ours = draw(**small())

    assert {path.name for path in ours.folder.iterdir()} == {
        path.name for path in marker.parent.iterdir()
    }
    for name in ("baseline.json", "trajectory.json", "scene_description_qwen_dataset_level.json"):
        theirs = type(ours)(marker.parent).json(name)
        assert list(ours.json(name)) == list(theirs)
    pose, their_pose = (
        scene.json("trajectory.json")["frames"][1]["cameras"][4]
        for scene in (ours, type(ours)(marker.parent))
    )
    assert {key: type(value) for key, value in pose.items()} == {
        key: type(value) for key, value in their_pose.items()
    }


def test_videos_are_encoded_as_the_release_is(draw_cameras):
    scene = draw_cameras(3, **small(frames=12))

    kinds = {}
    for name, form in (("rgb.mp4", ("h264", "yuv420p")), ("depth.mkv", ("ffv1", "gray16le"))):
        with av.open(str(scene.folder / f"cam_03_{name}")) as container:
            stream = container.streams.video[0]
            assert (stream.codec_context.name, stream.pix_fmt) == form
            assert stream.average_rate == 15
            kinds[name] = [PictureType(frame.pict_type).name for frame in container.decode(stream)]
        assert len(kinds[name]) == 12
    assert kinds["rgb.mp4"].count("I") == 1
    assert "B" in kinds["rgb.mp4"]


@pytest.mark.parametrize("family", ["IPD_Gaussian", "Uniform", "Pairwise_Uniform"])
def test_recorded_baselines_are_the_distances_of_the_recorded_poses(draw, family):
    """At world offsets of up to 1e6 cm, where a coordinate is rounded to 1.2e-10 cm."""
    scene = draw(family=family, **small())
    rig, locations = rig_of(scene), poses_of(scene).centres

    assert np.abs(locations).max() > 1e4
    for (left, right), recorded_cm in zip(CAMERA_PAIRS, rig.baselines_cm, strict=True):
        distances_cm = np.linalg.norm(locations[:, right] - locations[:, left], axis=1)
        np.testing.assert_allclose(distances_cm, recorded_cm, rtol=0, atol=1e-9)


def test_every_rotation_form_records_the_same_poses(draw_cameras):
    found = []
    for form in ("rotator", "quaternion_xyzw", "quaternion_wxyz", "matrix"):
        scene = draw_cameras(contract=ExportContract(rotation=form), **small())
        found.append(poses_of(scene).world_from_cam(1, 2))
        raw = scene.json("trajectory.json")["frames"][1]["cameras"][2]["rotation"]
        if form == "quaternion_wxyz":
            raw = [*raw[1:], raw[0]]
        if form == "rotator":
            raw = Rotation.from_euler(
                "ZYX", [raw["yaw"], -raw["pitch"], -raw["roll"]], degrees=True
            ).as_matrix()
        elif form != "matrix":
            raw = Rotation.from_quat(raw).as_matrix()
        in_opencv = OPENCV_FROM_UNREAL @ np.array(raw) @ OPENCV_FROM_UNREAL.T
        np.testing.assert_allclose(found[-1][:3, :3], in_opencv, atol=1e-12)
    np.testing.assert_allclose(found[1:], [found[0]] * 3, rtol=0, atol=1e-9)


def share_found(units_m, *, focal_px, later_from_first):
    """How many of frame 0's points the last frame measured where a motion takes them."""
    v, u = np.nonzero((units_m[0] > 0) & (units_m[0] < 60))
    z = units_m[0][v, u]
    x, y = (u - 63.5) / focal_px * z, (v - 63.5) / focal_px * z
    x, y, z, _ = later_from_first @ np.stack([x, y, z, np.ones_like(z)])
    column = np.rint(focal_px * x / z + 63.5).astype(int)
    row = np.rint(focal_px * y / z + 63.5).astype(int)
    inside = (column >= 0) & (column < 128) & (row >= 0) & (row < 128)
    place, z = (row[inside], column[inside]), z[inside]
    nearest = minimum_filter(units_m[-1], size=3)[place]
    farthest = maximum_filter(units_m[-1], size=3)[place]
    return ((nearest - 0.01 * z < z) & (z < farthest + 0.01 * z)).mean()


def test_the_recorded_poses_carry_depth_from_frame_to_frame(draw_cameras):
    """All but the walker and what it and the poles come to hide; a roll with a wrong sign shows."""
    scene = draw_cameras(1, size_px=128, frames=13, seed=8, family="IPD_Gaussian", focal_mm=30.0)
    recorded, found = poses_of(scene), []
    mirrored_deg = [
        [[turn["pitch"], turn["yaw"], -turn["roll"]] for turn in (p["rotation"] for p in poses)]
        for poses in (frame["cameras"] for frame in scene.json("trajectory.json")["frames"])
    ]
    mirrored = CameraPoses.from_unreal(
        recorded.centres, rotation_from_rotator_deg(np.array(mirrored_deg)), unit_m=recorded.unit_m
    )
    for poses in (recorded, mirrored):
        first, later = poses.world_from_cam(0, 1), poses.world_from_cam(12, 1)
        found.append(
            share_found(
                scene.units(1) / 1000,
                focal_px=scene.focal_px,
                later_from_first=np.linalg.inv(later) @ first,
            )
        )

    assert found[0] > 0.85
    assert found[1] < found[0] - 0.1


def test_the_release_reader_takes_a_scene_as_rectified(draw):
    """Read with the package's own walker: closed form and pose chain agree to 1e-6 px."""
    scene = draw(family="Uniform", **small())
    key = "train/Uniform/SynthStage/scene_000000"

    described = describe_scene(scene.folder.parents[3], key)

    assert described.rig_residual_px < 1e-6
    assert described.depth_unit_m == (0.001,) * 6
    assert described.depth_unit_source == ("tag",) * 6
    assert described.labels.character.startswith("SK_Synth")


def test_the_depth_tag_states_the_unit_or_is_absent(draw_cameras):
    tagged = draw_cameras(
        0, contract=ExportContract(depth_unit_m=0.01, depth_tag="scale"), **small()
    )
    bare = draw_cameras(0, contract=ExportContract(depth_unit_m=0.1, depth_tag=None), **small())

    assert float(tags(tagged.folder / "cam_00_depth.mkv")["SCALE"]) == 0.01
    assert not [key for key in tags(bare.folder / "cam_00_depth.mkv") if "SCALE" in key]
    fine, coarse = tagged.units(0).astype(float), bare.units(0).astype(float)
    measured = fine < 65535
    np.testing.assert_allclose(coarse[measured] / 10, fine[measured] / 100, atol=0.056)


def test_depth_beyond_16_bits_saturates_at_the_largest_number(draw, draw_cameras):
    coarse = draw(**small())
    fine = draw_cameras(0, contract=ExportContract(depth_unit_m=0.0001), **small())

    expected = np.minimum(coarse.units(0) * 10.0, 65535)
    assert (expected == 65535).any()
    assert (expected < 65535).any()
    assert np.abs(fine.units(0) - expected).max() <= 5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size_px": 0}, r"size_px must be from 2 to 8192, got 0"),
        ({"size_px": 31}, "size_px must be even .* got 31"),
        ({"family": "Wide"}, "family must be one of IPD_Gaussian, .* got 'Wide'"),
        ({"family": "Pairwise_Uniform", "split": "eval"}, "Pairwise_Uniform exists only in train"),
        ({"map_name": "a.b"}, "map_name must be letters.* got 'a.b'"),
        ({"subset": "unseen_map"}, "unseen_map is of maps that train does not have"),
        ({"focal_mm": float("nan")}, "focal_mm must be from 4 to 1000, got nan"),
        ({"depth_unit_m": 1e-9}, r"depth_unit_m must be from 1\.5259e-05 to 1, got 1e-09"),
        ({"depth_unit_m": 100.0}, "depth_unit_m must be .* to 1, got 100"),
    ],
)
def test_an_impossible_request_or_contract_is_refused(changes, message):
    with pytest.raises(SynthesisError, match=message):
        ExportContract(**changes) if "depth_unit_m" in changes else SynthRequest(**changes)
