"""Transforms keep a pair a pair: warping the right view by disparity still gives the left one."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from stereogenbench_data import (
    ColorJitter,
    Compose,
    Crop,
    Eraser,
    FieldError,
    HorizontalFlip,
    Letterbox,
    RandomCrop,
    RandomScale,
    Resize,
    StereoPairs,
)
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.samples.load import resized_nearest
from stereogenbench_data.samples.views import StoredDepth, Views

FIELDS = (
    "left", "right", "disparity", "valid", "visible", "depth", "disparity_right", "valid_right",
    "visible_right", "intrinsics", "baseline_m", "right_from_left", "world_from_left", "pair",
)  # fmt: skip


def warped_psnr_db(sample):
    """Sample the right view at x - d by scipy and compare with the left view where visible."""
    left, right = (sample[name].numpy().astype(np.float64) for name in ("left", "right"))
    disparity, visible = sample["disparity"][0].numpy(), sample["visible"][0].numpy()
    rows, columns = np.indices(disparity.shape)
    warped = np.stack(
        [
            ndimage.map_coordinates(channel, (rows, columns - disparity), order=1, mode="nearest")
            for channel in right
        ]
    )
    assert visible.mean() > 0.2
    return 10 * np.log10(255**2 / np.mean((warped - left)[:, visible] ** 2))


@pytest.fixture(scope="module")
def plain(detailed_release):
    return StereoPairs(detailed_release, fields=FIELDS)[0]


@pytest.mark.parametrize(
    "transform",
    [
        Resize(96, 160),
        Resize(200, 240),
        Letterbox(100, 200),
        Letterbox(200, 100),
        Crop(20, 31, 64, 80),
        RandomCrop(97, 101),
        RandomScale(-0.2, 0.4, stretch_probability=1.0),
        HorizontalFlip(1.0),
        Compose([HorizontalFlip(1.0), HorizontalFlip(1.0)]),
        Compose([RandomScale(at_least=(128, 128)), HorizontalFlip(1.0), RandomCrop(128, 128)]),
    ],
    ids=str,
)
def test_a_moved_pair_still_warps_onto_itself(detailed_release, plain, transform):
    moved = StereoPairs(detailed_release, fields=FIELDS, transform=transform)[0]

    assert warped_psnr_db(moved) > min(30, warped_psnr_db(plain)) - 1.5


@pytest.mark.parametrize("size", [(96, 160), (120, 64), (200, 200)])
def test_scaling_in_the_decoder_is_a_resize(detailed_release, plain, size):
    decoded = StereoPairs(detailed_release, fields=FIELDS, size=size)[0]
    resized = StereoPairs(detailed_release, fields=FIELDS, transform=Resize(*size))[0]

    for name in ("disparity", "valid", "depth", "intrinsics", "visible"):
        assert torch.equal(decoded[name], resized[name]), name
    assert warped_psnr_db(decoded) > min(30, warped_psnr_db(plain)) - 1.5


def test_disparity_scales_with_the_width_alone(plain, detailed_release):
    half = StereoPairs(detailed_release, fields=FIELDS, size=(160, 80))[0]

    nearest = resized_nearest(plain["disparity"].numpy(), size=(160, 80))
    np.testing.assert_allclose(half["disparity"].numpy(), nearest / 2, rtol=2e-7)
    assert float(half["intrinsics"][0, 0]) == float(plain["intrinsics"][0, 0]) / 2
    assert float(half["intrinsics"][1, 1]) == float(plain["intrinsics"][1, 1])


def test_a_flip_swaps_the_views_and_takes_the_right_ones_disparity(detailed_release, plain):
    flipped = StereoPairs(detailed_release, fields=FIELDS, transform=HorizontalFlip(1.0))[0]

    assert torch.equal(flipped["left"], plain["right"].flip(-1))
    assert torch.equal(flipped["right"], plain["left"].flip(-1))
    assert torch.equal(flipped["disparity"], plain["disparity_right"].flip(-1))
    assert torch.equal(flipped["valid"], plain["valid_right"].flip(-1))
    assert torch.equal(flipped["visible"], plain["visible_right"].flip(-1))
    assert flipped["baseline_m"] == plain["baseline_m"] > 0
    assert flipped["pair"].tolist() == plain["pair"].tolist()[::-1]
    assert float(flipped["intrinsics"][0, 2]) == 160 - float(plain["intrinsics"][0, 2])


def test_a_flipped_pairs_poses_are_those_of_a_rig_seen_in_a_mirror(detailed_release, plain):
    flipped = StereoPairs(detailed_release, fields=FIELDS, transform=HorizontalFlip(1.0))[0]
    step = flipped["right_from_left"].numpy()

    np.testing.assert_allclose(step[:3, 3], [-float(plain["baseline_m"]), 0, 0], atol=1e-9)
    np.testing.assert_allclose(step[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(flipped["world_from_left"].numpy()[:3, :3]) == pytest.approx(1)


def test_a_flip_reads_what_its_mirror_image_needs_though_no_field_names_it(detailed_release):
    flipped = StereoPairs(
        detailed_release, fields=("left", "disparity"), transform=HorizontalFlip(1.0)
    )[0]

    assert sorted(flipped) == ["disparity", "left"]


def test_letterbox_adds_black_that_is_not_measured(detailed_release):
    boxed = StereoPairs(detailed_release, fields=FIELDS, transform=Letterbox(80, 200))[0]

    outside = torch.ones(80, 200, dtype=torch.bool)
    outside[:, 60:140] = False
    for name in ("left", "disparity", "valid", "visible", "depth"):
        assert not boxed[name][..., outside].any(), name
    assert float(boxed["intrinsics"][0, 2]) == 100.0
    assert boxed["valid"][0, :, 60:140].float().mean() > 0.5


def test_nearest_takes_the_centre_that_torch_calls_nearest_exact():
    maps = np.random.default_rng(0).integers(0, 65536, (2, 37, 53)).astype(np.uint16)
    for size in ((20, 30), (37, 100), (74, 53), (1, 1), (11, 7)):
        expected = torch.nn.functional.interpolate(
            torch.from_numpy(maps.astype(np.float64))[None], size=size, mode="nearest-exact"
        )[0]

        assert np.array_equal(resized_nearest(maps, size=size), expected.numpy())


def made_views(height=40, width=60):
    generator = np.random.default_rng(1)
    pictures = {
        camera: generator.integers(0, 256, (2, 3, height, width)).astype(np.uint8)
        for camera in (0, 1)
    }
    units = generator.integers(1, 9, (2, height, width)).astype(np.uint16)
    return Views(
        source=0,
        targets=(1,),
        frames=(0, 1),
        pictures=pictures,
        depths={0: StoredDepth(units, units > 2)},
        intrinsics=Intrinsics(50.0, 50.0, width / 2, height / 2, width, height),
    )


def test_symmetric_jitter_changes_both_views_alike_and_asymmetric_apart():
    views = made_views()
    alike = Views(0, (1,), (0, 1), dict.fromkeys((0, 1), views.pictures[0]), {}, views.intrinsics)

    for probability, equal in ((0.0, True), (1.0, False)):
        jitter = ColorJitter(asymmetric_probability=probability)
        jittered = jitter(alike, np.random.default_rng(3))
        assert np.array_equal(jittered.pictures[0], jittered.pictures[1]) is equal
        assert not np.array_equal(jittered.pictures[0], views.pictures[0])


def test_jitter_of_nothing_changes_nothing():
    views = made_views()

    jittered = ColorJitter(0, 0, 0, 0)(views, np.random.default_rng(0))

    assert np.array_equal(jittered.pictures[0], views.pictures[0])


def test_a_third_of_a_turn_of_hue_takes_red_to_green():
    from stereogenbench_data.samples.transforms import _hue_rotation

    np.testing.assert_allclose(_hue_rotation(1 / 3) @ [1, 0, 0], [0, 1, 0], atol=1e-6)


def test_the_eraser_paints_on_the_second_view_alone():
    views = made_views()
    erased = Eraser(1.0, low=10, high=20)(views, np.random.default_rng(0))

    assert np.array_equal(erased.pictures[0], views.pictures[0])
    changed = (erased.pictures[1] != views.pictures[1]).any(axis=(0, 1))
    assert 0.01 < changed.mean() < 0.5
    assert erased.depths is views.depths


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Compose([Eraser(), HorizontalFlip()]), "put Eraser last"),
        (lambda: Compose([Compose([Eraser()]), HorizontalFlip()]), "put Eraser last"),
        (lambda: Resize(0, 5), "sizes are whole numbers and start at 1"),
        (lambda: Letterbox(5, 0), "sizes are whole numbers and start at 1"),
        (lambda: Crop(0, 0, 0, 5), "sizes are whole numbers and start at 1"),
        (lambda: RandomCrop(-1, 5), "sizes are whole numbers and start at 1"),
        (lambda: Crop(30, 0, 20, 5)(made_views(), None), "reaches beyond a picture of 60 x 40"),
        (lambda: Crop(-1, 0, 20, 5), "sizes are whole numbers and start at 1"),
        (lambda: Resize(1.5, 5), "sizes are whole numbers"),
        (lambda: HorizontalFlip(1.5), "probability of HorizontalFlip must be 0 to 1, got 1.5"),
        (lambda: HorizontalFlip("x"), "must be 0 to 1, got 'x'"),
        (lambda: RandomScale(2, 1), "low, high of RandomScale must ascend"),
        (lambda: ColorJitter(hue=3), "hue of ColorJitter must be 0 to 1, got 3"),
        (lambda: Eraser(1.0, 2, 100, 50), "low, high of Eraser must ascend from 1"),
        (lambda: Compose([1]), "Compose takes transforms, got 1"),
        (lambda: Compose([HorizontalFlip]), "Compose takes transforms"),
        (lambda: RandomCrop(41, 5)(made_views(), None), "larger than a picture of 60 x 40"),
    ],
)
def test_a_transform_that_cannot_be_is_refused(make, message):
    with pytest.raises(FieldError, match=message):
        make()


def test_a_flip_of_a_sweep_is_refused(detailed_release):
    pairs = StereoPairs(detailed_release, pairs="sweep", transform=HorizontalFlip(1.0))

    with pytest.raises(FieldError, match="one view and 5 others"):
        pairs[0]
