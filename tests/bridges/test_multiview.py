"""Views for DUSt3R and VGGT: what their own code makes of them lies on the right points."""

import runpy
import sys
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from stereogenbench_data import SceneViews, StereoPairs
from stereogenbench_data.bridges.multiview import (
    DUSt3RViews,
    VGGTViews,
    dust3r_views,
)
from stereogenbench_data.bridges.posed_images import PAIR_FIELDS, VIEW_FIELDS, posed_images
from stereogenbench_data.errors import FieldError, SelectionError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
UNIFORM = {"family": "Uniform"}


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

    for view, points, valid in zip(dust3r_views(sample), truth, sample["valid"][:, 0], strict=True):
        found = moved(
            points_at(0.0, view["depthmap"], view["camera_intrinsics"]), view["camera_pose"]
        )
        assert np.abs(found - points)[valid.numpy()].max() < 1e-5
        np.testing.assert_array_equal(view["depthmap"] > 0, valid.numpy())


def test_a_view_of_dust3r_has_the_types_that_its_base_class_demands(moment):
    view = dust3r_views(moment[0])[2]

    assert isinstance(view["img"], Image.Image)
    assert (view["img"].mode, view["img"].size) == ("RGB", view["depthmap"].shape[::-1])
    for name in ("depthmap", "camera_pose", "camera_intrinsics"):
        assert view[name].dtype == np.float32
        assert np.isfinite(view[name]).all()
    assert (view["camera_pose"].shape, view["camera_intrinsics"].shape) == ((4, 4), (3, 3))
    assert view["label"] == "train/IPD_Gaussian/SynthStage/scene_000000/000"
    assert (view["dataset"], view["instance"]) == ("StereoGenBench", "cam_02")


def test_the_pictures_of_dust3r_are_those_of_the_sample(moment):
    for view, picture in zip(dust3r_views(moment[0]), moment[0]["image"], strict=True):
        np.testing.assert_array_equal(np.asarray(view["img"]), picture.permute(1, 2, 0))


def test_a_point_of_the_left_view_lands_a_disparity_to_the_left_in_the_right_one(
    detailed_release,
):
    pairs = {"pairs": [(1, 4)], "size": (120, 152)}
    left, right = DUSt3RViews(detailed_release, **pairs)[0]
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


@pytest.mark.parametrize("far_m", [1e4, 1e6])
def test_a_scene_far_from_the_origin_keeps_its_points_in_float32(moment, far_m):
    sample, truth = moment
    away = dict(sample) | {"world_from_cam": sample["world_from_cam"].clone()}
    away["world_from_cam"][:, :3, 3] += far_m

    for view, points, valid in zip(dust3r_views(away), truth, sample["valid"][:, 0], strict=True):
        found = moved(
            points_at(0.0, view["depthmap"], view["camera_intrinsics"]), view["camera_pose"]
        )
        assert np.abs(found - points)[valid.numpy()].max() < 1e-5


def test_pairs_are_those_of_the_selection(indexed_release):
    options = {"pairs": "all", "frames": "all", "baseline_cm": (0, 8)}
    views = DUSt3RViews(indexed_release, **options)
    pairs = StereoPairs(indexed_release, split="train", **options)

    assert (len(views), views.num_views) == (len(pairs), 2)
    for number in range(0, len(pairs), 5):
        cameras = [view["instance"] for view in views[number]]
        assert cameras == [f"cam_{camera:02d}" for camera in pairs[number]["pair"]]


def test_several_cameras_make_one_list(indexed_release):
    views = DUSt3RViews(indexed_release, cameras=(4, 0, 2), frames=[3], **UNIFORM)

    assert (len(views), views.num_views) == (2, 3)
    assert [view["instance"] for view in views[1]] == ["cam_04", "cam_00", "cam_02"]
    np.testing.assert_array_equal(views[1][0]["camera_pose"][:3, 3], 0)


@pytest.fixture(scope="module")
def evaluation_release(indexed_release, tmp_path_factory):
    """The same tree without its training scenes."""
    root = tmp_path_factory.mktemp("evaluation")
    (root / "eval").symlink_to(indexed_release / "eval")
    return root


