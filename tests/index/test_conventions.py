"""Conventions applied to scenes: learned, edited, written by hand, and carried by an index."""

import re
import shutil
from dataclasses import replace

import pytest

from stereogenbench_data.audit.scene_access import source_of
from stereogenbench_data.datasets.mapped import SceneViews, StereoPairs
from stereogenbench_data.errors import FieldError, StereoGenBenchError, StorageError
from stereogenbench_data.index.learning import chosen_scenes, examine, learn, tables_of_notes
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.row_check import compared_with_files
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.index.table import AssumptionWarning, SceneIndex
from stereogenbench_data.schema.conventions import parse_conventions, write_toml
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.verify import verify

ONE = "train/Uniform/Car_Dealer/scene_000001"
TWO = "train/Uniform/Car_Dealer/scene_000002"


def stated(text):
    return parse_conventions(text.encode(), where="c.toml")


def learned_of(root):
    keys = chosen_scenes(root, count=20, wanted=None)
    learned = learn(root, [examine(root, key) for key in keys])
    return learned, write_toml(learned.conventions, dict(tables_of_notes(learned)))


@pytest.fixture(scope="module")
def elsewhere(shared_scenes):
    """What the scene that was rendered elsewhere teaches."""
    return learned_of(shared_scenes)


def test_a_scene_is_the_same_by_the_file_it_taught(elsewhere, shared_scenes):
    plain = SceneIndex.open(shared_scenes).scene(0)

    scene = SceneIndex.open(shared_scenes, conventions=stated(elsewhere[1])).scene(0)

    for name in ("rig", "lateral_m", "rig_residual_px", "depth_unit_m", "labels", "remarks"):
        assert getattr(scene, name) == getattr(plain, name)
    assert scene.depth_unit_source == ("conventions",) * 6


STATED = """
[focal_length]
place = "$.camera_intrinsics.focal_length_mm"
unit = "mm"
[image_width]
place = "$.image_width"
[baselines]
place = "$.pairwise_pairs"
unit = "cm"
[primary_pair]
left = "$.primary_stereo_pair.left_camera"
right = "$.primary_stereo_pair.right_camera"
[poses]
location = "frames[].cameras[].location"
rotation = "frames[].cameras[].rotation"
form = "rotator pitch yaw roll deg"
axes = "unreal"
unit = "cm"
[depth]
unit_m = 0.001
"""


@pytest.mark.parametrize(
    ("right", "wrong", "figures"),
    [
        ('mm"\nunit = "mm"', 'mm"\nunit = "cm"', r"450 mm.*18\.9 widths"),
        ("$.camera_intrinsics.focal_length_mm", "$.camera_intrinsics.flange", r"flange"),
        ("$.image_width", "$.camera_count", r"6x320.*320x320"),
        ('"$.pairwise_pairs"\nunit = "cm"', '"$.pairwise_pairs"\nunit = "m"',
         r"18\.5 cm here and 1850 cm at \$\.pairwise_pairs"),
        ("pair.left_camera", "pair.right_camera", r"Cam_01.*Cam_01"),
        ("rotator pitch yaw roll deg", "rotator pitch yaw roll rad", r"9\.75 cm apart"),
        ('axes = "unreal"', 'axes = "opencv"', r"9\.75 cm apart"),
        ('axes = "unreal"\nunit = "cm"', 'axes = "unreal"\nunit = "m"', r"163 cm.*16300 cm"),
        ("unit_m = 0.001", "unit_m = 0.1", r"0\.001 m.*0\.1 m"),
    ],
)  # fmt: skip
def test_an_edit_that_the_data_contradict_is_refused_with_the_figures(
    shared_scenes, right, wrong, figures
):
    assert right in STATED
    plain = SceneIndex.open(shared_scenes).scene(0)

    scene = SceneIndex.open(shared_scenes, conventions=stated(STATED)).scene(0)
    assert (scene.rig, scene.lateral_m) == (plain.rig, plain.lateral_m)
    with pytest.raises(StereoGenBenchError, match=rf"(?s){figures}"):
        SceneIndex.open(shared_scenes, conventions=stated(STATED.replace(right, wrong)))


def test_a_wrong_tag_is_replaced_where_the_file_says_that_it_is_wrong(make_scene, root):
    make_scene()
    text = "[depth]\nunit_m = 0.01\n"

    with pytest.raises(StereoGenBenchError, match=r"0\.001 m.*0\.01 m.*instead_of_tag_m = 0\.001"):
        SceneIndex.open(root, conventions=stated(text))
    index = SceneIndex.open(root, conventions=stated(f"{text}instead_of_tag_m = 0.001\n"))

    assert index.scene(0).depth_unit_m == (0.01,) * 6


