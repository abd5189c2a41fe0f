"""StereoPairs and SceneViews as torch sees them."""

import gc
import os
import pickle
import re
import sys
import threading
import types
import warnings
import weakref
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from multiprocessing import popen_spawn_posix
from multiprocessing.context import set_spawning_popen
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from stereogenbench_data import (
    PAIR_FIELDS,
    VIEW_FIELDS,
    ColorJitter,
    Compose,
    DepthEncoding,
    Eraser,
    FieldError,
    HorizontalFlip,
    MixedSplitsWarning,
    RandomCrop,
    SceneViews,
    SelectionError,
    StereoPairs,
    StereoPairStream,
    StorageError,
    collate,
)
from stereogenbench_data.media import depth
from tests.datasets.conftest import fork_and, same
from tests.servers.tools import run_python

EVERY_FIELD = tuple(PAIR_FIELDS)


def shape_of(field, *, height, width, views=1):
    words = field.shape.strip("()").split(",")
    sizes = {"H": height, "W": width, "V": views}
    return tuple(sizes.get(word) or int(word) for word in words if word)


@pytest.mark.parametrize("name", EVERY_FIELD)
def test_a_pair_field_alone_is_as_its_table_says(indexed_release, name):
    field = PAIR_FIELDS[name]
    value = StereoPairs(indexed_release, fields=[name], size=(40, 48))[0][name]

    if field.dtype == "str":
        assert isinstance(value, str)
    else:
        assert str(value.dtype) == f"torch.{field.dtype}"
        assert tuple(value.shape) == shape_of(field, height=40, width=48)


@pytest.mark.parametrize("name", VIEW_FIELDS)
def test_a_view_field_is_as_its_table_says_with_the_views_in_front(indexed_release, name):
    field = VIEW_FIELDS[name]
    stacked = SceneViews(indexed_release, cameras=(0, 3, 5), fields=[name], size=(40, 48))[0][name]
    alone = SceneViews(indexed_release, cameras="each", fields=[name], size=(40, 48))[2][name]

    if field.dtype == "str":
        assert isinstance(stacked, str)
    else:
        assert tuple(alone.shape) == shape_of(field, height=40, width=48)
        shape = shape_of(field, height=40, width=48, views=3)
        assert tuple(stacked.shape) == ((3, *shape) if field.per_target else shape)
        assert str(stacked.dtype) == f"torch.{field.dtype}"


def test_stacked_views_of_clips_have_the_axes_that_the_page_of_samples_states(indexed_release):
    fields = (
        "baselines_m", "cams_from_cam", "world_from_cam", "camera", "image", "intrinsics",
        "focal_mm", "frame_index", "frame_rate_hz",
    )  # fmt: skip
    options = {"split": "train", "frames": ("clips", 3), "fields": fields, "size": (40, 48)}

    def shapes(cameras):
        sample = SceneViews(indexed_release, cameras=cameras, **options)[0]
        return {name: tuple(value.shape) for name, value in sample.items()}

    of_all = {"intrinsics": (3, 3), "focal_mm": (), "frame_index": (3,), "frame_rate_hz": ()}
    assert shapes((0, 4)) == of_all | {
        "baselines_m": (2, 2), "cams_from_cam": (2, 3, 2, 4, 4), "world_from_cam": (2, 3, 4, 4),
        "camera": (2,), "image": (2, 3, 3, 40, 48),
    }  # fmt: skip
    assert shapes("each") == of_all | {
        "baselines_m": (1,), "cams_from_cam": (3, 1, 4, 4), "world_from_cam": (3, 4, 4),
        "camera": (), "image": (3, 3, 40, 48),
    }  # fmt: skip


def test_a_sweep_of_clips_has_an_axis_of_targets_and_one_of_time_and_holds_single_samples(
    indexed_release,
):
    frames = ("clips", 3, 2)
    sweep = StereoPairs(indexed_release, fields=EVERY_FIELD, pairs="sweep", frames=frames)[0]
    singles = [
        [StereoPairs(indexed_release, fields=EVERY_FIELD, pairs=[(0, right)], frames=frame)[0]
         for frame in (0, 2, 4)]
        for right in range(1, 6)
    ]  # fmt: skip

    for name, field in PAIR_FIELDS.items():
        if field.dtype != "str" and (field.per_frame or field.per_target):
            rows = [
                torch.stack([each[name] for each in row]) if field.per_frame else row[0][name]
                for row in singles
            ]
            expected = torch.stack(rows) if field.per_target else rows[0]
            assert torch.equal(sweep[name], expected), name


