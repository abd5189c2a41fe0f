"""Samples through Hugging Face datasets: the same fields and dtypes, shared, resumed."""

import sys

import datasets
import numpy as np
import pytest
import torch
from datasets.distributed import split_dataset_by_node
from torch.utils.data import DataLoader

from stereogenbench_data import PAIR_FIELDS, Compose, HorizontalFlip, RandomCrop, StereoPairs
from stereogenbench_data.bridges import huggingface
from stereogenbench_data.errors import ExtraError, FieldError, SelectionError, StorageError
from tests.bridges.conftest import require_equal, require_frames_of_epochs

FIELDS = ("left", "right", "disparity", "valid", "intrinsics", "pair", "scene", "__key__")
SELECTION = {"fields": FIELDS, "pairs": "adjacent", "frames": [0, 6]}


@pytest.fixture(scope="module")
def expected(small_shards):
    return StereoPairs(small_shards, **SELECTION)


@pytest.fixture
def stream(small_shards):
    return huggingface.iterable(small_shards, **SELECTION)


def keys(samples):
    return [sample["__key__"] for sample in samples]


def test_the_samples_are_those_of_the_map_style_dataset(stream, expected):
    found = list(stream)

    assert isinstance(stream, datasets.IterableDataset)
    assert stream.num_shards == 4
    assert len(found) == len(expected)
    for sample, other in zip(found, expected, strict=True):
        assert all(isinstance(value, np.ndarray | str) for value in sample.values())
        require_equal(sample, other)


def test_torchs_loader_and_its_own_collate_keep_dtypes_and_lose_nothing(stream, expected):
    batches = list(DataLoader(stream, batch_size=4, num_workers=2))

    assert sorted(key for batch in batches for key in batch["__key__"]) == sorted(keys(expected))
    assert batches[0]["left"].dtype == torch.uint8
    assert batches[0]["disparity"].dtype == torch.float32
    assert batches[0]["intrinsics"].dtype == torch.float64
    assert batches[0]["valid"].dtype == torch.bool


@pytest.mark.parametrize("world", [2, 3])
def test_ranks_share_the_samples_without_overlap(stream, expected, world):
    shares = [
        keys(split_dataset_by_node(stream, rank=rank, world_size=world)) for rank in range(world)
    ]

    assert sorted(key for share in shares for key in share) == sorted(keys(expected))


def test_a_state_resumes_where_it_was_taken(small_shards, stream, expected):
    taken = []
    for sample in stream:
        taken.append(sample["__key__"])
        if len(taken) == 13:
            state = stream.state_dict()
            break
    resumed = huggingface.iterable(small_shards, **SELECTION)
    resumed.load_state_dict(state)

    assert taken + keys(resumed) == keys(expected)


def test_an_epoch_has_new_random_frames_and_a_new_order(small_shards):
    stream = huggingface.iterable(
        small_shards, fields=("frame_index", "scene"), frames=("random", 3)
    )

    def drawn(epoch):
        stream.set_epoch(epoch)
        return [(sample["scene"], int(sample["frame_index"])) for sample in stream]

    assert drawn(0) == drawn(0)
    assert set(drawn(0)) != set(drawn(1))
    orders = {tuple(scene for scene, _ in drawn(epoch)) for epoch in range(4)}
    assert len(orders) > 1


EVERY_FIELD = tuple(name for name in PAIR_FIELDS if name not in ("__key__", "__url__"))


@pytest.mark.parametrize(
    "options",
    [
        {"size": (24, 40)},
        {"pairs": "sweep", "frames": ("clips", 3)},
        {"transform": Compose([HorizontalFlip(), RandomCrop(16, 24)])},
    ],
    ids=str,
)
def test_samples_are_as_their_features_say(small_shards, options):
    pairs = StereoPairs(small_shards, fields=EVERY_FIELD, **options)

    features = huggingface.sample_features(pairs)

    assert list(features) == list(EVERY_FIELD)
    for name, value in pairs[0].items():
        feature = features[name]
        if isinstance(value, str):
            assert feature == datasets.Value("string")
        elif value.ndim < 2:
            one = feature.feature if value.ndim else feature
            assert f"torch.{one.dtype}" == str(value.dtype), name
            assert value.ndim == 0 or feature.length == len(value), name
        else:
            assert (f"torch.{feature.dtype}", feature.shape) == (str(value.dtype), value.shape)


def test_features_that_differ_are_refused_by_name(small_shards):
    odd = StereoPairs(small_shards, transform=Compose([Odd()]))

    with pytest.raises(FieldError, match=r"shards.*Give size="):
        huggingface.sample_features(odd)
    assert huggingface.iterable(small_shards, transform=Odd()).features is None


class Odd:
    """A transform of somebody else, of which nothing is known."""

    swaps_views = False

    def __call__(self, views, generator):
        return views


