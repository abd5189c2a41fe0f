"""One scene's folder: what its row says, and each way in which it can be wrong."""

import os
import re
import shutil

import av
import pytest

from stereogenbench_data.errors import SchemaError, StorageError
from stereogenbench_data.index.row_check import compared_with_files
from stereogenbench_data.index.scene_folder import (
    IncompleteScene,
    describe_scene,
)
from stereogenbench_data.index.table import assumptions
from stereogenbench_data.schema.conventions import parse_conventions
from stereogenbench_data.schema.records import Member
from stereogenbench_data.sources.members import MemberSource
from tests.servers.videos import write_frames

KEY = "train/Uniform/Car_Dealer/scene_000001"


@pytest.fixture
def described(make_scene, root, rewrite):
    """From a change of one of its JSON files to the row of a scene."""

    def describe(name, change):
        rewrite(make_scene() / name, change)
        return describe_scene(root, KEY)

    return describe


def test_a_row_says_what_the_files_say(make_scene, root):
    folder = make_scene()

    scene = describe_scene(root, KEY)

    assert scene.id.key == KEY
    assert (scene.labels.character, scene.labels.map_path) == ("SK_Ch13", "/Game/Car_Dealer")
    assert scene.caption == "Cars behind glass."
    assert (scene.frames, scene.frame_rate_hz) == (4, 15.0)
    assert scene.lateral_m == pytest.approx((0.0, 0.1, 0.25, 0.31, 0.6, 0.725), abs=1e-12)
    assert scene.rig_residual_px < 1e-9
    assert scene.depth_unit_m == (0.001,) * 6
    assert scene.depth_unit_source == ("tag",) * 6
    assert scene.depth_codec == ("ffv1",) * 6
    assert scene.depth_pixel_format == ("gray16le",) * 6
    assert scene.valid_depth_ratio is None
    assert len(scene.members) == 16
    size = (folder / "cam_03_depth.mkv").stat().st_size
    assert scene.members["cam_03_depth.mkv"] == Member(f"{KEY}/cam_03_depth.mkv", 0, size)


def test_the_scene_rendered_elsewhere_is_described(shared_scenes):
    scene = describe_scene(shared_scenes, "train/Pairwise_Uniform/SeyeonjeongPavilion/scene_000003")

    assert scene.frames == 81
    assert scene.lateral_m == pytest.approx((0, 0.185, 0.515, 0.6125, 1.225, 1.63), abs=1e-9)
    assert scene.rig_residual_px < 1e-4
    assert scene.caption.startswith("A courtyard of textured solids")
    assert len(scene.members) == 17


@pytest.mark.parametrize(
    ("keep", "match"),
    [
        (lambda name: False, "the folder is empty"),
        (lambda name: not name.startswith("cam_"), "has metadata only, and none of its 12 videos"),
    ],
)
def test_an_unfinished_scene_says_why(make_scene, root, keep, match):
    folder = make_scene()
    for path in folder.iterdir():
        if not keep(path.name):
            path.unlink()

    with pytest.raises(IncompleteScene, match=f"{KEY}: {match}"):
        describe_scene(root, KEY)


def test_what_not_every_sample_needs_becomes_a_remark(make_scene, root):
    folder = make_scene()
    (folder / "cam_04_rgb.mp4").unlink()
    (folder / "trajectory.json").unlink()

    scene = describe_scene(root, KEY)

    assert {remark.about for remark in scene.remarks} == {"poses", "videos"}
    assert "cam_04_rgb.mp4" not in scene.members
    assert "cam_04_rgb.mp4: is missing" in scene.remark("videos")
    assert scene.pose_form is None


@pytest.mark.parametrize(("pair", "sign"), [([0, 1], 1), ([3, 1], -1)])
def test_without_poses_the_primary_pair_tells_the_left_end(make_scene, root, rewrite, pair, sign):
    folder = make_scene()
    rewrite(folder / "baseline.json", lambda d: d.update(primary_stereo_pair=pair))
    (folder / "trajectory.json").write_text("{")

    scene = describe_scene(root, KEY)

    places_m = [sign * place_m for place_m in (0.0, 0.1, 0.25, 0.31, 0.6, 0.725)]
    assert scene.lateral_m == pytest.approx(places_m, abs=1e-12)
    assert scene.rig_residual_px == 0
    assert "is cut short" in scene.remark("poses")


