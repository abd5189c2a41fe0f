"""Transforms keep a pair a pair: warping the right view by disparity still gives the left one."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
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
    SceneViews,
    StereoPairs,
)
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.media.depth import resized_nearest
from stereogenbench_data.samples.derive import StoredDepth, Views
from stereogenbench_data.samples.fields import PAIR_FIELDS

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
        Crop(20, 31, 64, 80),
        RandomCrop(97, 101),
        RandomScale(-0.2, 0.4, stretch_probability=1.0),
        HorizontalFlip(1.0),
        Compose([RandomScale(at_least=(128, 128)), HorizontalFlip(1.0), RandomCrop(128, 128)]),
    ],
    ids=str,
)
def test_a_moved_pair_still_warps_onto_itself(detailed_release, plain, transform):
    moved = StereoPairs(detailed_release, fields=FIELDS, transform=transform)[0]

    assert warped_psnr_db(moved) > min(30, warped_psnr_db(plain)) - 1.5


@pytest.mark.filterwarnings("ignore::stereogenbench_data.samples.fields.SwappedSizeWarning")
def test_scaling_in_the_decoder_is_a_resize(detailed_release, plain):
    size = (120, 64)
    decoded = StereoPairs(detailed_release, fields=FIELDS, size=size)[0]
    resized = StereoPairs(detailed_release, fields=FIELDS, transform=Resize(*size))[0]

    for name in ("disparity", "valid", "depth", "intrinsics", "visible"):
        assert torch.equal(decoded[name], resized[name]), name
    assert warped_psnr_db(decoded) > min(30, warped_psnr_db(plain)) - 1.5


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

    # Poses are those of a rig that is seen in a mirror.
    step = flipped["right_from_left"].numpy()

    np.testing.assert_allclose(step[:3, 3], [-float(plain["baseline_m"]), 0, 0], atol=1e-9)
    np.testing.assert_allclose(step[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(flipped["world_from_left"].numpy()[:3, :3]) == pytest.approx(1)


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
    camera = Intrinsics(50.0, 50.0, width / 2, height / 2, width, height)
    return Views(0, (1,), (0, 1), pictures, {0: StoredDepth(units, units > 2)}, camera)


def white_views():
    """Return views whose pictures are white and whose depth is measured everywhere."""
    views = made_views(24, 36)
    pictures = {camera: np.full_like(each, 255) for camera, each in views.pictures.items()}
    units = np.full((2, 24, 36), 50, dtype=np.uint16)
    depths = {camera: StoredDepth(units.copy(), units > 0) for camera in (0, 1)}
    return replace(views, pictures=pictures, depths=depths)


@dataclass
class CropPart:
    """Cut a random window that has these parts of the picture's height and width."""

    height: float
    width: float
    swaps_views = False

    def __call__(self, views, generator):
        height_px = max(1, int(views.intrinsics.height_px * self.height))
        width_px = max(1, int(views.intrinsics.width_px * self.width))
        return RandomCrop(height_px, width_px)(views, generator)


sides = st.integers(1, 70)
parts = st.floats(0.3, 1.0)
steps = st.one_of(
    st.builds(Letterbox, sides, sides),
    st.builds(Resize, sides, sides),
    st.builds(CropPart, parts, parts),
    st.just(RandomScale(-0.7, 0.7)),
    st.just(HorizontalFlip(0.5)),
)


@given(chain=st.lists(steps, max_size=5), start=st.builds(Letterbox, sides, sides))
def test_no_measured_pixel_has_padding_in_it_whatever_follows_a_letterbox(chain, start):
    moved = Compose([start, *chain])(white_views(), np.random.default_rng(0))

    for camera in (0, 1):
        measured = moved.depths[camera].measured
        picture = moved.pictures[camera].min(axis=1)
        assert picture[measured].min(initial=255) == 255
        assert moved.padded is None or not measured[:, moved.padded].any()
        assert moved.padded is None or measured[:, ~moved.padded].all()


MAPS = tuple(name for name, field in PAIR_FIELDS.items() if "H,W" in field.shape)