def test_a_form_that_the_file_does_not_name_is_read_as_conventions_say(make_scene, root, rewrite):
    def as_lists(document):
        for frame in document["frames"]:
            for camera in frame["cameras"]:
                camera["rotation"] = [0.0, 0.0, 0.0]

    rewrite(make_scene() / "trajectory.json", as_lists)

    index = SceneIndex.open(
        root, conventions=stated('[poses]\nform = "rotator roll pitch yaw deg"')
    )

    assert ": rotator roll pitch yaw deg, " in index.scene(0).pose_form
    assert index.scene(0).lateral_m == pytest.approx((0.0, 0.1, 0.25, 0.31, 0.6, 0.725))


def as_columns(document):
    """The poses of a trajectory.json as columns of each camera, which nothing searches for."""
    frames = document.pop("frames")
    poses = [[frame["cameras"][camera] for frame in frames] for camera in range(6)]
    document["rigs"] = {
        f"lens {camera}": {
            key: {axis: [pose[key][axis] for pose in each] for axis in each[0][key]}
            for key in ("location", "rotation")
        }
        for camera, each in enumerate(poses)
    }


def test_a_row_is_compared_by_the_form_that_it_names_also_if_nothing_settles_on_it(
    make_scene, root, rewrite
):
    def as_matrices(document):
        """OpenCV's matrices of cameras that look along the world's z axis."""
        for frame in document["frames"]:
            for pose in frame["cameras"]:
                at = pose.pop("location")
                del pose["rotation"]
                pose["matrix"] = [[1, 0, 0, at["y"]], [0, 1, 0, 0], [0, 0, 1, at["x"]],
                                  [0, 0, 0, 1]]  # fmt: skip

    rewrite(make_scene() / "trajectory.json", as_matrices)
    index = SceneIndex.open(root, conventions=stated('[poses]\naxes = "opencv"'))
    row = replace(index.scene(0), conventions=None)

    now, differences = compared_with_files(row, source_of(index, row))

    assert (now.pose_form, differences) == (row.pose_form, [])
    assert "no reading" in SceneIndex.open(root).scene(0).remark("poses")


COLUMNS = """
format = 2
[poses]
location = "$.rigs{lens }.location[x[],y[],z[]]"
rotation = "$.rigs{lens }.rotation[pitch[],yaw[],roll[]]"
camera = "$.rigs{lens }#"
outer = "cameras"
form = "rotator deg"
axes = "unreal"
unit = "cm"
"""


def test_poses_are_read_where_a_file_says_and_shards_carry_it(make_scene, root, rewrite, tmp_path):
    folder = make_scene()
    how = {"fields": ("world_from_left",), "pairs": [(3, 4)], "frames": [2]}
    plain = StereoPairs(root, **how)[0]["world_from_left"]
    rewrite(folder / "trajectory.json", as_columns)
    assert "no numbers of 6 cameras" in SceneIndex.open(root).scene(0).remark("poses")

    index = SceneIndex.open(root, conventions=stated(COLUMNS))
    index.write(root / INDEX_NAME)
    pack(root, tmp_path / "shards", workers=1)

    assert verify(tmp_path / "shards", workers=1).problems == ()
    for data in (root, tmp_path / "shards"):
        assert StereoPairs(data, **how)[0]["world_from_left"].equal(plain)
    wrong = COLUMNS.replace("rotator deg", "quaternion wxyz")
    with pytest.raises(StereoGenBenchError, match=r"rigs.*'quaternion wxyz'.*rotator pitch yaw"):
        describe_scene(root, ONE, conventions=stated(wrong))


def test_poses_that_nobody_understands_may_be_called_unknown(make_scene, root, rewrite):
    rewrite(make_scene() / "trajectory.json", lambda document: document.update(frames=[]))

    with pytest.raises(StereoGenBenchError, match=r"trajectory\.json"):
        SceneIndex.open(root, conventions=stated('[poses]\nunit = "cm"'))
    scene = SceneIndex.open(root, conventions=stated('[poses]\nform = "unknown"')).scene(0)

    assert "unknown" in scene.remark("poses")
    assert scene.lateral_m == pytest.approx((0.0, 0.1, 0.25, 0.31, 0.6, 0.725))


def test_two_shapes_of_files_are_two_declarations(make_scene, root, rewrite):
    make_scene(ONE)
    older = make_scene(TWO) / "baseline.json"

    def rename(document):
        del document["camera_intrinsics"]
        document["lens"] = {"focal_length_cm": 3.0, "sensor_width_cm": 2.4}

    rewrite(older, rename)
    text = """
        [[shape]]
        has = ["baseline.json: $.lens.focal_length_cm"]
        [shape.focal_length]
        place = "$.lens.focal_length_cm"
        [shape.sensor_width]
        place = "$.lens.sensor_width_cm"
        [[shape]]
        [shape.depth]
        frame_lag = 1
    """

    index = SceneIndex.open(root, conventions=stated(text))

    assert [index.scene(row).rig.focal_mm for row in (0, 1)] == [30.0, 30.0]
    assert len(index.shapes) == 2


