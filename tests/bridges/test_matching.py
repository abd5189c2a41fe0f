"""Matching: each adapter's items, and what the project's own training loop does with batches."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from stereogenbench_data import (
    Compose,
    HorizontalFlip,
    RandomCrop,
    SelectionError,
    StereoPairs,
)
from stereogenbench_data.bridges.matching import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    DynamicStereo,
    IgevStereo,
    RaftStereo,
    UniMatch,
)
from stereogenbench_data.index.table import SceneIndex
from tests.datasets.conftest import same

ADAPTERS = [
    pytest.param(RaftStereo, {}, id="RAFT-Stereo"),
    pytest.param(DynamicStereo, {"frames": ("clips", 2)}, id="DynamicStereo"),
]
"""One of frames and one of clips: what is tested with them is their base's."""
MOVED = Compose([HorizontalFlip(1.0), RandomCrop(96, 128)])


def fetched(right, shift_px):
    """Return the right picture (..., c, h, w) at x + shift of each left pixel, between centres."""
    *_, height, width = right.shape
    columns = torch.arange(width) + shift_px
    rows = torch.arange(height)[:, None].expand(height, width)
    grid = torch.stack([2 * (columns + 0.5) / width - 1, 2 * (rows + 0.5) / height - 1], dim=-1)
    return torch.nn.functional.grid_sample(right[None], grid[None].float(), align_corners=False)[0]


def psnr(one, other, where):
    error = ((one - other) ** 2).mean(0)[where].mean()
    return float(10 * torch.log10(255**2 / error))


def visible_pixels(data, **options):
    return StereoPairs(data, fields=("visible",), **options)[0]["visible"]


def test_the_loop_of_raft_stereo_unpacks_four_after_the_names(indexed_release):
    train = RaftStereo(indexed_release, split="train", pairs="all", frames="all")

    for _, (_, *data_blob) in enumerate(train.loader(batch_size=3, num_workers=1)):
        image1, image2, flow, valid = data_blob
        break

    assert [each.dtype for each in data_blob] == [torch.float32] * 4
    assert image1.shape == image2.shape == (3, 3, 64, 64)
    assert (flow.shape, valid.shape) == ((3, 1, 64, 64), (3, 64, 64))
    assert 1 < float(image1.max()) <= 255
    mag = torch.sum(flow**2, dim=1).sqrt()
    used = ((valid >= 0.5) & (mag < 700)).unsqueeze(1)
    assert used.shape == flow.shape
    assert (flow[used] < 0).all()
    assert not flow.isinf().any()


def of_unimatch(item):
    """The pictures of an item from 0 to 255, and how far each pixel moves."""
    mean, std = (torch.tensor(each)[:, None, None] for each in (IMAGENET_MEAN, IMAGENET_STD))
    left, right = ((item[name] * std + mean) * 255 for name in ("left", "right"))
    return left, right, -item["disp"]


@pytest.mark.parametrize(
    ("adapter", "read"),
    [
        (RaftStereo, lambda item: (item[1], item[2], item[3][0])),
        (IgevStereo, lambda item: (item[1], item[2], -item[3][0])),
        (UniMatch, of_unimatch),
    ],
)
@pytest.mark.parametrize("transform", [None, MOVED], ids=["as it is", "flipped and cropped"])
def test_the_right_picture_fetched_by_the_flow_is_the_left_one(
    detailed_release, adapter, read, transform
):
    item = adapter(detailed_release, transform=transform)[0]
    visible = visible_pixels(detailed_release, transform=transform)[0]
    left, right, flow = read(item)

    assert psnr(fetched(right, flow), left, visible) > 27
    assert psnr(right, left, visible) < 22
    assert adapter is UniMatch or (item[4][visible] == 1).all()


def test_raft_stereo_names_both_pictures_and_the_ground_truth(indexed_release):
    options = {"family": "Uniform", "split": "train", "pairs": [(1, 4)], "frames": [3]}
    names = RaftStereo(indexed_release, **options)[0][0]
    flipped = RaftStereo(indexed_release, transform=HorizontalFlip(1), **options)[0][0]

    scene = "train/Uniform/SynthStage/scene_000000"
    assert names == [f"{scene}/cam_{each}/003" for each in ("01_rgb", "04_rgb", "01_depth")]
    assert flipped == [f"{scene}/cam_{each}/003" for each in ("04_rgb", "01_rgb", "04_depth")]


def test_pixels_of_large_disparity_are_not_valid(indexed_release):
    largest = StereoPairs(indexed_release)[0]["disparity"].max()
    whole = RaftStereo(indexed_release)[0]
    cut = RaftStereo(indexed_release, valid_below_px=float(largest) / 2)[0]

    np.testing.assert_array_equal(cut[3], whole[3])
    assert torch.equal(cut[4], whole[4] * (whole[3][0].abs() < largest / 2))
    assert 0 < cut[4].sum() < whole[4].sum()


