"""Views for DUSt3R and VGGT: what their own code makes of them lies on the right points."""

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from stereogenbench_data import SceneViews, StereoPairs
from stereogenbench_data.bridges.multiview import (
    PAIR_FIELDS,
    VIEW_FIELDS,
    dust3r_views,
    posed_images,
    vggt_record,
)
from stereogenbench_data.errors import FieldError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
TRAIN = {"split": "train"}


def points_at(centre_px, depth, intrinsics):
    """Return the points of a depth map, in camera axes, by code that puts centres somewhere."""
    height, width = depth.shape
    v, u = np.mgrid[:height, :width] + centre_px
    x = (u - intrinsics[0, 2]) * depth / intrinsics[0, 0]
    y = (v - intrinsics[1, 2]) * depth / intrinsics[1, 1]
    return np.stack([x, y, depth], axis=-1)


def moved(points, motion):
    return points @ motion[:3, :3].T + motion[:3, 3]


@pytest.fixture(scope="module")
def moment(detailed_release):
    """The six views of one moment, and their points in a world whose origin is camera 0."""
    sample = SceneViews(detailed_release)[0]
    poses = sample["world_from_cam"].numpy().copy()
    poses[:, :3, 3] -= poses[0, :3, 3]
    intrinsics = sample["intrinsics"].numpy()
    truth = [
        moved(points_at(0.5, depth.numpy().astype(np.float64), intrinsics), pose)
        for depth, pose in zip(sample["depth"][:, 0], poses, strict=True)
    ]
    return sample, truth


def test_what_dust3r_unprojects_at_whole_pixels_are_the_points_of_the_scene(moment):
    sample, truth = moment

    away = dict(sample) | {"world_from_cam": sample["world_from_cam"].clone()}
    away["world_from_cam"][:, :3, 3] += 1e6  # which float32 would round to 0.06 m
    for given in (sample, away):
        for view, points, valid in zip(dust3r_views(given), truth, sample["valid"], strict=True):
            cam = points_at(0.0, view["depthmap"], view["camera_intrinsics"])
            apart = np.abs(moved(cam, view["camera_pose"]) - points)
            assert apart[valid[0].numpy()].max() < 1e-5
            np.testing.assert_array_equal(view["depthmap"] > 0, valid[0].numpy())


def test_a_view_of_dust3r_is_its_picture_with_the_types_that_its_base_class_demands(moment):
    view = dust3r_views(moment[0])[2]

    assert isinstance(view["img"], Image.Image)
    np.testing.assert_array_equal(np.asarray(view["img"]), moment[0]["image"][2].permute(1, 2, 0))
    assert (view["img"].mode, view["img"].size) == ("RGB", view["depthmap"].shape[::-1])
    for name in ("depthmap", "camera_pose", "camera_intrinsics"):
        assert view[name].dtype == np.float32
        assert np.isfinite(view[name]).all()
    assert (view["camera_pose"].shape, view["camera_intrinsics"].shape) == ((4, 4), (3, 3))
    assert view["label"] == "train/IPD_Gaussian/SynthStage/scene_000000/000"
    assert (view["dataset"], view["instance"]) == ("StereoGenBench", "cam_02")


def test_a_point_of_the_left_view_lands_a_disparity_to_the_left_in_the_right_one(
    detailed_release,
):
    pairs = {"pairs": [(1, 4)], "size": (120, 152)}
    left, right = dust3r_views(StereoPairs(detailed_release, fields=PAIR_FIELDS, **pairs)[0])
    sample = StereoPairs(detailed_release, fields=("disparity", "valid"), **pairs)[0]
    world = moved(points_at(0.0, left["depthmap"], left["camera_intrinsics"]), left["camera_pose"])
    cam = moved(world, np.linalg.inv(right["camera_pose"].astype(np.float64)))
    pixels = cam @ right["camera_intrinsics"].T
    with np.errstate(invalid="ignore", divide="ignore"):
        pixels = pixels[..., :2] / pixels[..., 2:]
    rows, columns = np.nonzero(sample["valid"][0].numpy())

    expected = columns - sample["disparity"][0].numpy()[rows, columns]
    assert np.abs(pixels[rows, columns, 0] - expected).max() < 0.01
    assert np.abs(pixels[rows, columns, 1] - rows).max() < 0.01