@pytest.mark.parametrize("views_of", [DUSt3RViews, VGGTViews])
def test_evaluation_scenes_are_left_out_unless_they_are_asked_for(
    indexed_release, evaluation_release, views_of
):
    assert len(views_of(indexed_release)) == 3
    assert len(views_of(indexed_release, split="eval")) == 1
    assert len(views_of(indexed_release, split=("train", "eval"))) == 4
    assert len(views_of(evaluation_release, split="eval")) == 1
    with pytest.raises(SelectionError, match=r"only evaluation scenes \(1\).*split='eval'"):
        views_of(evaluation_release)


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        (lambda data: StereoPairs(data)[0], r"has no .*world_from_left.*load pair with fields="),
        (
            lambda data: SceneViews(data, fields=VIEW_FIELDS, frames=("clips", 2))[0],
            r"frames of shape \(2,\)",
        ),
        (
            lambda data: StereoPairs(data, fields=PAIR_FIELDS, pairs="sweep")[0],
            r"not sweeps",
        ),
    ],
    ids=["fields", "clip", "sweep"],
)
def test_samples_of_another_form_are_refused(indexed_release, sample, message):
    with pytest.raises(FieldError, match=message):
        posed_images(sample(indexed_release))


def test_a_single_view_is_a_list_of_one(indexed_release):
    sample = SceneViews(indexed_release, cameras="each", fields=VIEW_FIELDS)[3]
    (image,) = posed_images(sample)

    assert (image.camera, image.name, image.size) == (3, "cam_03_frame_000", (64, 64))


def example(monkeypatch, name, module, base):
    """Return the class of an example, above what stands for the project's own base class."""
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:count]), ModuleType(parts[count - 1]))
    setattr(sys.modules[module], base.__name__, base)
    return runpy.run_path(str(EXAMPLES / name))["StereoGenBench"]


class BaseStereoViewDataset:
    """What the example uses of DUSt3R's base class: keyword options, and a method that crops."""

    def __init__(self, *, split=None, resolution=None):
        self.split, self.num_views = split, 2
        self._resolution = resolution

    def __getitem__(self, number):
        views = self._get_views(number, self._resolution, np.random.default_rng(0))
        assert len(views) == self.num_views
        return views

    def _crop_resize_if_necessary(self, image, depthmap, intrinsics, resolution, rng, info):
        width, height = resolution
        assert info[1] < self.num_views
        cropped = intrinsics.astype(np.float64)
        cropped[:2, 2] -= 4
        box = (4, 4, 4 + width, 4 + height)
        return image.crop(box), depthmap[4 : 4 + height, 4 : 4 + width], cropped


@pytest.fixture
def trained_on_dust3r(monkeypatch):
    module = "dust3r.datasets.base.base_stereo_view_dataset"
    return example(monkeypatch, "dust3r_dataset.py", module, BaseStereoViewDataset)


def test_dust3rs_base_class_crops_the_views(indexed_release, trained_on_dust3r):
    views = DUSt3RViews(indexed_release, pairs="adjacent")
    dataset = trained_on_dust3r(views, split="train", resolution=(48, 32))
    whole, cropped = views[7], dataset[7]

    assert (len(dataset), dataset.split) == (len(views), "train")
    for before, after in zip(whole, cropped, strict=True):
        assert after["img"].size == (48, 32)
        np.testing.assert_array_equal(after["depthmap"], before["depthmap"][4:36, 4:52])
        assert after["camera_intrinsics"].dtype == np.float32
        assert after["camera_intrinsics"][0, 2] == before["camera_intrinsics"][0, 2] - 4


def test_more_than_two_views_are_what_the_base_expects(indexed_release, trained_on_dust3r):
    views = DUSt3RViews(indexed_release, cameras="all")

    assert len(trained_on_dust3r(views, resolution=(16, 16))[0]) == 6


class CUT3RBase(BaseStereoViewDataset):
    """What the example uses of CUT3R's base class besides: the number of views, and masks."""

    def __init__(self, *, num_views=None, **options):
        super().__init__(**options)
        self.num_views = num_views

    def __getitem__(self, item):
        number, count = item
        return self._get_views(number, self._resolution, np.random.default_rng(number), count)

    def get_img_and_ray_masks(self, is_metric, number, rng):
        assert is_metric
        return number == 0, number > 0


