"""Damaged data, as a user of StereoPairs meets them: each is named with its file and the cure."""

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from stereogenbench_data import (
    DepthEncoding,
    MediaError,
    SceneIndex,
    StereoGenBenchError,
    StereoPairs,
    StorageError,
)
from stereogenbench_data.index.table import AssumptionWarning, IncompleteSceneWarning
from stereogenbench_data.samples.fields import OddSceneWarning
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.datasets.conftest import write_again
from tests.servers.tools import rewrite_json
from tests.servers.videos import write_rgb

NEEDING_ALL_VIDEOS = [(0, 1), (2, 3), (4, 5)]
FIELDS = ("left", "right", "disparity", "visible", "right_from_left")


@pytest.fixture
def scene(small_release, tmp_path):
    """The folder of a scene that may be damaged, in a tree of its own."""
    source = next(small_release.glob("train/IPD_Gaussian/*/scene_000000"))
    target = tmp_path / source.relative_to(small_release)
    shutil.copytree(source, target)
    return target


def root_of(scene):
    return scene.parents[3]


def edited(change):
    return lambda path: rewrite_json(path, change)


DAMAGES = {
    "a missing camera": (
        "cam_03_rgb.mp4", Path.unlink, "is missing, and the scene is marked as complete",
    ),
    "an mp4 cut short": ("cam_01_rgb.mp4", lambda path: os.truncate(path, 2000), ""),
    "a text for a video": ("cam_05_rgb.mp4", lambda path: path.write_text("not a video"), ""),
    "a text for a trajectory": ("trajectory.json", lambda path: path.write_text("{"), ""),
    "a bomb of brackets": ("baseline.json", lambda path: path.write_text("[" * 200_000), "nest"),
    "a NaN baseline": (
        "baseline.json",
        edited(lambda doc: doc["pairwise_pairs"][3].update(baseline_cm=float("nan"))),
        r"\$\.pairwise_pairs\[3\]\.baseline_cm.*nan",
    ),
    "a trajectory of other frames": (
        "trajectory.json", edited(lambda doc: doc.update(frames=doc["frames"][:4])),
        "has poses of 4 frames, and the videos have 7",
    ),
    "a pose without a camera": (
        "trajectory.json", edited(lambda doc: doc["frames"][2]["cameras"].pop(1)),
        r"\$\.frames\[2\]\.cameras has 5, and the first such has 6",
    ),
    "poses that contradict the baselines": (
        "baseline.json",
        edited(lambda doc: [pair.update(baseline_cm=pair["baseline_cm"] * 2)
                            for pair in doc["pairwise_pairs"] + doc.get("adjacent_pairs", [])]),
        r"cameras \d and \d are .* cm apart, and by the poses",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_scene_is_refused_when_the_tree_is_opened(scene, what):
    name, damage, found = DAMAGES[what]
    damage(scene / name)

    with pytest.raises(StereoGenBenchError, match=f"(?s){re.escape(name)}.*{found}"):
        StereoPairs(root_of(scene), fields=FIELDS, pairs=NEEDING_ALL_VIDEOS)


def test_a_scene_without_a_camera_gives_the_pairs_of_the_others(scene):
    whole = StereoPairs(root_of(scene), fields=FIELDS)[0]
    (scene / "cam_03_rgb.mp4").unlink()

    primary = StereoPairs(root_of(scene), fields=FIELDS)

    assert (primary[0]["disparity"] == whole["disparity"]).all()
    with pytest.raises(StorageError, match=r"cam_03_rgb\.mp4: is missing"):
        StereoPairs(root_of(scene), pairs=[(2, 3)])


def test_an_unfinished_scene_is_left_out_with_a_warning(scene):
    other = scene.with_name("scene_000001")
    shutil.copytree(scene, other)
    (other / "_scene_complete.json").unlink()

    with pytest.warns(IncompleteSceneWarning, match=r"scene_000001.*never finished"):
        pairs = StereoPairs(root_of(scene))
    assert len(pairs) == 1


@pytest.mark.parametrize("name", ["cam_01_depth.mkv", "trajectory.json"])
def test_a_file_that_changed_after_its_index_is_refused(scene, name):
    pairs = StereoPairs(root_of(scene), fields=FIELDS)
    whole = (scene / name).read_bytes()
    (scene / name).write_bytes(whole[:-10])

    with pytest.raises(StorageError, match=f"{name}.*the index says {len(whole)}"):
        pairs[0]


@pytest.mark.parametrize("name", ["cam_00_rgb.mp4", "cam_01_depth.mkv"])
def test_a_payload_altered_in_place_is_an_error_and_no_sample(scene, name):
    whole = bytearray((scene / name).read_bytes())
    start = len(whole) // 3
    whole[start : start + len(whole) // 3] = bytes(len(whole) // 3)
    (scene / name).write_bytes(bytes(whole))

    with pytest.raises((MediaError, StorageError), match=name.replace(".", r"\.")):
        list(StereoPairs(root_of(scene), fields=FIELDS, frames="all"))


@pytest.mark.parametrize("missing", [1, 3])
def test_a_depth_stream_with_fewer_frames_is_told_or_refused(tmp_path, missing):
    request = SynthRequest(size_px=32, frames=4)
    short = SynthRequest(size_px=32, frames=4 - missing)
    [key] = synthesise(tmp_path / "short", short, workers=1)
    synthesise(tmp_path / "long", request, workers=1)
    shutil.copy(tmp_path / "short" / key / "cam_04_depth.mkv", tmp_path / "long" / key)

    if missing == 1:
        with pytest.warns(AssumptionWarning, match="the frames that all videos have are used"):
            index = SceneIndex.open(tmp_path / "long")
        assert index.scene(0).frames == 3
        assert "cam_04_depth.mkv has 3" in index.scene(0).remark("frames")
    else:
        with pytest.raises(StorageError, match=r"cam_04_depth\.mkv has 1"):
            StereoPairs(tmp_path / "long")


def test_depth_that_cannot_be_whole_is_refused_unless_it_is_meant(scene):
    generator = np.random.default_rng(0)
    for camera in range(6):
        pictures = generator.integers(40, 200, (7, 64, 64, 1), dtype=np.uint8).repeat(3, axis=-1)
        write_rgb(scene / f"cam_{camera:02d}_depth.mkv", pictures)

    with pytest.raises(MediaError, match=r"cam_00_depth\.mkv: .*yuv420p.*lossy.*accept="):
        StereoPairs(root_of(scene), fields=("disparity",))
    meant = DepthEncoding(0.1, accept=frozenset({"8-bit", "lossy", "chroma"}))
    assert StereoPairs(root_of(scene), fields=("depth",), depth=meant)[0]["depth"].max() > 3
    assert StereoPairs(root_of(scene), fields=("left",))[0]["left"].any()


def retagged(scene, camera, *options):
    """Write a depth video again with other tags."""
    path = scene / f"cam_{camera:02d}_depth.mkv"
    write_again(path, "-c", "copy", "-map_metadata", "-1", *options)


def test_a_tag_that_is_no_number_needs_the_users_unit(scene):
    retagged(scene, 1, "-metadata", "DEPTH_SCALE=seven")
    root = root_of(scene)

    with pytest.raises(MediaError, match=r"cam_01_depth\.mkv.*seven.*DepthEncoding\(unit_m="):
        StereoPairs(root, fields=("visible",))
    with pytest.warns(OddSceneWarning, match="other units of depth"):
        untouched = StereoPairs(root, fields=("disparity",))[0]
    assert untouched["disparity"].any()
    meant = StereoPairs(root, fields=("depth_right",), depth=DepthEncoding(0.001))[0]
    assert 1 < float(meant["depth_right"].median()) < 100


def test_depth_is_not_guessed_where_one_camera_of_a_rig_lacks_its_tag(scene):
    retagged(scene, 1)

    told = r"differ by a scale: 0\.001, 0\.1 by default.*pass DepthEncoding\(unit_m="
    with pytest.raises(MediaError, match=told):
        StereoPairs(root_of(scene))

    assert StereoPairs(root_of(scene), fields=("left",))[0]["left"].any()


def turn(scene, camera, **angles_deg):
    def change(doc):
        for frame in doc["frames"]:
            for name, angle_deg in angles_deg.items():
                frame["cameras"][camera]["rotation"][name] += angle_deg

    rewrite_json(scene / "trajectory.json", change)


def test_a_rig_that_is_not_rectified_is_warned_of_and_goes_through_its_poses(scene):
    straight = StereoPairs(root_of(scene), fields=("disparity", "valid"))[0]
    turn(scene, 1, yaw=0.5)

    with pytest.warns(OddSceneWarning, match=r"1 selected scenes are not rectified \(by up to"):
        pairs = StereoPairs(root_of(scene), fields=("disparity", "valid"))
    focal_px = pairs.index.scene(0).rig.focal_mm / 23.76 * 64
    moved = (pairs[0]["disparity"] - straight["disparity"])[straight["valid"]]
    # a camera turned right by half a degree sees everything about f tan(0.5 degrees) further left
    assert float(moved.median()) == pytest.approx(focal_px * np.tan(np.radians(0.5)), rel=0.1)


@pytest.mark.parametrize(
    ("cameras", "yaw_deg", "reason"),
    [(range(6), 90.0, r"cameras \d and \d are .* cm beside each other"),
     ([4], 180.0, "a camera looks away from what the others see")],
    ids=["not beside each other", "one looks back"],
)  # fmt: skip
def test_impossible_poses_are_not_used_and_no_field_gives_them(scene, cameras, yaw_deg, reason):
    for camera in cameras:
        turn(scene, camera, yaw=yaw_deg)

    with pytest.warns(OddSceneWarning, match=f"rigs are assumed rectified.*{reason}"):
        pairs = StereoPairs(root_of(scene), fields=("disparity",))
    assert pairs[0]["disparity"].any()
    with pytest.raises(StorageError, match=f"'right_from_left' needs .*{reason}"):
        StereoPairs(root_of(scene), fields=("right_from_left",))


def test_a_principal_point_outside_the_picture_holds_up_the_intrinsics_alone(scene):
    centred = StereoPairs(root_of(scene), fields=("disparity",))[0]["disparity"]
    rewrite_json(
        scene / "baseline.json",
        lambda doc: doc["camera_intrinsics"].update(principal_point_px={"x": 32, "y": -4}),
    )

    with pytest.raises(StorageError, match=r"'intrinsics' needs .*principal_point_px"):
        StereoPairs(root_of(scene), fields=("intrinsics",))
    found = StereoPairs(root_of(scene), fields=("disparity",))[0]["disparity"]
    assert (found == centred).all()


def test_data_that_are_not_there_say_where_they_were_looked_for(tmp_path):
    with pytest.raises(StorageError, match="nowhere: does not exist"):
        StereoPairs(tmp_path / "nowhere")