def test_a_single_view_is_taken_and_samples_of_other_forms_are_refused(indexed_release):
    single = SceneViews(indexed_release, cameras="each", fields=VIEW_FIELDS)[3]
    (image,) = posed_images(single)
    assert (image.camera, image.name, image.size) == (3, "cam_03_frame_000", (64, 64))

    for sample, message in (
        (StereoPairs(indexed_release)[0], r"has no .*world_from_left.*load pair with fields="),
        (
            SceneViews(indexed_release, fields=VIEW_FIELDS, frames=("clips", 2))[0],
            r"not clips, sweeps or batches",
        ),
        (
            StereoPairs(indexed_release, fields=PAIR_FIELDS, pairs="sweep")[0],
            r"not clips, sweeps or batches",
        ),
    ):
        with pytest.raises(FieldError, match=message):
            posed_images(sample)


def example(monkeypatch, name, module, base):
    """Return the class of an example, above what stands for the project's own base class."""
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:count]), ModuleType(parts[count - 1]))
    setattr(sys.modules[module], base.__name__, base)
    return runpy.run_path(str(EXAMPLES / name))["StereoGenBench"]


class BaseStereoViewDataset:
    """What the example uses of DUSt3R's base class: keyword options, and a method that crops.

    Of CUT3R's besides: a number of views, which each item may ask for, and masks.
    """

    def __init__(self, *, split=None, resolution=None, num_views=2):
        self.split, self.num_views = split, num_views
        self._resolution = resolution

    def __getitem__(self, item):
        number, *count = item if isinstance(item, tuple) else (item,)
        views = self._get_views(number, self._resolution, np.random.default_rng(number), *count)
        assert len(views) == (count or [self.num_views])[0]
        return views

    def _crop_resize_if_necessary(self, image, depthmap, intrinsics, resolution, rng, info):
        width, height = resolution
        assert info[1] < self.num_views
        cropped = intrinsics.astype(np.float64)
        cropped[:2, 2] -= 4
        box = (4, 4, 4 + width, 4 + height)
        return image.crop(box), depthmap[4 : 4 + height, 4 : 4 + width], cropped

    def get_img_and_ray_masks(self, is_metric, number, rng):
        assert is_metric
        return number == 0, number > 0


@pytest.fixture
def trained_on_dust3r(monkeypatch):
    module = "dust3r.datasets.base.base_stereo_view_dataset"
    return example(monkeypatch, "dust3r_dataset.py", module, BaseStereoViewDataset)


def test_dust3rs_base_class_crops_the_views(indexed_release, trained_on_dust3r):
    pairs = StereoPairs(indexed_release, pairs="adjacent", fields=PAIR_FIELDS, **TRAIN)
    dataset = trained_on_dust3r(pairs, split="train", resolution=(48, 32))
    whole, cropped = dust3r_views(pairs[7]), dataset[7]

    moments = SceneViews(indexed_release, fields=VIEW_FIELDS, **TRAIN)
    assert len(trained_on_dust3r(moments, resolution=(16, 16))[0]) == 6
    assert (len(dataset), dataset.split) == (len(pairs), "train")
    for before, after in zip(whole, cropped, strict=True):
        assert after["img"].size == (48, 32)
        np.testing.assert_array_equal(after["depthmap"], before["depthmap"][4:36, 4:52])
        assert after["camera_intrinsics"].dtype == np.float32
        assert after["camera_intrinsics"][0, 2] == before["camera_intrinsics"][0, 2] - 4


def test_cut3r_is_given_as_many_views_of_a_moment_as_it_asks_for(
    indexed_release, trained_on_dust3r
):
    views = SceneViews(indexed_release, frames="all", fields=VIEW_FIELDS, **TRAIN)
    dataset = trained_on_dust3r(views, num_views=4, resolution=(16, 16))
    drawn = [dataset[number, 3] for number in range(8)]

    assert dataset.num_views == 4
    assert len({tuple(view["instance"] for view in views) for views in drawn}) > 1
    for found in drawn:
        assert len({view["instance"] for view in found}) == 3
        assert [view["img_mask"] for view in found] == [True, False, False]
        assert [view["ray_mask"] for view in found] == [False, True, True]
        assert all(view["is_metric"] and not view["is_video"] for view in found)
        assert found[0]["quantile"].dtype == np.float32