def test_cut3r_is_given_as_many_views_of_a_moment_as_it_asks_for(indexed_release, monkeypatch):
    views = DUSt3RViews(indexed_release, cameras="all", frames="all")
    base = type("BaseStereoViewDataset", (CUT3RBase,), {})
    module = "dust3r.datasets.base.base_stereo_view_dataset"
    dataset = example(monkeypatch, "dust3r_dataset.py", module, base)(
        views, num_views=4, resolution=(16, 16)
    )
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
def test_vggt_unprojects_to_the_points_of_the_record(detailed_release, moment, centre_px):
    sample, truth = moment
    record = VGGTViews(detailed_release, pixel_centre_px=centre_px).get_data(seq_index=0)

    for number, points in enumerate(truth):
        cam = points_at(centre_px, record["depths"][number], record["intrinsics"][number])
        rotation, step = np.split(record["extrinsics"][number], [3], axis=1)
        world = (cam - step[:, 0]) @ rotation
        mask = record["point_masks"][number]
        np.testing.assert_array_equal(mask, sample["valid"][number, 0])
        assert np.abs(record["cam_points"][number] - cam).max() < 1e-5
        for found in (world, record["world_points"][number]):
            assert np.abs(found - points)[mask].max() < 1e-5


def test_a_record_of_vggt_stacks_as_its_composed_dataset_stacks_it(indexed_release):
    record = VGGTViews(indexed_release, size=(32, 48)).get_data(seq_index=1, img_per_seq=4)
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
    assert torch.from_numpy(record["ids"]).shape == (4,)
    assert record["frame_num"] == 4
    assert record["tracks"] is None
    assert record["seq_name"] == "StereoGenBench_train/Uniform/SynthStage/scene_000000/000"


def test_views_are_drawn_by_torchs_generator_without_repeats_while_there_are_enough(
    indexed_release,
):
    views = VGGTViews(indexed_release)
    draws = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        draws.append(views.get_data(seq_index=0, img_per_seq=5)["ids"].tolist())
        assert len(set(draws[-1])) == 5

    assert draws[0] == draws[1] != draws[2]
    torch.manual_seed(0)
    assert len(views.get_data(seq_index=0, img_per_seq=9)["ids"]) == 9


def test_the_views_of_a_record_are_those_of_its_ids(indexed_release):
    views = VGGTViews(indexed_release, sequence="scene", frames=[1, 5], **UNIFORM)
    record = views.get_data(seq_index=1, ids=[7, 0, 7])
    expected = SceneViews(indexed_release, frames=[1, 5], split="train", **UNIFORM)

    np.testing.assert_array_equal(record["images"][1], expected[2]["image"][0].permute(1, 2, 0))
    for place in (0, 2):
        picture = expected[3]["image"][1].permute(1, 2, 0)
        np.testing.assert_array_equal(record["images"][place], picture)
    centre = -record["extrinsics"][0][:, :3].T @ record["extrinsics"][0][:, 3]
    assert np.abs(centre).max() < 1e-12


def test_a_scene_as_a_sequence_has_all_its_frames(indexed_release):
    scenes = VGGTViews(indexed_release, sequence="scene", frames="all", cameras=(0, 5))
    moments = VGGTViews(indexed_release, frames="all", cameras=(0, 5))

    assert (len(scenes), scenes.view_count(0), len(moments), moments.view_count(0)) == (
        3,
        14,
        21,
        2,
    )
    assert scenes.sequence_name(2) == "train/Uniform/SynthStage/scene_000001"
    assert moments.sequence_name(20) == "train/Uniform/SynthStage/scene_000001/006"


@pytest.mark.parametrize("sequence", ["moment", "scene"])
def test_a_sequence_is_found_by_its_name(indexed_release, sequence):
    views = VGGTViews(indexed_release, sequence=sequence, frames=[0, 3, 5])

    for number in range(len(views)):
        by_number = views.get_data(seq_index=number, ids=[2])
        by_name = views.get_data(seq_name=by_number["seq_name"], ids=[2])
        assert by_name["seq_name"] == by_number["seq_name"]
        np.testing.assert_array_equal(by_name["images"][0], by_number["images"][0])


def test_numbers_beyond_the_last_sequence_begin_anew(indexed_release):
    views = VGGTViews(indexed_release)

    assert (
        views.get_data(seq_index=3, ids=[0])["seq_name"]
        == views.get_data(seq_index=0, ids=[0])["seq_name"]
    )


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"seq_index": 0, "ids": [6]}, r"has views 0 to 5, got ids=\[6\]"),
        ({"seq_index": 0, "ids": []}, r"has views 0 to 5, got ids=\[\]"),
        ({"seq_index": 0, "img_per_seq": 0}, r"img_per_seq must be at least 1, got 0"),
        ({"seq_name": "StereoGenBench_train/none/000"}, r"no sequence .*the first of 3"),
        ({"seq_name": "eval/MapSeenInTrain/Uniform/SynthStage/scene_000000/000"}, r"no sequence"),
        ({}, r"give seq_index or seq_name"),
    ],
)
def test_what_a_sequence_does_not_have_is_refused(indexed_release, asked, message):
    with pytest.raises(SelectionError, match=message):
        VGGTViews(indexed_release).get_data(**asked)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sequence": "clip"}, r"'moment' or 'scene', got 'clip'"),
        ({"frames": ("clips", 3)}, r"clips.*sequence='scene'"),
        ({"cameras": (0, 9)}, r"cameras must be"),
    ],
)
def test_sequences_that_cannot_be_made_are_refused(indexed_release, options, message):
    with pytest.raises(SelectionError, match=message):
        VGGTViews(indexed_release, **options)


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