def test_unmeasured_pixels_are_not_valid(shared_scenes):
    sample = StereoPairs(shared_scenes, size=(64, 64))[0]
    *_, flow, valid = RaftStereo(shared_scenes, size=(64, 64))[0]

    assert not sample["valid"].all()
    assert torch.equal(valid, sample["valid"][0].float())
    assert (flow[~sample["valid"]] == 0).all()


def test_the_loop_of_unimatch_takes_normalised_tensors(indexed_release):
    plain = StereoPairs(indexed_release)[0]
    batch = next(iter(DataLoader(UniMatch(indexed_release), batch_size=2)))

    assert {name: tuple(value.shape) for name, value in batch.items()} == {
        "left": (2, 3, 64, 64), "right": (2, 3, 64, 64), "disp": (2, 64, 64),
    }  # fmt: skip
    assert {value.dtype for value in batch.values()} == {torch.float32}
    _, back, _ = of_unimatch({name: values[0] for name, values in batch.items()})
    torch.testing.assert_close(back, plain["right"].float(), atol=1e-3, rtol=0)
    mask = (batch["disp"] > 0) & (batch["disp"] < 400)
    assert torch.equal(mask[0], plain["valid"][0])


def test_the_loop_of_dynamic_stereo_takes_clips_of_both_views(indexed_release):
    clips = DynamicStereo(indexed_release, pairs="adjacent", frames=("clips", 3))

    batch = next(iter(clips.loader(batch_size=2)))

    assert {name: tuple(value.shape) for name, value in batch.items()} == {
        "img": (2, 3, 2, 3, 64, 64), "disp": (2, 3, 2, 1, 64, 64), "valid_disp": (2, 3, 2, 64, 64),
    }  # fmt: skip
    assert {value.dtype for value in batch.values()} == {torch.float32}
    for moment in range(3):
        flow, valid = batch["disp"][:, moment, 0], batch["valid_disp"][:, moment, 0]
        used = (valid >= 0.5).unsqueeze(1)
        assert used.shape == flow.shape
        assert (flow[used] < 0).all()


def test_both_views_of_dynamic_stereo_have_the_disparity_of_their_own_pixels(detailed_release):
    options = {"frames": ("clips", 2), "transform": MOVED}
    item = DynamicStereo(detailed_release, **options)[0]
    there = StereoPairs(detailed_release, fields=("visible", "visible_right"), **options)[0]

    left, right = item["img"][0]
    ahead, back = item["disp"][0]
    assert psnr(fetched(right, ahead[0]), left, there["visible"][0, 0]) > 27
    assert psnr(fetched(left, -back[0]), right, there["visible_right"][0, 0]) > 27
    assert torch.equal(item["valid_disp"] > 0, item["disp"][:, :, 0] < 0)


@pytest.mark.parametrize(("adapter", "options"), ADAPTERS)
def test_torchs_own_loader_and_ours_give_the_same_items(indexed_release, adapter, options):
    dataset = adapter(
        indexed_release, pairs="adjacent", transform=RandomCrop(32, 48), seed=3, **options
    )

    ours = next(iter(dataset.loader(2, shuffle=False)))
    sent = pickle.loads(pickle.dumps(dataset))  # as other processes get it
    torchs = next(iter(DataLoader(sent, batch_size=2, num_workers=1)))

    assert same(flat(ours), flat(torchs))


def flat(batch):
    return batch if isinstance(batch, dict) else dict(enumerate(batch))


@pytest.mark.parametrize(("adapter", "options"), ADAPTERS)
def test_what_the_project_cannot_take_is_refused(indexed_release, adapter, options):
    name = adapter.__name__

    with pytest.raises(SelectionError, match=f"{name} is trained on positive.*HorizontalFlip"):
        adapter(indexed_release, direction="right_to_left", **options)
    with pytest.raises(SelectionError, match=f"{name} takes single pairs, got pairs='sweep'"):
        adapter(indexed_release, pairs="sweep", **options)
    with pytest.raises(SelectionError, match=f"drop_last='pad'.*{name}.*drop_last=True"):
        adapter(indexed_release, **options).loader(2, drop_last="pad")


@pytest.mark.parametrize(("adapter", "options"), ADAPTERS)
def test_cameras_that_stand_from_right_to_left_need_the_other_direction(
    indexed_release, adapter, options
):
    scene = StereoPairs(indexed_release).index.scene(0)
    places_m = tuple(-place_m for place_m in scene.lateral_m)
    index = SceneIndex.from_scenes([replace(scene, lateral_m=places_m)], indexed_release)

    match = (
        rf"{scene.id.key}: .*camera 0 is the first.*right of camera 1.*15 pairs of 15.*"
        rf"{adapter.__name__}"
    )
    with pytest.raises(SelectionError, match=match):
        adapter(index, pairs="all", **options)
    assert len(adapter(index, pairs="all", direction="right_to_left", **options)) > 0


def test_clips_and_single_frames_are_not_mixed_up(indexed_release):
    with pytest.raises(SelectionError, match=r"RaftStereo takes frames: .* got \('clips', 2\)"):
        RaftStereo(indexed_release, frames=("clips", 2))
    with pytest.raises(SelectionError, match=r"DynamicStereo takes clips: .* got 'first'"):
        DynamicStereo(indexed_release)