def test_the_primary_pair_of_the_first_frame_is_the_default(indexed_release):
    pairs = StereoPairs(indexed_release)

    assert len(pairs) == 4
    assert [pairs[number]["pair"].tolist() for number in range(4)] == [[0, 1]] * 4
    assert pairs[-1]["__key__"] == pairs[3]["__key__"]
    assert pairs[0]["__key__"].startswith("eval/MapSeenInTrain/Uniform/")
    assert pairs[0]["__key__"].endswith("/00-01/000")


def test_a_slice_is_answered_with_a_subset_of_the_same_samples(indexed_release):
    pairs = StereoPairs(indexed_release, fields=("left",))

    with pytest.raises(SelectionError, match=r"got slice.*Subset\(pairs, range\(0, 3\)\)"):
        pairs[:3]
    subset = torch.utils.data.Subset(pairs, range(3))
    assert torch.equal(subset[2]["left"], pairs[2]["left"])


@pytest.mark.parametrize("data", [None, ["scenes"]], ids=repr)
def test_what_is_not_a_path_is_named_with_what_is_one(data):
    match = rf"{re.escape(repr(data))} is not a path: name a folder"
    with pytest.raises(StorageError, match=match):
        StereoPairs(data)


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_of_every_kind_give_what_the_main_process_gives(indexed_release, context):
    pairs = StereoPairs(
        indexed_release,
        pairs="adjacent",
        frames=("every", 3),
        transform=Compose([HorizontalFlip(), RandomCrop(32, 48), ColorJitter(), Eraser(1.0)]),
    )
    alone = [pairs[number] for number in range(12)]
    loader = DataLoader(
        pairs,
        sampler=range(12),
        batch_size=None,
        num_workers=2,
        multiprocessing_context=context,
    )

    assert all(same(one, other) for one, other in zip(alone, loader, strict=True))


class Noted:
    """A transform that a notebook defines."""

    swaps_views = False

    def __call__(self, views, generator):
        """Change nothing."""
        return views


@pytest.mark.parametrize("kind", ["map-style", "stream"])
def test_a_transform_of_a_notebook_is_refused_where_workers_cannot_import_it(
    indexed_release, monkeypatch, kind
):
    notebook = types.ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", notebook)
    monkeypatch.setattr(Noted, "__module__", "__main__")
    monkeypatch.setattr(notebook, "Noted", Noted, raising=False)
    options = {"fields": ("left",), "transform": Compose([RandomCrop(8, 8), Noted()])}
    workers = {"num_workers": 1, "multiprocessing_context": "spawn"}
    made = StereoPairs(indexed_release, **options).loader(1, **workers)
    if kind == "stream":
        made = DataLoader(StereoPairStream(indexed_release, 1, **options), 1, **workers)

    with pytest.raises(FieldError, match=r"Noted object .* of this notebook.*'spawn'.*module \("):
        next(iter(made))
    assert pickle.loads(pickle.dumps(StereoPairs(indexed_release, **options))).is_random


@pytest.mark.parametrize("transform", [None, RandomCrop(8, 8)])
def test_a_notebook_without_a_transform_of_its_own_may_spawn(
    indexed_release, monkeypatch, transform
):
    monkeypatch.setitem(sys.modules, "__main__", types.ModuleType("__main__"))
    pairs = StereoPairs(indexed_release, transform=transform)

    child = object.__new__(popen_spawn_posix.Popen)
    child.duplicate_for_child = os.dup
    set_spawning_popen(child)
    try:
        sent = ForkingPickler.dumps(pairs)
    finally:
        set_spawning_popen(None)
    assert len(pickle.loads(sent)) == len(pairs)


def test_transforms_draw_anew_each_epoch_and_the_same_for_the_same_seed(indexed_release):
    def crops(seed, epoch):
        pairs = StereoPairs(
            indexed_release, fields=("intrinsics",), transform=RandomCrop(8, 8), seed=seed
        )
        pairs.set_epoch(epoch)
        return [tuple(pairs[number]["intrinsics"][:2, 2].tolist()) for number in range(4)]

    assert crops(0, 0) == crops(0, 0)
    assert crops(0, 0) != crops(0, 1)
    assert crops(0, 0) != crops(1, 0)