def raw(urls, **options):
    return datasets.load_dataset(
        "webdataset", data_files={"train": urls}, features=huggingface.features(**options),
        streaming=True, split="train",
    )  # fmt: skip


@pytest.mark.parametrize("suffix", ["mkv", "b2frame"])
def test_raw_shards_are_read_as_bytes_and_mapped_to_samples(request, small_shards, suffix):
    """The features of packed depth have its suffix."""
    shards = small_shards if suffix == "mkv" else request.getfixturevalue("packed_depth")
    rows = raw(sorted(map(str, shards.glob("*.tar"))), depth_suffix=suffix)
    expected = {each["__key__"]: each for each in StereoPairs(small_shards, fields=FIELDS)}

    mapped = rows.map(huggingface.decode(FIELDS), remove_columns=rows.column_names)

    found = list(mapped)
    assert len(found) == len(expected)
    for sample in found:
        other = dict(expected[sample["__key__"]])
        # Datasets writes JSON anew, with 15 digits of a number: cameras differ by 1e-12 of theirs.
        np.testing.assert_allclose(sample["intrinsics"], other["intrinsics"], rtol=1e-11)
        np.testing.assert_allclose(sample["disparity"], other["disparity"], rtol=1e-6)
        for name in ("intrinsics", "disparity"):
            other[name] = sample[name]
        require_equal(sample, other)


def test_a_scene_of_many_samples_is_mapped_in_batches_of_one(urls):
    rows = raw(urls)
    decoder = huggingface.decode(("disparity", "__key__"), pairs="all", frames=[0, 3])

    mapped = rows.map(decoder, remove_columns=rows.column_names, batched=True, batch_size=1)

    assert len(set(keys(mapped))) == 4 * 15 * 2
    with pytest.raises(SelectionError, match=r"gives 30 samples, but map takes one per row"):
        next(iter(rows.map(decoder)))


@pytest.mark.parametrize("made", ["mapped", "concatenated", "running workers"])
def test_mapped_rows_draw_for_the_epoch_of_their_decoder(urls, made):
    rows = raw(urls)
    decoder = huggingface.decode(("frame_index",), frames=("random", 3))
    features = datasets.Features({"frame_index": datasets.Value("int64")})
    samples = rows.map(
        decoder, batched=True, batch_size=1, remove_columns=rows.column_names, features=features
    )
    if made == "concatenated":
        samples = datasets.concatenate_datasets([samples])
    if made == "running workers":
        samples = DataLoader(samples, batch_size=None, num_workers=1, persistent_workers=True)

    require_frames_of_epochs(samples, decoder)
    with pytest.raises(SelectionError, match="epoch must be a whole number from 0, got -1"):
        decoder.set_epoch(-1)


def test_without_datasets_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "datasets", None)

    with pytest.raises(ExtraError, match=r"pip install 'stereogenbench-data\[huggingface\]'"):
        huggingface.features()


DERIVED = {
    "mapped": lambda stream: stream.map(lambda sample: sample),
    "a shard's": lambda stream: stream.shard(num_shards=2, index=1),
    "shuffled, a rank's": lambda stream: split_dataset_by_node(
        stream.shuffle(seed=0, buffer_size=1), rank=1, world_size=2
    ),
}


@pytest.mark.parametrize(
    ("name", "workers"),
    [*((name, 0) for name in DERIVED), ("shuffled, a rank's", 2)],
)
def test_derived_datasets_use_their_own_epoch(small_shards, name, workers):
    options = {"fields": ("frame_index", "__key__"), "frames": ("random", 3)}
    expected = StereoPairs(small_shards, **options)
    derived = DERIVED[name](huggingface.iterable(small_shards, **options))
    loader = DataLoader(derived, batch_size=None, num_workers=workers)

    def drawn(epoch):
        derived.set_epoch(epoch)
        return {sample["__key__"] for sample in (loader if workers else derived)}

    epochs = {epoch: drawn(epoch) for epoch in ((3, 0) if workers else (3, 0, 1))}

    for epoch, found in epochs.items():
        expected.set_epoch(epoch)
        assert found <= set(keys(expected))
        assert len(found) in {6, 12}
    assert len({*map(frozenset, epochs.values())}) == len(epochs)


def test_the_wrong_suffix_of_depth_is_named(packed_depth):
    row = next(iter(raw(sorted(map(str, packed_depth.glob("*.tar"))))))

    with pytest.raises(StorageError, match=r'no cam_00_depth\.mkv.*features\(depth_suffix="b2f'):
        huggingface.decode(FIELDS)(row)
    match = r"depth_suffix must be 'mkv' or 'b2frame', got 'b2nd'"
    with pytest.raises(SelectionError, match=match):
        huggingface.features(depth_suffix="b2nd")
