"""Exports of several views: read as each format says, points lie on the pixels they are of."""

import json
import shutil
import sys
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stereogenbench_data import DepthEncoding, SceneViews
from stereogenbench_data.bridges.export_views import export_views, quaternion_wxyz
from stereogenbench_data.errors import FieldError, SelectionError, StorageError
from stereogenbench_data.geometry.pose import rotation_from_quaternion_xyzw
from stereogenbench_data.index.table import SceneIndex
from tests.servers.tools import files_of, kill_at, killed_fork, require_module

CLOSE_PX = 0.01

exported = partial(export_views, workers=1)
"""Processes take seconds to start: one test has several."""


def read_ply(path):
    """Read a binary PLY file of coloured points."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    kinds = {"float": "<f4", "uchar": "u1"}
    dtype = np.dtype([(name, kinds[kind]) for _, kind, name in map(str.split, lines[3:])])
    points = np.frombuffer(body, dtype=dtype)
    assert len(points) == count
    world = np.stack([points[name] for name in "xyz"], axis=-1).astype(np.float64)
    return world, np.stack([points[name] for name in ("red", "green", "blue")], axis=-1)


def lens_of(moment):
    return tuple(moment["intrinsics"].numpy()[[0, 1, 0, 1], [0, 1, 2, 2]])


def pixels_of(cam, lens):
    fx, fy, cx, cy = lens
    return np.stack([fx * cam[:, 0] / cam[:, 2] + cx, fy * cam[:, 1] / cam[:, 2] + cy], axis=-1)


def measured_pixels(depth):
    """Return the centres of the measured pixels, row by row, and their depths."""
    rows, columns = np.nonzero(depth > 0)
    return np.stack([columns + 0.5, rows + 0.5], axis=-1), depth[rows, columns]


def pixels_of_first(world, depth, cam_from_world, lens):
    """Return a camera's measured pixels, after the assertion that the first points lie on them."""
    pixels, depth_m = measured_pixels(depth.numpy())
    cam = world[: len(pixels)] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    assert np.abs(pixels_of(cam, lens) - pixels).max() < CLOSE_PX
    np.testing.assert_allclose(cam[:, 2], depth_m, rtol=1e-5)
    return pixels


@pytest.fixture(scope="module")
def moment(detailed_release):
    return SceneViews(detailed_release)[0]


@pytest.mark.skipif(sys.version_info >= (3, 15), reason="pycolmap has no wheel for Python 3.15 yet")
def test_colmap_reads_poses_and_points_that_project_onto_their_observations(
    detailed_release, moment, tmp_path
):
    pycolmap = require_module("pycolmap")
    (folder,) = exported(detailed_release, tmp_path, layout="colmap", points=200)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    about = json.loads((folder / "stereogenbench.json").read_text())
    scene_from_export = np.array(about["scene_from_export"])

    (lens,) = model.cameras.values()
    assert (about["scene"], about["frame"]) == ("train/IPD_Gaussian/SynthStage/scene_000000", 0)
    assert (lens.model.name, lens.width, lens.height) == ("PINHOLE", 160, 160)
    assert tuple(lens.params) == lens_of(moment)
    assert (len(model.images), len(model.points3D)) == (6, 6 * 200)
    for image in model.images.values():
        cam_from_export = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        scene_from_cam = scene_from_export @ np.linalg.inv(cam_from_export)
        expected = moment["world_from_cam"][int(image.name[4:6])].numpy()
        np.testing.assert_allclose(scene_from_cam, expected, atol=1e-9)
        assert (folder / "images" / image.name).is_file()
        for observed in image.points2D:
            landed = image.project_point(model.points3D[observed.point3D_id].xyz)
            assert np.abs(landed - observed.xy).max() < CLOSE_PX
    for point in model.points3D.values():
        # The first is the pixel that the point is made of.
        first = point.track.elements[0]
        image = model.images[first.image_id]
        camera, (u, v) = int(image.name[4:6]), image.points2D[first.point2D_idx].xy
        column, row = int(u), int(v)
        assert (u, v) == (column + 0.5, row + 0.5)
        assert moment["image"][camera, :, row, column].tolist() == point.color.tolist()
        depth_m = (image.cam_from_world() * point.xyz)[2]
        assert abs(depth_m - moment["depth"][camera, 0, row, column].item()) < 1e-9