@pytest.fixture
def trained_on_vggt(monkeypatch):
    return example(monkeypatch, "vggt_dataset.py", "data.base_dataset", BaseDataset)


def configuration(**changed):
    usual = {"img_size": 32, "training": True, "inside_random": False, "allow_duplicate_img": True}
    return SimpleNamespace(**(usual | changed))


def test_vggts_base_class_crops_the_views(indexed_release, trained_on_vggt):
    views = VGGTViews(indexed_release)
    dataset = trained_on_vggt(configuration(), views=views, len_train=100)
    record = dataset[17, 3, 0.5]
    plain = views.get_data(seq_index=17, ids=record["ids"])

    assert len(dataset) == 100
    for number in range(3):
        assert record["images"][number].shape == (16, 32, 3)
        for name in ("images", "depths", "point_masks", "world_points", "cam_points"):
            np.testing.assert_allclose(
                record[name][number], plain[name][number][:16, :32], rtol=1e-5, atol=1e-5
            )
        assert record["original_sizes"][number].tolist() == [64, 64]


def test_vggts_configuration_decides_whether_views_are_drawn_twice(
    indexed_release, trained_on_vggt
):
    views = VGGTViews(indexed_release)
    once = trained_on_vggt(configuration(allow_duplicate_img=False), views=views)
    twice = trained_on_vggt(configuration(), views=views)

    assert sorted(once[0, 6, 1.0]["ids"].tolist()) == [0, 1, 2, 3, 4, 5]
    assert len(twice[0, 24, 1.0]["ids"]) == 24
    assert any(len(set(twice[0, 6, 1.0]["ids"].tolist())) < 6 for _ in range(20))


def test_vggts_configuration_decides_whether_the_number_of_a_sequence_counts(
    indexed_release, trained_on_vggt
):
    dataset = trained_on_vggt(configuration(inside_random=True), views=VGGTViews(indexed_release))
    torch.manual_seed(0)

    assert len({dataset[0, 1, 1.0]["seq_name"] for _ in range(30)}) == 3


def test_workers_of_a_loader_draw_different_views(indexed_release):
    class Numbered(torch.utils.data.Dataset):
        def __len__(self):
            return 8

        def __getitem__(self, number):
            return views.get_data(seq_index=0, img_per_seq=4)["ids"]

    views = VGGTViews(indexed_release)
    loader = torch.utils.data.DataLoader(
        Numbered(), batch_size=4, num_workers=2, multiprocessing_context="fork"
    )

    first, second = (batch.tolist() for batch in loader)
    assert first != second


@pytest.mark.parametrize("views_of", [DUSt3RViews, VGGTViews])
def test_views_travel_to_processes_that_are_started_afresh(indexed_release, views_of):
    views = views_of(indexed_release, frames=[0, 1])
    travelled = ForkingPickler.loads(ForkingPickler.dumps(views))

    assert len(travelled) == len(views) == 6
    for each in (travelled, views):
        picture = (
            each[1][0]["img"] if views_of is DUSt3RViews else each.get_data(1, ids=[0])["images"][0]
        )
        assert np.asarray(picture).shape == (64, 64, 3)


def test_the_records_of_the_real_scene_are_those_of_its_views(shared_scenes):
    record = VGGTViews(shared_scenes, frames=[20]).get_data(seq_index=0)
    sample = SceneViews(shared_scenes, frames=[20])[0]

    for number in range(6):
        mask = record["point_masks"][number]
        np.testing.assert_array_equal(mask, sample["valid"][number, 0])
        cam = record["world_points"][number] @ record["extrinsics"][number][:, :3].T
        pixels = (cam + record["extrinsics"][number][:, 3]) @ record["intrinsics"][number].T
        rows, columns = np.nonzero(mask)
        landed = pixels[mask][:, :2] / pixels[mask][:, 2:]
        assert np.abs(landed - np.stack([columns, rows], axis=-1)).max() < 0.01