def test_what_a_user_writes_into_a_sample_stays_there(indexed_release):
    pairs = StereoPairs(indexed_release, fields=EVERY_FIELD)
    untouched = pairs[0]
    for value in pairs[0].values():
        if isinstance(value, torch.Tensor):
            value.zero_()

    assert same(pairs[0], untouched)


@pytest.mark.filterwarnings("ignore:.*is multi-threaded:DeprecationWarning")
def test_a_fork_reads_on_while_a_thread_of_its_parent_decodes_undisturbed(
    indexed_release, monkeypatch
):
    pairs, parent = StereoPairs(indexed_release, frames="all", fields=("left",)), os.getpid()
    expected = [pairs[number]["left"] for number in range(7)]
    pairs.close()
    decoding, forked = threading.Event(), threading.Event()

    class Waiting(depth.VideoReader):
        def frame(self, index):
            if os.getpid() == parent:
                decoding.set()
                forked.wait()
            return super().frame(index)

    def read(numbers):
        assert all(torch.equal(pairs[number]["left"], expected[number]) for number in numbers)

    monkeypatch.setattr(depth, "VideoReader", Waiting)
    with ThreadPoolExecutor(1) as threads:
        reading = threads.submit(read, range(7))
        decoding.wait()
        status = fork_and(lambda: read((3, 1, 6)))
        forked.set()
    assert (status, reading.exception()) == (0, None)


def test_a_batch_of_scenes_of_two_sizes_says_how_to_mend_it():
    wide = {"left": torch.zeros(3, 4, 8), "__key__": "a"}
    tall = {"left": torch.zeros(3, 8, 4), "__key__": "b"}

    with pytest.raises(FieldError, match=r"left is \(3, 8, 4\) in b and \(3, 4, 8\) in a"):
        collate([wide, tall])


OURS = {"left": torch.zeros(3, 4, 4, dtype=torch.uint8), "baseline_m": 0.1, "__key__": "a"}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"left": torch.zeros(3, 4, 4)},
            r"left is torch\.float32 \(3, 4, 4\) in b and torch\.uint8",
        ),
        ({"left": np.zeros((3, 4, 4), np.uint8)}, r"left is uint8 \(3, 4, 4\) in b and torch\.ui"),
        ({"left": None}, r"left is NoneType in b and torch\.uint8 \(3, 4, 4\) in a"),
        ({"left": ...}, r"left is missing in b and torch\.uint8 \(3, 4, 4\) in a"),
        ({"baseline_m": "10 cm"}, "baseline_m is a text in b and a number in a"),
        ({"__key__": ...}, "__key__ is missing in sample 1 of the batch and a text in a"),
        ({"weight": torch.ones(1)}, r"weight is torch\.float32 \(1,\) in b and missing in a"),
    ],
)
def test_samples_of_two_datasets_that_do_not_go_together_are_named(change, told):
    changed = OURS | {"__key__": "b"} | change
    theirs = {name: value for name, value in changed.items() if value is not ...}

    with pytest.raises(FieldError, match=rf"{told}.*: give samples of several datasets the same"):
        collate([OURS, theirs])
    with pytest.raises(FieldError, match=r" is .* and .*: give samples of several datasets"):
        collate([theirs, OURS])


def test_numbers_and_texts_of_any_kind_go_together():
    theirs = OURS | {"baseline_m": np.float64(0.2), "__key__": np.str_("b")}

    batch = collate([OURS, theirs])

    assert batch["baseline_m"].tolist() == [0.1, 0.2]
    assert batch["__key__"] == ["a", "b"]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"fields": ["dispariti"]},
            FieldError,
            "no field 'dispariti'; did you mean 'disparity'. The fields are left",
        ),
        ({"fields": []}, FieldError, "at least one"),
        ({"fields": ["left", "left"]}, FieldError, "only once"),
        ({"size": (0, 5)}, FieldError, "size must be"),
        ({"seed": -1}, SelectionError, "seed must be"),
        (
            {"split": "test"},
            SelectionError,
            "split test matches none of 4 scenes; found eval, train",
        ),
        ({"frames": 7}, SelectionError, "scene with 7 frames"),
        ({"transform": 42}, FieldError, "a transform is called with"),
        ({"transform": HorizontalFlip}, FieldError, "a transform is called with"),
        ({"depth": 0.001}, FieldError, "depth must be a DepthEncoding"),
    ],
    ids=str,
)
def test_what_cannot_be_had_is_refused_before_anything_is_read(
    indexed_release, options, error, message
):
    with pytest.raises(error, match=message):
        StereoPairs(indexed_release, **options)