@pytest.fixture(scope="module")
def transforms(detailed_release, tmp_path_factory):
    """An export for nerfstudio of every measured pixel, smaller than stored.

    Its folder, what its file says, and the views that it is of.
    """
    out, size = tmp_path_factory.mktemp("transforms"), (80, 120)
    (folder,) = exported(detailed_release, out, layout="transforms", points="all", size=size)
    moment = SceneViews(detailed_release, size=size)[0]
    return folder, json.loads((folder / "transforms.json").read_text()), moment


def test_points_of_transforms_project_onto_the_pixels_they_are_of(transforms):
    folder, about, moment = transforms
    lens = tuple(about[name] for name in ("fl_x", "fl_y", "cx", "cy"))
    assert lens == lens_of(moment)
    world, colours = read_ply(folder / about["ply_file_path"])
    for camera, frame in enumerate(about["frames"]):
        # OpenGL: x right, y up, z back; so a point ahead has a negative z.
        cam_from_world = np.diag([1, -1, -1, 1]) @ np.linalg.inv(frame["transform_matrix"])
        pixels = pixels_of_first(world, moment["depth"][camera, 0], cam_from_world, lens)
        columns, rows = pixels.astype(int).T
        picture = moment["image"][camera].permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(colours[: len(pixels)], picture[rows, columns])
        world, colours = world[len(pixels) :], colours[len(pixels) :]
    assert len(world) == 0


def test_transforms_name_pictures_depth_in_millimetres_and_a_world_whose_z_is_up(transforms):
    folder, about, moment = transforms
    applied = np.array(about["applied_transform"])

    assert (about["w"], about["h"], about["camera_model"]) == (120, 80, "OPENCV")
    for camera, frame in enumerate(about["frames"]):
        with Image.open(folder / frame["file_path"]) as picture:
            expected = moment["image"][camera].permute(1, 2, 0)
            np.testing.assert_array_equal(np.asarray(picture), expected)
        depth_mm = np.load(folder / frame["depth_file_path"], allow_pickle=False)
        assert depth_mm.dtype == np.float32
        np.testing.assert_allclose(depth_mm, moment["depth"][camera, 0] * 1000, rtol=1e-6)
        pose = np.array(frame["transform_matrix"])
        scene = moment["world_from_cam"][camera].numpy()
        np.testing.assert_allclose(applied[:, :3] @ scene[:3, :3] * (1, -1, -1), pose[:3, :3])
        centre = applied[:, :3] @ scene[:3, 3] + applied[:, 3]
        np.testing.assert_allclose(centre, pose[:3, 3], atol=1e-9)
    np.testing.assert_allclose(applied[:, :3] @ (0, -1, 0), (0, 0, 1))  # up is -y in the scene
    assert np.linalg.det(applied[:, :3]) == pytest.approx(1)


@pytest.mark.parametrize("contract", [None, DepthEncoding(unit_m=0.02, kind="ray")], ids=str)
def test_points_of_a_cloud_lie_on_their_pixels_at_the_depth_of_the_contract(
    detailed_release, tmp_path, contract
):
    (folder,) = exported(
        detailed_release, tmp_path, layout="ply", depth=contract, points="all", cameras=(3, 1)
    )
    moment = SceneViews(detailed_release, depth=contract)[0]
    world, _ = read_ply(folder / "points.ply")
    about = json.loads((folder / "stereogenbench.json").read_text())
    export_from_scene = np.linalg.inv(about["scene_from_export"])
    for camera in (3, 1):
        export_from_cam = export_from_scene @ moment["world_from_cam"][camera].numpy()
        cam_from_export = np.linalg.inv(export_from_cam)
        depth = moment["depth"][camera, 0]
        world = world[len(pixels_of_first(world, depth, cam_from_export, lens_of(moment))) :]
    assert len(world) == 0


@pytest.mark.parametrize("layout", ["colmap", "ply"])
def test_what_was_exported_before_is_kept(indexed_release, tmp_path, layout):
    options = {"layout": layout, "frames": [0, 4], "size": (32, 32)}
    folders = exported(indexed_release, tmp_path, **options)
    whole = files_of(tmp_path)
    kept = {folder: folder.stat().st_mtime_ns for folder in folders[1:]}
    shutil.rmtree(folders[0])
    leftover = folders[0].with_name(f".{folders[0].name}.unfinished")
    leftover.mkdir()
    (leftover / "half").write_bytes(b"half")

    counts = []
    again = exported(
        indexed_release, tmp_path, progress=lambda *done: counts.append(done), **options
    )
    assert again == folders
    assert files_of(tmp_path) == whole
    assert {folder: folder.stat().st_mtime_ns for folder in folders[1:]} == kept
    assert counts[0] == (30, 36)


