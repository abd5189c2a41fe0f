"""The same samples from shards, beside you or behind a URL, with few bytes and through faults."""

import shutil

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from stereogenbench_data import PAIR_FIELDS, SceneIndex, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.media.seek_table import parse_tables
from stereogenbench_data.sources.cache import ShardCache
from stereogenbench_data.sources.retry import RetryPolicy
from tests.datasets.conftest import same
from tests.servers.failing_server import Answer, serving
from tests.servers.hub import REPOSITORY

FIELDS = tuple(name for name in PAIR_FIELDS if name != "__url__")


@pytest.fixture
def impatient(monkeypatch):
    """Waits of no time between tries."""
    monkeypatch.setattr(RetryPolicy, "first_wait_s", 0.001)


@pytest.fixture
def shards_served(web, small_shards):
    """The address of a server, that can be told to fail, with `small_shards`."""
    shutil.copytree(small_shards, web.folder, dirs_exist_ok=True)
    return web


@pytest.fixture
def root_of(request, small_shards):
    """Where `small_shards` is, at a kind of place."""

    def find(kind):
        if kind == "folder":
            return str(small_shards)
        server = request.getfixturevalue("shards_served" if kind == "web" else kind)
        if kind == "hub":
            return f"hf://datasets/{REPOSITORY}"
        return server.url if kind == "web" else server

    return find


@pytest.fixture(params=["folder", "web", "nginx", "hub", "s3"])
def root(request, root_of):
    """`small_shards` at every kind of place."""
    return root_of(request.param)


@pytest.mark.parametrize("kind", [np.int64, torch.tensor])
def test_samples_may_be_numbered_by_numpy_and_torch(shards_served, kind):
    pairs = StereoPairs(shards_served.url, fields=("left", "__key__"), frames="all")
    loader = DataLoader(pairs, 2, sampler=[kind(3), kind(5), kind(1)])

    assert [each for batch in loader for each in batch["__key__"]] == [
        pairs[number]["__key__"] for number in (3, 5, 1)
    ]


def test_shards_give_what_the_released_files_give(root, indexed_release):
    expected = StereoPairs(indexed_release, fields=FIELDS, pairs="adjacent", frames=[0, 3])
    pairs = StereoPairs(root, fields=(*FIELDS, "__url__"), pairs="adjacent", frames=[0, 3])

    assert len(pairs) == len(expected)
    for number in range(0, len(pairs), 3):
        found = pairs[number]
        assert found.pop("__url__").startswith(f"{root}/eval-" if number == 0 else str(root))
        assert same(found, expected[number])


@pytest.mark.parametrize(("context", "place"), [("spawn", "web"), ("fork", "hub"), ("fork", "s3")])
def test_workers_read_over_connections_of_their_own(context, place, root_of, indexed_release):
    expected = StereoPairs(indexed_release, fields=FIELDS, frames=[0, 1])
    pairs = StereoPairs(root_of(place), fields=FIELDS, frames=[0, 1])
    assert same(pairs[0], expected[0])
    loader = DataLoader(
        pairs, batch_size=None, num_workers=2, multiprocessing_context=context, timeout=60
    )

    for loaded, sample in zip(loader, expected, strict=True):
        assert same(loaded, sample)
    assert same(pairs[1], expected[1])


def test_a_server_that_fails_now_and_then_changes_nothing(
    shards_served, indexed_release, impatient
):
    chosen = {"frames": "all", "scenes": "train/Uniform/SynthStage/scene_000000"}
    expected = StereoPairs(indexed_release, **chosen)
    pairs = StereoPairs(shards_served.url, **chosen)
    cut_short = [Answer(stop_after=count) for count in (0, 1500, 2000, 100)]
    shards_served.answers = [Answer(status=503), *cut_short[:2], Answer(status=429), *cut_short[2:]]

    assert all(same(pairs[number], expected[number]) for number in range(len(pairs)))
    assert shards_served.answers == []


def test_a_server_that_dies_in_the_middle_is_reported_once(large_shards, impatient, capsys):
    with serving(large_shards) as web:
        pairs = StereoPairs(web.url, frames="all")
        assert "disparity" in pairs[0]
    match = (
        rf"scene_000000, frames \(6,\): {web.url}/train-Uniform-000000.tar : cannot be read, "
        r"at byte \d+ of \d+ \(.*Connection refused; 10 tries\). Check the network"
    )
    with pytest.raises(StorageError, match=match):
        pairs[6]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("video", ["rgb.mp4", "depth.mkv"])
def test_bytes_that_never_come_are_no_damaged_video(video, shards_served, impatient):
    """FFmpeg takes an error for the end of the file: the cause must be told all the same."""
    pairs = StereoPairs(shards_served.url, family="IPD_Gaussian", frames="all")
    row = pairs.plan.locate(0, epoch=0).row
    scene = pairs.index.scene(row)
    name = f"cam_{scene.rig.primary_pair[0]:02d}_{video}"
    member = scene.members[name]
    shard = f"{shards_served.url}/{member.path}"
    whole = (shards_served.folder / member.path).read_bytes()
    first = member.offset + parse_tables(pairs.index.seek_tables(row))[name].bounds[0]
    shards_served.always[member.path] = Answer(
        change=lambda body: b"" if whole[first : first + 40] in body else body
    )

    with pytest.raises(StorageError, match=rf"{shard} : cannot be read, at byte \d+ of \d+"):
        pairs[0]
    del shards_served.always[member.path]
    assert "disparity" in pairs[0]


def test_a_cache_that_was_damaged_on_disk_is_filled_again(shards_served, indexed_release, tmp_path):
    cache = ShardCache(tmp_path / "cache", limit_bytes=10**8)
    expected = StereoPairs(indexed_release, frames="all", family="IPD_Gaussian")
    pairs = StereoPairs(shards_served.url, frames="all", family="IPD_Gaussian", cache=cache)
    assert same(pairs[0], expected[0])
    pairs.close()
    for item in (tmp_path / "cache").rglob("*.member"):
        data = bytearray(item.read_bytes())
        middle = len(data) // 2
        data[middle : middle + 400] = bytes(400)
        item.write_bytes(data)

    assert all(same(pairs[number], expected[number]) for number in range(len(pairs)))


def test_patience_is_set_where_data_are_opened_and_goes_to_the_workers(shards_served):
    index = SceneIndex.open(shards_served.url, retry=RetryPolicy(timeout_s=0.2))
    pairs = StereoPairs(index, fields=("left",), family="IPD_Gaussian")
    shards_served.always["train-IPD_Gaussian-000000.tar"] = Answer(delay_s=1.0)

    with pytest.raises(StorageError, match=r"cannot be read, .* slower than timeout_s=0.2"):
        pairs[0]
    with pytest.raises(StorageError, match=r"cannot be read, .* slower than timeout_s=0.2"):
        list(DataLoader(pairs, num_workers=1))