@pytest.mark.parametrize("cameras", [(), (0, 0), (6,), "some", (0, "1")])
def test_views_of_cameras_that_do_not_exist_are_refused(indexed_release, cameras):
    with pytest.raises(SelectionError, match="cameras must be"):
        SceneViews(indexed_release, cameras=cameras)


def test_the_users_depth_contract_overrides_the_files(indexed_release):
    stated = StereoPairs(indexed_release, fields=("depth", "disparity", "valid"))[0]
    doubled = StereoPairs(
        indexed_release, fields=("depth", "disparity", "valid"), depth=DepthEncoding(unit_m=0.002)
    )[0]

    assert torch.equal(stated["valid"], doubled["valid"])
    assert torch.allclose(stated["depth"] * 2, doubled["depth"], rtol=1e-6)
    assert torch.allclose(stated["disparity"], doubled["disparity"] * 2, rtol=1e-6)


@pytest.mark.parametrize("contract", [DepthEncoding(), DepthEncoding(accept=frozenset({"8-bit"}))])
def test_a_contract_that_states_no_unit_keeps_the_files(indexed_release, contract):
    stated = StereoPairs(indexed_release, fields=("depth",))[0]

    assert torch.equal(StereoPairs(indexed_release, fields=("depth",), depth=contract)[0]["depth"],
                       stated["depth"])  # fmt: skip


def test_threads_that_share_a_dataset_get_what_one_thread_gets(indexed_release):
    pairs = StereoPairs(indexed_release, pairs="all", frames="all", fields=("left", "depth"))
    numbers = np.random.default_rng(0).integers(0, len(pairs), 200).tolist()
    expected = {number: pairs[number] for number in sorted(set(numbers))}

    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(pairs.__getitem__, numbers))

    assert all(same(one, expected[number]) for one, number in zip(found, numbers, strict=True))


def test_a_dataset_goes_on_after_a_change_of_folder(indexed_release, monkeypatch, tmp_path):
    monkeypatch.chdir(indexed_release.parent)
    pairs = StereoPairs(indexed_release.name, fields=("left", "__url__"))
    monkeypatch.chdir(tmp_path)

    assert pairs[0]["__url__"].startswith(str(indexed_release))


def test_a_frame_lag_takes_depth_from_another_frame_and_none_beyond_the_last(indexed_release):
    options = {"frames": "all", "family": "IPD_Gaussian", "fields": ("left", "depth", "valid")}
    plain = StereoPairs(indexed_release, **options)
    lagged = StereoPairs(indexed_release, depth=DepthEncoding(frame_lag=1), **options)

    assert torch.equal(lagged[2]["depth"], plain[3]["depth"])
    assert torch.equal(lagged[2]["left"], plain[2]["left"])
    assert not lagged[6]["valid"].any()
    assert not lagged[6]["depth"].any()


def test_reading_samples_does_not_import_pandas(small_shards):
    """Arrow imports it for a comparison with a number: longer than opening a whole release."""
    code = (
        "import sys; from stereogenbench_data import StereoPairs; "
        "StereoPairs(sys.argv[1])[0]; sys.exit('pandas' in sys.modules)"
    )
    run_python("-c", code, small_shards)


MIXED = r"no split was chosen, so 1 eval and 3 train scenes come together"


@pytest.mark.parametrize("kind", [StereoPairs, SceneViews, partial(StereoPairStream, batch_size=2)])
def test_train_and_eval_together_are_told_of_with_how_many_of_each(small_index, kind):
    with pytest.warns(MixedSplitsWarning, match=MIXED) as told:
        kind(small_index)

    assert len(told) == 1


@pytest.mark.parametrize(
    "selection",
    [{"split": "train"}, {"split": ("train", "eval")}, {"split": "eval"}, {"scenes": "all"}],
    ids=str,
)
def test_who_chose_splits_or_scenes_is_told_nothing(small_index, selection):
    if "scenes" in selection:
        selection = {"scenes": small_index.column("key").tolist()}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pairs = StereoPairs(small_index, **selection)
        pickle.loads(pickle.dumps(pairs))[0]


def test_a_dataset_ends_with_the_last_reference_to_its_loader(small_release):
    loader = StereoPairs(small_release, split="train", fields=("left",)).loader(1)
    next(iter(loader))
    dataset = weakref.ref(loader.batches.dataset)

    gc.disable()
    try:
        del loader
        assert dataset() is None
    finally:
        gc.enable()
