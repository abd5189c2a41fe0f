"""Pairs derived from views on torch tensors, against the pairs that samples are made of."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from stereogenbench_data import (
    DERIVE_FIELDS,
    DERIVED_FIELDS,
    Crop,
    DepthEncoding,
    Eraser,
    FieldError,
    Letterbox,
    SceneViews,
    SelectionError,
    StereoPairs,
    collate,
    derive,
)
from stereogenbench_data.datasets.batch_buffers import to_tensors
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import CameraPoses, rotation_from_rotator_deg
from stereogenbench_data.samples.derive import StoredDepth, Views
from stereogenbench_data.samples.fields import Request, SampleWriter, new_array
from stereogenbench_data.schema.release import CAMERA_PAIRS
from stereogenbench_data.selection.plan import Address
from tests.datasets.conftest import same
from tests.samples.test_derive import facts
from tests.servers.tools import run_python

SIZE = (12, 40)
FRAMES = (0, 1)
CONTRACTS = {
    "planar depth": DepthEncoding(0.1),
    "ray depth": DepthEncoding(0.1, kind="ray"),
    "planar inverse": DepthEncoding(500.0, form="inverse"),
    "ray inverse": DepthEncoding(500.0, kind="ray", form="inverse"),
    "a measured 0": DepthEncoding(0.1, no_depth=("max",)),
    "an infinite depth": DepthEncoding(500.0, form="inverse", no_depth=("max", 7)),
    "a number of its own": DepthEncoding(0.07, no_depth=(77,)),
    "a range": DepthEncoding(0.07, offset_m=0.5),
    "a range of rays": DepthEncoding(0.07, kind="ray", offset_m=0.5, no_depth=("max",)),
}
RIGS = ("rectified", "posed")
MASKS = ("valid", "visible", "visible_from_left", "valid_right", "visible_right", "hole")


def scene(encoding, *, rig="rectified", seed=0, size=SIZE):
    """Return the views of a scene of 6 cameras and 2 frames, of random depth, and its facts."""
    rng = np.random.default_rng(seed)
    known = facts(encoding, residual_px=0.0 if rig == "rectified" else 1.0)
    locations = np.zeros((len(FRAMES), 6, 3))
    locations[:, :, 1] = 100 * np.asarray(known.scene.lateral_m)
    locations += rng.normal(0, 3, locations.shape)
    turns = rng.normal(0, 0.5, locations.shape)
    if rig == "turned apart":
        turns[:, :, 1] += np.linspace(0, 85, 6)
    poses = CameraPoses.from_unreal(locations, rotation_from_rotator_deg(turns), unit_m=0.01)
    units_m = [float(encoding.known_unit_m * ratio) for ratio in rng.choice([1.0, 2.5], 6)]
    known = replace(
        known,
        poses=poses,
        encodings={camera: replace(encoding, unit_m=units_m[camera]) for camera in range(6)},
    )
    depths = {}
    for camera in range(6):
        near, far = (rng.integers(20, 400, (len(FRAMES), *size)) for _ in range(2))
        stored = np.where(rng.random(near.shape) < 0.5, near, far // 8).astype(np.uint16)
        for number in (0, 7, 77, 40000, 65535):
            stored[rng.random(stored.shape) < 0.02] = number
        numbers = [65535 if number == "max" else number for number in encoding.no_depth]
        depths[camera] = StoredDepth(stored, ~np.isin(stored, numbers))
    views = Views(
        source=0, targets=(1, 2, 3, 4, 5), frames=FRAMES,
        pictures={
            camera: rng.integers(0, 256, (len(FRAMES), 3, *size), dtype=np.uint8)
            for camera in range(6)
        },
        depths=depths,
        intrinsics=Intrinsics(100.0 + rng.random(), 99.0, 20.3, 6.2, size[1], size[0]),
    )  # fmt: skip
    return views, known


def written(views, known, *, kind, fields, layout):
    """Return a clip with these fields, as a dataset writes it."""
    address = Address(0, views.source, views.targets, FRAMES)
    request = Request(kind=kind, fields=fields, layout=layout)
    writer = SampleWriter(request, address, clip="clip", allocate=new_array)
    writer.write(views, known, slice(0, len(FRAMES)))
    return to_tensors({name: writer.sample[name] for name in fields})


def batch_of(scenes):
    how = {"kind": "views", "fields": DERIVE_FIELDS, "layout": "stacked"}
    return collate([written(*each, **how) for each in scenes])


def expected_of(scenes, pairs=CAMERA_PAIRS):
    """Return the fields of every pair by the path of `StereoPairs`, (B, P, T, ...)."""
    rows = []
    for views, known in scenes:
        made = [
            written(
                replace(views, source=source, targets=(target,)), known,
                kind="pairs", fields=DERIVED_FIELDS, layout="single",
            )
            for source, target in pairs
        ]  # fmt: skip
        rows.append(collate(made))
    batch = collate(rows)
    return batch | {"intrinsics": batch["intrinsics"][:, 0]}


def assert_equal(made, expected):
    """Require the same pictures, masks and numbers, and disparity within 1 ulp of float32."""
    assert made.keys() == expected.keys()
    for name, values in made.items():
        assert values.dtype == expected[name].dtype, name
        assert values.shape == expected[name].shape, name
        if values.dtype == torch.float32:
            ulp = np.spacing(np.abs(expected[name].numpy()))
            apart = np.abs(values.numpy() - expected[name].numpy())
            assert np.array_equal(values.isnan(), expected[name].isnan()), name
            assert not (apart > ulp).any(), (name, np.nanmax(apart / ulp))
        else:
            assert torch.equal(values, expected[name]), name


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
@pytest.mark.parametrize("contract", CONTRACTS)
def test_every_field_is_that_of_stereo_pairs(contract):
    """Rectified and posed scenes share the batch."""
    scenes = [scene(CONTRACTS[contract], rig=rig, seed=1) for rig in RIGS]

    made = derive(batch_of(scenes), fields=DERIVED_FIELDS)

    expected = expected_of(scenes)
    assert_equal(made, expected)
    for name in MASKS:
        assert 0.001 < made[name].float().mean() < 0.999, name


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_points_behind_the_second_camera_are_not_valid_and_nothing_is_nan():
    scenes = [scene(CONTRACTS["planar depth"], rig="turned apart", seed=seed) for seed in (1, 2)]

    made = derive(batch_of(scenes), fields=DERIVED_FIELDS)

    assert_equal(made, expected_of(scenes))
    measured = made["depth"] > 0
    assert (measured & ~made["valid"]).float().mean() > 0.01
    for name in ("disparity", "disparity_right", "disparity_error"):
        assert made[name].isfinite().all(), name
    assert (made["disparity"][~made["valid"]] == 0).all()
    assert (made["disparity_right"][~made["valid_right"]] == 0).all()


def test_a_sweep_is_valid_where_every_second_camera_has_the_point_ahead():
    views, known = scene(CONTRACTS["planar depth"], rig="turned apart")
    how = {"kind": "pairs", "fields": ("valid", "disparity")}

    sweep = written(views, known, **how, layout="stacked")

    one = [
        written(replace(views, targets=(target,)), known, **how, layout="single")["valid"]
        for target in views.targets
    ]
    assert torch.equal(sweep["valid"], torch.stack(one).all(dim=0))
    assert not torch.equal(one[0], one[-1])


@pytest.mark.parametrize("cx_px", [20.0, 20.3])
def test_points_on_the_edge_between_two_pixels_land_on_the_same_one(cx_px):
    """Here alone rounding could decide: through poses that are not turned, by half pixels."""
    views, known = scene(CONTRACTS["planar depth"], rig="posed")
    centres = np.zeros((len(FRAMES), 6, 3))
    centres[:, :, 1] = 100 * np.asarray(known.scene.lateral_m)
    turns = rotation_from_rotator_deg(np.zeros_like(centres))
    poses = CameraPoses.from_unreal(centres, turns, unit_m=0.01)
    known = replace(known, poses=poses, encodings=dict.fromkeys(range(6), DepthEncoding(0.1)))
    halves_px = np.random.default_rng(0).choice([0.5, 1.5, 3.5, 4.5], (6, len(FRAMES), *SIZE))
    units = np.rint(63.0 * 0.2 / halves_px * 10).astype(np.uint16)
    depths = {camera: StoredDepth(units[camera], units[camera] > 0) for camera in range(6)}
    camera = Intrinsics(63.0, 63.0, cx_px, 6.0, SIZE[1], SIZE[0])
    scenes = [(replace(views, depths=depths, intrinsics=camera), known)]

    made, expected = derive(batch_of(scenes), fields=DERIVED_FIELDS), expected_of(scenes)

    differing = {name: int((made[name] != expected[name]).sum()) for name in MASKS}
    assert differing == dict.fromkeys(MASKS, 0)
    assert_equal(made, expected)


def test_only_the_pairs_and_fields_asked_for_are_made():
    views = scene(CONTRACTS["planar depth"])
    batch = batch_of([views])
    fields = ("disparity", "pair", "hole")
    del batch["image"]

    made = derive(batch, fields=fields, pairs=[(4, 1), (0, 5)])

    expected = expected_of([views], pairs=[(4, 1), (0, 5)])
    assert_equal(made, {name: expected[name] for name in fields})
    assert made["pair"].tolist() == [[[4, 1], [0, 5]]]


def plain_batch():
    return batch_of([scene(CONTRACTS["planar depth"])])


def test_many_pixels_are_made_some_pairs_at_a_time():
    """All 15 pairs are 3 million pixels: more than are made at once."""
    batch = batch_of([scene(CONTRACTS["planar depth"], size=(320, 320))])
    fields = ("disparity", "visible", "warped_right")

    together = derive(batch, fields=fields)

    for place in (0, 7, 14):
        alone = derive(batch, fields=fields, pairs=[CAMERA_PAIRS[place]])
        for name in fields:
            assert torch.equal(together[name][:, place : place + 1], alone[name]), name


def test_autocast_halves_no_precision():
    batch = batch_of([scene(CONTRACTS["ray depth"], rig=rig) for rig in RIGS])
    expected = derive(batch, fields=DERIVED_FIELDS)

    with torch.autocast("cpu", dtype=torch.bfloat16):
        made = derive(batch, fields=DERIVED_FIELDS)
        after = torch.ones(2, 2) @ torch.ones(2, 2)

    assert after.dtype == torch.bfloat16
    assert same(made, expected)


def test_torch_compile_takes_it_as_one_graph():
    printed = run_python("-W", "error", "-m", "tests.datasets.compile_derive", "aot_eager")

    assert printed.count("17 fields are equal") == 2


def test_results_stay_on_the_device_that_is_asked_for():
    """The meta device takes no tensor of another one, as a GPU does not."""
    made = derive(plain_batch(), fields=DERIVED_FIELDS, device="meta")

    assert {str(values.device) for values in made.values()} == {"meta"}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU with CUDA")
@pytest.mark.parametrize("contract", CONTRACTS)
def test_a_gpu_gives_what_the_processor_gives(contract):
    batch = batch_of([scene(CONTRACTS[contract], rig=rig) for rig in RIGS])

    made = derive(batch, fields=DERIVED_FIELDS, device="cuda")

    assert_equal(
        {name: values.cpu() for name, values in made.items()}, derive(batch, fields=DERIVED_FIELDS)
    )


@pytest.mark.parametrize(
    ("fields", "changes", "message"),
    [
        (("disparity", "right_from_left"), {}, "cannot make 'right_from_left'.*left, ri"),
        ((), {}, "no field"),
        (("left",), {"image": None}, "no image: .*fields=DERIVE_FIELDS"),
        (("left",), {"stored_depth": None}, "no stored_depth: .*fields=DERIVE_FIELDS"),
        (
            ("valid",), {"stored_depth": lambda depth: depth.int()},
            r"stored_depth is torch\.int32 \(1, 6, 2, 1, 12, 40\), not uint16",
        ),
        (
            ("valid",), {"stored_depth": lambda depth: depth[0, 0]},
            r"stored_depth is torch\.uint16 \(2, 1, 12, 40\), not uint16",
        ),
        (
            ("left",), {"image": lambda image: image.repeat_interleave(2, dim=-1)},
            r"image is \(1, 6, 2, 3, 12, 80\).*\(1, 6, 2, 1, 12, 40\)",
        ),
    ],
)  # fmt: skip
def test_what_no_pair_can_be_made_of_is_named_with_what_was_found(fields, changes, message):
    batch = plain_batch()
    for name, changed in changes.items():
        values = batch.pop(name)
        if changed is not None:
            batch[name] = changed(values)

    with pytest.raises(FieldError, match=message):
        derive(batch, fields=fields)


@pytest.mark.parametrize("pairs", [[(1, 1)], [(0, 6)], [(-1, 2)], "some", []])
def test_pairs_must_be_of_two_views_of_the_batch(pairs):
    with pytest.raises(SelectionError, match=r"pair"):
        derive(plain_batch(), pairs=pairs)


@pytest.mark.parametrize(
    "options",
    [
        {"frames": [0], "size": (48, 56)},
        {"frames": [3, 6], "transform": Crop(8, 4, 40, 32), "depth": DepthEncoding(frame_lag=2)},
    ],
    ids=["resized", "cropped, of late depth"],
)
def test_batches_of_a_loader_become_the_pairs_of_the_dataset(indexed_release, options):
    fields = (
        "left", "right", "disparity", "valid", "visible", "warped_right", "baseline_m", "pair",
    )  # fmt: skip
    options |= {"split": "train", "family": "Uniform"}
    moments = SceneViews(indexed_release, fields=DERIVE_FIELDS, **options)
    loader = moments.loader(batch_size=2, num_workers=1, shuffle=False)

    made = [derive(batch, fields=fields) for batch in loader]

    pairs = StereoPairs(indexed_release, fields=fields, pairs="all", **options)
    for name in fields:
        found = torch.cat([batch[name] for batch in made]).flatten(0, 1)
        expected = torch.stack([pairs[number][name] for number in range(len(pairs))])
        assert torch.equal(found, expected), name


@pytest.mark.parametrize("transform", [Letterbox(48, 96), Eraser(probability=1)], ids=repr)
def test_stored_depth_cannot_tell_what_a_transform_hid(indexed_release, transform):
    moments = SceneViews(indexed_release, fields=("stored_depth",), transform=transform)

    with pytest.raises(FieldError, match=r"/scene_\d+: stored_depth does not tell.*StereoPairs"):
        moments[0]


def test_a_contract_without_a_number_for_no_depth_is_refused_where_it_needs_one(indexed_release):
    depth = DepthEncoding(no_depth=(), frame_lag=1)
    moments = SceneViews(
        indexed_release, fields=("stored_depth", "no_depth"), depth=depth, frames=[5, 6]
    )

    assert moments[0]["no_depth"].tolist() == [-1] * 6
    with pytest.raises(FieldError, match=r"no_depth=\(\): name one that is not in use"):
        moments[1]