def test_files_of_no_shape_are_refused(make_scene, root):
    make_scene()
    text = '[[shape]]\nhas = ["baseline.json: $.lens"]\n[shape.depth]\nframe_lag = 1\n'

    with pytest.raises(StereoGenBenchError, match=r"c\.toml.*baseline\.json: \$\.lens"):
        SceneIndex.open(root, conventions=stated(text))


def test_what_a_scene_cannot_be_used_for_is_told_with_its_keys(make_scene, root, rewrite):
    rewrite(make_scene() / "baseline.json", lambda d: d.update(camera_intrinsics={"zoom": 30.0}))

    learned, text = learned_of(root)

    assert "focal_length_mm is missing" in learned.problems[0].text
    assert "camera_intrinsics.zoom" in learned.problems[0].text
    cured = text + '[focal_length]\nplace = "$.camera_intrinsics.zoom"\nunit = "mm"\n'
    cured += '[sensor_width]\nvalue = 24\nunit = "mm"\n'
    assert SceneIndex.open(root, conventions=stated(cured)).scene(0).rig.focal_mm == 30.0


def test_an_index_and_shards_carry_conventions_to_training(make_scene, root, tmp_path):
    make_scene()
    conventions = stated("[depth]\nframe_lag = 1\n")
    first_m = StereoPairs(root, conventions=conventions)[0]["disparity"]
    index = SceneIndex.open(root, conventions=conventions)
    index.write(root / INDEX_NAME)
    pack(root, tmp_path / "shards", workers=1)

    assert verify(tmp_path / "shards", workers=1).problems == ()
    for data in (root, tmp_path / "shards"):
        assert SceneIndex.open(data).shapes == conventions.shapes
        assert StereoPairs(data)[0]["disparity"].equal(first_m)
    plain = DepthEncoding(kind="planar", frame_lag=0)
    views = SceneViews(root, depth=plain, fields=("depth",))[0]["depth"]
    assert views.max() == pytest.approx(3.0)
    assert SceneViews(root, fields=("depth",))[0]["depth"].max() == pytest.approx(3.001)


def test_conventions_of_an_index_that_lacks_them_are_compared_with_its_files(make_scene, root):
    make_scene()
    SceneIndex.open(root).write(root / INDEX_NAME)
    wrong = '[focal_length]\nvalue = 50\nunit = "mm"\n'

    with pytest.raises(StereoGenBenchError, match=r"(?s)scene_000001/baseline\.json.*50"):
        SceneIndex.open(root, conventions=stated(wrong))
    right = "[depth]\nunit_m = 0.001\noffset_m = 0.5\nkind = 'ray'\ninstead_of_tag_m = 0.001\n"
    index = SceneIndex.open(root, conventions=stated(right))

    assert index.shapes[0].depth.encoding.kind == "ray"
    assert index.scene(0).depth_unit_source == ("conventions",) * 6
    assert index.scene(0).depth_offset_m == (0.5,) * 6
    assert index.digest != SceneIndex.open(root).digest


@pytest.mark.parametrize("text", ["{", "[]", '{"depth": {"unit_m": -1}}', '{"poses": {"x": 1}}'])
def test_an_index_whose_conventions_were_altered_is_refused(make_scene, root, text):
    make_scene()
    scene = replace(SceneIndex.open(root).scene(0), conventions=text)

    with pytest.raises(StorageError, match="conventions"):
        SceneIndex.from_scenes([scene], root)


def test_conventions_beside_an_open_index_are_refused(make_scene, root):
    make_scene()

    with pytest.raises(FieldError, match=r"SceneIndex\.open"):
        StereoPairs(SceneIndex.open(root), conventions=stated("[depth]\nframe_lag = 1\n"))


def test_opening_says_in_a_line_what_it_took_for_granted(make_scene, root, rewrite):
    make_scene(ONE)
    shutil.copytree(root / ONE, root / TWO)
    for key in (ONE, TWO):
        rewrite(root / key / "baseline.json", lambda d: d.update(image_width=64, image_height=48))

    with pytest.warns(AssumptionWarning) as told:
        SceneIndex.open(root)

    (warning,) = told
    assert re.search(rf"{root}.*2 scenes.*conventions", str(warning.message))
    assert "\n" not in str(warning.message)