def test_an_export_that_was_killed_goes_on_and_is_whole(indexed_release, tmp_path):
    options = {"layout": "transforms", "frames": [0, 2, 4], "points": 500, "family": "Uniform"}
    expected, killed = tmp_path / "expected", tmp_path / "killed"
    exported(indexed_release, expected, **options)

    assert killed_fork(lambda: exported(indexed_release, killed, progress=kill_at(12), **options))
    assert [*killed.rglob("frame_*/transforms.json")]
    assert [*killed.rglob(".frame_*.unfinished")]
    for folder in killed.rglob("frame_*"):
        assert folder.suffix or (folder / "transforms.json").is_file()
    assert len(exported(indexed_release, killed, **options)) == 6
    assert files_of(killed) == files_of(expected)


def test_a_folder_holds_one_kind_of_export_of_the_same_data(
    indexed_release, detailed_release, tmp_path
):
    options = {"layout": "colmap", "size": (16, 16), "points": 5}
    exported(indexed_release, tmp_path, **options)

    for name, changed in (
        ("layout", {"layout": "ply"}),
        ("size", {"size": (20, 20)}),
        ("points", {"points": 7}),
        ("cameras", {"cameras": (0, 1)}),
        ("split: .*'train'.*'eval'", {"split": "eval"}),
        ("depth", {"depth": DepthEncoding(unit_m=0.5)}),
    ):
        with pytest.raises(StorageError, match=rf"an export of other {name}.*another folder"):
            exported(indexed_release, tmp_path, **(options | changed))
    with pytest.raises(StorageError, match=r"other data: .*another folder"):
        exported(detailed_release, tmp_path, **options)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"layout": "colmap", "frames": ("clips", 3)}, SelectionError, r"are clips: exports take"),
        ({"layout": "nerf"}, SelectionError, r"layout must be one of 'colmap'.*got 'nerf'"),
        ({"layout": "ply", "points": 0}, SelectionError, r"points must be .* 'all', got 0"),
        ({"layout": "ply", "points": True}, SelectionError, r"points must be .*got True"),
        ({"layout": "ply", "family": "none"}, SelectionError, r"family none matches none"),
        ({"layout": "ply", "colour": "red"}, SelectionError, r"no option 'colour'"),
        ({"layout": "ply", "cameras": (0, 6)}, SelectionError, r"cameras must be"),
        ({"layout": "ply", "size": (0, 5)}, FieldError, r"size must be"),
    ],
)
def test_what_cannot_be_exported_is_refused_before_anything_is_written(
    indexed_release, tmp_path, options, error, message
):
    with pytest.raises(error, match=message):
        exported(indexed_release, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_a_missing_video_is_named_and_nothing_half_is_left(indexed_release, tmp_path):
    release = tmp_path / "release"
    shutil.copytree(indexed_release, release)
    scene = release / "train" / "Uniform" / "SynthStage" / "scene_000001"
    index = SceneIndex.open(release)
    (scene / "cam_04_rgb.mp4").unlink()

    with pytest.raises(StorageError, match=r"scene_000001.*cam_04_rgb"):
        exported(index, tmp_path / "out", layout="ply", size=(16, 16))
    assert not [*(tmp_path / "out").rglob("*.unfinished")]


rotations = st.tuples(*[st.floats(-1, 1) for _ in range(4)]).filter(
    lambda numbers: np.linalg.norm(numbers) > 0.1
)


@given(rotations)
def test_a_quaternion_gives_its_rotation_back(numbers):
    rotation = rotation_from_quaternion_xyzw(np.array(numbers))
    w, x, y, z = quaternion_wxyz(rotation)

    assert w >= 0
    back = rotation_from_quaternion_xyzw(np.array([x, y, z, w]))
    np.testing.assert_allclose(back, rotation, atol=1e-14)


@pytest.mark.parametrize("axis", np.eye(3), ids="xyz")
def test_half_a_turn_has_a_quaternion(axis):
    quaternion = np.abs(quaternion_wxyz(2 * np.outer(axis, axis) - np.eye(3)))

    np.testing.assert_allclose(quaternion, [0, *axis], atol=1e-15)