@pytest.mark.parametrize("centre_px", [0.0, 0.5])
def test_vggt_unprojects_to_the_points_of_the_record(moment, centre_px):
    sample, truth = moment
    record = vggt_record(sample, pixel_centre_px=centre_px)

    for number, points in enumerate(truth):
        cam = points_at(centre_px, record["depths"][number], record["intrinsics"][number])
        rotation, step = np.split(record["extrinsics"][number], [3], axis=1)
        world = (cam - step[:, 0]) @ rotation
        mask = record["point_masks"][number]
        np.testing.assert_array_equal(mask, sample["valid"][number, 0])
        assert np.abs(record["cam_points"][number] - cam).max() < 1e-5
        for found in (world, record["world_points"][number]):
            assert np.abs(found - points)[mask].max() < 1e-5


def test_a_record_of_vggt_stacks_the_views_of_its_ids_as_its_composed_dataset_does(indexed_release):
    ids, sample = [3, 0, 5, 3], SceneViews(indexed_release, size=(32, 48), frames=[5], **TRAIN)[1]
    record = vggt_record(sample, ids=ids)
    expected = {
        "images": ((4, 32, 48, 3), np.uint8),
        "depths": ((4, 32, 48), np.float32),
        "extrinsics": ((4, 3, 4), np.float64),
        "intrinsics": ((4, 3, 3), np.float64),
        "cam_points": ((4, 32, 48, 3), np.float32),
        "world_points": ((4, 32, 48, 3), np.float32),
        "point_masks": ((4, 32, 48), np.bool_),
        "original_sizes": ((4, 2), np.int64),
    }

    for name, (shape, dtype) in expected.items():
        stacked = np.stack(record[name])
        assert (stacked.shape, stacked.dtype) == (shape, dtype), name
    np.testing.assert_array_equal(np.stack(record["images"]), sample["image"][ids].movedim(1, -1))
    assert torch.from_numpy(record["ids"]).tolist() == ids
    assert (record["frame_num"], record["tracks"]) == (4, None)
    assert record["seq_name"] == "StereoGenBench_train/Uniform/SynthStage/scene_000000/005"
    centre = -record["extrinsics"][0][:, :3].T @ record["extrinsics"][0][:, 3]
    assert np.abs(centre).max() < 1e-12


class BaseDataset:
    """What the example uses of VGGT's base class: the target's shape, and a method that crops."""

    def __init__(self, common_conf):
        self.img_size = common_conf.img_size

    def __len__(self):
        return self.len_train

    def __getitem__(self, item):
        seq_index, img_per_seq, aspect_ratio = item
        return self.get_data(
            seq_index=seq_index, img_per_seq=img_per_seq, aspect_ratio=aspect_ratio
        )

    def get_target_shape(self, aspect_ratio):
        return np.array([int(self.img_size * aspect_ratio), self.img_size])

    def process_one_image(  # theirs
        self, image, depth_map, extri_opencv, intri_opencv, original_size, target_image_shape,
        track=None,
    ):  # fmt: skip
        assert tuple(original_size) == image.shape[:2] == depth_map.shape
        assert self.training in (True, False)
        height, width = target_image_shape
        depth = depth_map[:height, :width]
        cam = points_at(0.0, depth, intri_opencv)
        world = (cam - extri_opencv[:, 3]) @ extri_opencv[:, :3]
        picture = image[:height, :width]
        return picture, depth, extri_opencv, intri_opencv, world, cam, depth > 0, track


def test_vggts_base_class_crops_the_views(indexed_release, monkeypatch):
    trained = example(monkeypatch, "vggt_dataset.py", "data.base_dataset", BaseDataset)
    usual = SimpleNamespace(
        img_size=32, training=True, inside_random=False, allow_duplicate_img=True
    )
    dataset = trained(usual, indexed_release, len_train=100)
    record = dataset[17, 3, 0.5]
    moment = SceneViews(indexed_release, fields=VIEW_FIELDS, **TRAIN)[17 % 3]
    plain = vggt_record(moment, ids=record["ids"])

    assert len(dataset) == 100
    for number in range(3):
        assert record["images"][number].shape == (16, 32, 3)
        for name in ("images", "depths", "point_masks", "world_points", "cam_points"):
            np.testing.assert_allclose(
                record[name][number], plain[name][number][:16, :32], rtol=1e-5, atol=1e-5
            )
        assert record["original_sizes"][number].tolist() == [64, 64]