def test_cameras_whose_sides_are_contradicted_have_no_poses(described):
    scene = described("baseline.json", lambda d: d.update(primary_stereo_pair=[1, 0]))

    assert scene.pose_form is None
    assert "camera 1 is to the right of camera 0" in scene.remark("left")


def test_the_text_file_stands_in_for_the_description(make_scene, root):
    folder = make_scene()
    (folder / "scene_description_qwen_dataset_level.json").unlink()
    (folder / "scene_description_qwen_dataset_level.txt").write_text("Cars.\n")

    assert describe_scene(root, KEY).caption == "Cars."


def test_the_jsons_caption_counts_and_not_that_of_the_text_file(make_scene, root):
    folder = make_scene()
    (folder / "scene_description_qwen_dataset_level.txt").write_text("A red horse.")

    scene = describe_scene(root, KEY)

    assert (scene.caption, scene.remarks) == ("Cars behind glass.", ())


def test_frames_without_poses_at_the_end_are_not_used(described):
    scene = described("trajectory.json", lambda document: document["frames"].pop())

    assert (scene.frames, scene.remark("poses")) == (3, "")
    assert "poses of 3 frames, and the videos have 4. The first 3 are" in scene.remark("frames")


def test_depth_in_a_form_that_nothing_reads_stops_no_pictures(make_scene, root):
    frames = (av.VideoFrame(32, 24, "yuva444p") for _ in range(4))
    path = make_scene() / "cam_00_depth.mkv"
    write_frames(path, frames, codec="ffv1", pixel_format="yuva444p")

    scene = describe_scene(root, KEY)

    assert len(scene.held_videos) == 11
    with pytest.raises(StorageError, match=r"cam_00_depth.mkv is unusable \(.* depth is stored by"):
        scene.member("cam_00_depth.mkv")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("notes.json", '{"depth_unit": "mm"}'),
        ("depth_meta.json", '{"unit": "mm"}'),
        (
            "scene_description_qwen_dataset_level.json",
            '{"depth": "deep, some 9 metres", "max_depth_m": 30, "depth_scale": 0.001}',
        ),
    ],
)
def test_a_unit_of_depth_in_a_file_of_its_own_is_read(make_scene, root, video, name, text):
    folder = make_scene()
    shutil.copy(video("depth.mkv", tags={}), folder / "cam_00_depth.mkv")
    (folder / name).write_text(text)

    assert describe_scene(root, KEY).depth_unit_m[0] == 0.001


@pytest.mark.parametrize(
    "edit",
    [
        lambda frames: [pose["rotation"].update(yaw=pose["rotation"]["yaw"] + 2.0)
                        for frame in frames for pose in frame["cameras"]],
        lambda frames: frames.extend([frames[-1] | {"frame_index": 4 + more} for more in range(3)]),
        lambda frames: [frame.update(frame_index=frame["frame_index"] - 4) for frame in frames],
        lambda frames: frames.pop(0),
    ],
    ids=["all cameras turned", "three entries more", "numbers below 0", "one less"],
)  # fmt: skip
def test_poses_that_no_lateral_rig_of_these_frames_has_are_not_used(described, edit):
    scene = described("trajectory.json", lambda document: edit(document["frames"]))

    assert scene.remark("poses")
    assert scene.rig_residual_px == 0


def test_objects_beside_the_cameras_are_no_poses(described):
    def add_lights(document):
        for frame in document["frames"]:
            frame["lights"] = frame["cameras"][:2]

    assert described("trajectory.json", add_lights).remark("poses") == ""


@pytest.mark.parametrize(
    ("tags", "told"),
    [({"DEPTH_SCALE": "0.01"}, "0.01, 0.001"), ({}, "0.1 by default, 0.001")],
)
def test_units_of_depth_that_differ_in_a_rig_are_not_used(make_scene, root, video, tags, told):
    shutil.copy(video("depth.mkv", tags=tags), make_scene() / "cam_00_depth.mkv")

    scene = describe_scene(root, KEY)

    assert scene.depth_unit_source == ("unreadable",) * 6
    assert told in scene.remark("depth")