@pytest.mark.parametrize(
    ("first", "size_px"), [("as stored", 160), ("half", 80)], ids=["as stored", "size="]
)
def test_what_a_resize_mixed_with_black_is_neither_valid_nor_visible(
    detailed_release, first, size_px
):
    fields = tuple(dict.fromkeys((*FIELDS, *MAPS)))
    size = (size_px, size_px) if first == "half" else None
    transform = Compose([Letterbox(160, 220), Resize(73, 101)])
    boxed = StereoPairs(
        detailed_release, fields=fields, frames=("clips", 2), size=size, transform=transform
    )[0]

    # a column of 2.18 px averages what lies up to 2.18 px from its centre: 30 to 190 px is content
    outside = torch.tensor([True] * 15 + [False] * 71 + [True] * 15)
    for name in set(MAPS) - {"left", "right", "hole"}:
        assert not boxed[name][..., outside].any(), name
        assert boxed[name][..., ~outside].any(), name
    assert boxed["left"][..., 14].any()
    assert boxed["hole"][..., outside].all()
    rows = torch.arange(101) + 0.5
    for name, disparity, sign in (
        ("visible", "disparity", -1),
        ("visible_from_left", "disparity", -1),
        ("visible_right", "disparity_right", 1),
    ):
        landed = (rows + sign * boxed[disparity]).floor().long()[boxed[name]]
        assert not outside[landed].any(), name


@pytest.mark.parametrize("last", [Resize(160, 160), Resize(60, 75)], ids=str)
def test_what_the_eraser_painted_is_not_visible_though_it_is_valid(detailed_release, last):
    fields = (*FIELDS, "visible_from_left")
    eraser = Eraser(1.0, most_boxes=1, low=40, high=60)
    plain = StereoPairs(detailed_release, fields=fields, transform=last)[0]
    erased = StereoPairs(detailed_release, fields=fields, transform=Compose([eraser, last]))[0]
    unseen = StereoPairs(
        detailed_release, fields=("visible_from_left",), transform=Compose([eraser, last])
    )[0]

    painted = (erased["right"] != plain["right"]).any(dim=0)
    assert 0.01 < painted.float().mean() < 0.3
    for name in set(fields) - {"right", "visible", "visible_right", "visible_from_left"}:
        assert torch.equal(erased[name], plain[name]), name
    height_px, width_px = painted.shape
    columns = torch.arange(width_px) + 0.5
    landed = (columns - plain["disparity"][0]).floor().long().clamp(0, width_px - 1)
    on_paint = painted[torch.arange(height_px)[:, None], landed]
    for name in ("visible", "visible_from_left"):
        assert (plain[name][0] & on_paint).any(), name
        assert not (erased[name][0] & on_paint).any(), name
        assert not (erased[name] & ~plain[name]).any(), name
        assert erased[name].float().mean() > 0.5 * plain[name].float().mean(), name
    assert not (erased["visible_right"][0] & painted).any()
    assert torch.equal(unseen["visible_from_left"], erased["visible_from_left"])


@pytest.mark.parametrize("other", [ColorJitter(), Eraser(1.0, low=200, high=200)], ids=str)
def test_colours_do_not_depend_on_padding(other):
    views = made_views()
    box = Letterbox(40, 90)

    before = box(other(views, np.random.default_rng(2)), np.random.default_rng(0))
    after = other(box(views, np.random.default_rng(0)), np.random.default_rng(2))

    if isinstance(other, Eraser):
        own = after.unseen(1) & ~after.padded & before.unseen(1)
    else:
        own = ~after.padded
    assert own.any()
    np.testing.assert_array_equal(after.pictures[1][..., own], before.pictures[1][..., own])


@pytest.mark.parametrize("first", [Letterbox(40, 90), Eraser(1.0)], ids=["padded", "erased"])
def test_a_transform_that_forgets_what_is_not_of_the_scene_is_reported(first):
    views = first(made_views(), np.random.default_rng(0))
    width_px = views.intrinsics.width_px
    smaller = views.intrinsics.resized(width_px=20, height_px=20)

    with pytest.raises(FieldError, match=rf"has shape \(40, {width_px}\), their pictures are 20"):
        replace(views, pictures={}, depths={}, intrinsics=smaller)