def test_the_videos_tell_the_size_whatever_is_recorded(described):
    scene = described("baseline.json", lambda document: document.update(image_width=1280))

    assert (scene.rig.image_width_px, scene.rig.image_height_px) == (32, 24)
    assert "pictures of 1280x24 pixels, and all videos have 32x24" in scene.remark("size")


def test_without_a_size_a_focal_length_in_pixels_is_of_the_videos(make_scene, root, rewrite):
    def in_pixels(document):
        del document["image_width"], document["image_height"]
        document["camera_intrinsics"] = {"fx_px": 40, "sensor_width_mm": 24.0}

    folder = make_scene()
    rewrite(folder / "baseline.json", in_pixels)
    text = b'format = 2\n[focal_length]\nplace = "$.camera_intrinsics.fx_px"\nas = "pixels"\n'

    scene = describe_scene(root, KEY, conventions=parse_conventions(text, where="c.toml"))

    assert scene.rig.focal_mm == pytest.approx(40 / 32 * 24)
    assert compared_with_files(scene, MemberSource(root, shards={})) == (scene, [])


def test_a_sensor_of_another_shape_than_the_pictures_is_told(make_scene, root, rewrite):
    folder = make_scene()
    assert describe_scene(root, KEY).remark("pixels") == ""

    def widen(document):
        document["camera_intrinsics"]["sensor_height_mm"] = 24.0

    rewrite(folder / "baseline.json", widen)
    scene = describe_scene(root, KEY)

    assert re.search(r"24 x 24 mm .* 32x24 pixels .*0\.75 times", scene.remark("pixels"))
    assert "32x24" in assumptions([scene], where="ROOT")


def test_a_baseline_may_differ_by_a_millimetre_and_a_thousandth(make_scene, root, rewrite):
    def widened(baseline_cm):
        return lambda document: document["pairwise_pairs"][7].update(baseline_cm=baseline_cm)

    path = make_scene() / "baseline.json"
    rewrite(path, widened(50.14))
    assert describe_scene(root, KEY).rig.baselines_cm[7] == 50.14

    rewrite(path, widened(51.0))
    told = "cameras 1 and 4 are 51 cm apart.* 50 cm apart in frame 0.* add up"
    with pytest.raises(StorageError, match=told):
        describe_scene(root, KEY)


@pytest.mark.parametrize(("scale", "is_left"), [(0.01, ""), (1.1, "scaled"), (100.0, "")])
def test_poses_of_a_rig_that_no_scene_of_its_family_has_hold_up_poses_alone(
    described, scale, is_left
):
    def scaled(document):
        for frame in document["frames"]:
            for pose in frame["cameras"]:
                pose["location"] = {axis: scale * cm for axis, cm in pose["location"].items()}

    scene = described("trajectory.json", scaled)

    assert "in another unit or scaled" in scene.remark("poses")
    assert is_left in scene.remark("left")
    assert bool(is_left) == bool(scene.remark("left"))


def test_all_problems_of_a_scene_are_told_at_once(make_scene, root, video):
    folder = make_scene()
    (folder / "baseline.json").write_bytes(b"{")
    shutil.copy(video("rgb.mp4", size=(48, 64)), folder / "cam_01_rgb.mp4")

    with pytest.raises(StorageError, match="2 of its files cannot be used") as caught:
        describe_scene(root, KEY)

    assert f"{KEY}/baseline.json: not valid JSON" in str(caught.value)
    assert "11 have 32x24, but cam_01_rgb.mp4 has 64x48" in str(caught.value)


def test_a_huge_metadata_file_is_refused_by_its_size(make_scene, root):
    path = make_scene() / "baseline.json"
    os.truncate(path, 200 * 2**20)

    with pytest.raises(SchemaError, match=r"baseline.json: .*this one has 209,715,200. It was not"):
        describe_scene(root, KEY)


def test_a_folder_that_is_gone_is_named(root):
    with pytest.raises(StorageError, match=r"scene_000001: cannot be read .No such file"):
        describe_scene(root, KEY)