def triangle_weights(before_px, after_px):
    """Return the (after, before) weights of an average over a triangle, in float64."""
    scale = before_px / after_px
    centres = (np.arange(after_px)[:, None] + 0.5) * scale
    distances = np.abs(np.arange(before_px) + 0.5 - centres)
    weights = np.maximum(0, 1 - distances / max(1.0, scale))
    return weights / weights.sum(axis=1, keepdims=True)


@given(before=st.tuples(sides, sides), size=st.tuples(sides, sides))
@example(before=(20, 30), size=(11, 1))
@example(before=(2, 1), size=(3, 1))
@example(before=(9, 9), size=(1, 1))
def test_a_resize_is_an_average_over_a_triangle_at_every_size(before, size):
    views = made_views(*before)

    resized = Resize(*size)(views, np.random.default_rng(0)).pictures[0]

    rows, columns = (triangle_weights(*axis) for axis in zip(before, size, strict=True))
    expected = rows @ views.pictures[0] @ columns.T
    assert resized.dtype == np.uint8
    assert np.abs(resized - expected).max() <= 2


def test_symmetric_jitter_changes_both_views_alike_and_asymmetric_apart():
    views = made_views()
    alike = Views(0, (1,), (0, 1), dict.fromkeys((0, 1), views.pictures[0]), {}, views.intrinsics)

    for probability, equal in ((0.0, True), (1.0, False)):
        jitter = ColorJitter(asymmetric_probability=probability)
        jittered = jitter(alike, np.random.default_rng(3))
        assert np.array_equal(jittered.pictures[0], jittered.pictures[1]) is equal
        assert not np.array_equal(jittered.pictures[0], views.pictures[0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Compose([Eraser(), HorizontalFlip()]), "put Eraser last"),
        (lambda: Resize(0, 5), "whole numbers of pixels from 1, got"),
        (lambda: Crop(30, 0, 20, 5)(made_views(), None), "reaches beyond a picture of 60 x 40"),
        (lambda: Resize(1.5, 5), "whole numbers of pixels from 1, got 5 x 1.5"),
        (lambda: HorizontalFlip(1.5), "probability of HorizontalFlip must be 0 to 1, got 1.5"),
        (lambda: RandomScale(2, 1), "low, high of RandomScale must be -8 to inf, ascending"),
        (lambda: ColorJitter(hue=3), "hue of ColorJitter must be 0 to 1, got 3"),
        (lambda: Resize(64), r"write Resize\(64, 64\)"),
        (lambda: RandomCrop((1, 2, 3)), r"is \(height, width\) in pixels, got \(1, 2, 3\)"),
        (
            lambda: Compose(HorizontalFlip(1.0), RandomCrop(8)),
            r"write Compose\(\[HorizontalFlip\(.*\), RandomCrop\(height=8, width=8\)\]\)",
        ),
        (lambda: Compose([HorizontalFlip]), "Compose takes transforms"),
        (lambda: RandomCrop(41, 5)(made_views(), None), "larger than a picture of 60 x 40"),
    ],
)
def test_a_transform_that_cannot_be_is_refused(make, message):
    with pytest.raises(FieldError, match=message):
        make()


@pytest.mark.parametrize("size", [(64, 48), [64, 48]])
def test_a_size_is_given_as_in_torchvision(size):
    assert RandomCrop(64) == RandomCrop((64, 64)) == RandomCrop(64, 64)
    assert RandomCrop(size) == RandomCrop(64, 48) == RandomCrop(height=64, width=48)
    assert Resize(size) == Resize(64, 48)
    assert Letterbox(size) == Letterbox(64, 48)


def test_a_flip_of_anything_but_one_pair_is_refused(detailed_release):
    with pytest.raises(FieldError, match=r"SceneViews .*got HorizontalFlip"):
        SceneViews(detailed_release, transform=HorizontalFlip())
    pairs = StereoPairs(detailed_release, pairs="sweep", transform=HorizontalFlip(1.0))
    with pytest.raises(FieldError, match="one view and 5 others"):
        pairs[0]
