"""Data behind a URL: few requests, fetched ahead, and nothing left of a broken pass."""

import gc
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.datasets.mapped import SeekTableWarning
from stereogenbench_data.errors import StorageError
from stereogenbench_data.media.seek_table import packed_tables, parse_tables
from stereogenbench_data.schema.release import depth_name, rgb_name
from stereogenbench_data.sources.cache import ShardCache
from stereogenbench_data.sources.retry import RetryPolicy
from stereogenbench_data.sources.web import pool_of
from tests.datasets.conftest import fork_and, same
from tests.servers.failing_server import Answer, serving
from tests.servers.tools import open_files, wait_until
from tests.shards.shard_files import scenes_of
from tests.sources.policies import LONGEST_S, ended

FIELDS = ("left", "right", "disparity", "frame_index", "__key__")


@pytest.fixture
def served(large_shards):
    """A server with `large_shards`, which counts."""
    with serving(large_shards) as server:
        yield server


@pytest.fixture
def alone():
    """Require that the test leaves no thread that fetches, and no socket, in this process."""
    before = len(sockets())
    yield
    wait_until(lambda: fetching() == [])
    pool_of.cache_clear()
    wait_until(lambda: len(sockets()) <= before)  # the server's threads close their own ends


def fetching():
    return [each.name for each in threading.enumerate() if each.name == "fetch-ahead"]


def sockets():
    gc.collect()
    return [path for path in open_files() if path.startswith("socket:")]


def parts_asked(server):
    """The requests for shards, without those for a size."""
    return [each for each in server.asked if each.path.endswith(".tar") and each.stop > 1]


def needed_bytes(folder, frame):
    """The bytes of the packets of a primary pair with depth that a frame decodes from."""
    index = SceneIndex.open(folder)
    index.load_seek_tables()
    scene = index.scene(0)
    tables = parse_tables(index.seek_tables(0))
    left, right = scene.rig.primary_pair
    total = 0
    for name in (rgb_name(left), rgb_name(right), depth_name(left)):
        table = tables[name]
        stop = min(frame + table.delay + 1, table.packets)
        total += table.bounds[stop] - table.bounds[table.key_before(frame)]
    return total


def test_the_first_frame_of_a_pair_takes_a_request_a_stream(served, large_shards, alone):
    pairs = StereoPairs(served.url, fields=FIELDS)
    served.asked.clear()
    sample = pairs[0]
    asked = parts_asked(served)
    pairs.close()

    assert same(sample, StereoPairs(large_shards, fields=FIELDS)[0])
    assert len(asked) <= 3
    assert sum(each.sent for each in asked) <= 1.05 * needed_bytes(large_shards, 0)


@pytest.mark.filterwarnings("ignore:1 of 2 workers have nothing to do")
@pytest.mark.parametrize(
    ("frames", "workers"), [("all", 2), (("random", 3), 0), (("clips", 3), 2)], ids=str
)
def test_a_pass_gives_what_local_shards_give_in_few_requests(
    frames, workers, served, large_shards, alone
):
    options = {"fields": FIELDS, "frames": frames}
    expected = StereoPairs(large_shards, **options).loader(2, drop_last=False)
    loader = StereoPairs(served.url, **options).loader(2, num_workers=workers, drop_last=False)
    served.asked.clear()

    for batch, other in zip(loader, expected, strict=True):
        assert same(batch, other)
    loader.close()

    asked = parts_asked(served)
    assert len(asked) <= 3 * 2 * len(loader.batches.dataset.plan.scene_rows) + 6


def test_a_broken_pass_and_a_dropped_dataset_leave_nothing(served, alone):
    pairs = StereoPairs(served.url, fields=FIELDS, frames="all")
    for _ in pairs.loader(1):
        break
    pairs[0]
    del pairs


def test_a_fork_in_the_middle_of_a_pass_reads_for_itself(served, large_shards, alone):
    local = StereoPairs(large_shards, fields=("left",), frames="all")
    expected = local[3]["left"].numpy()
    pairs = StereoPairs(served.url, fields=("left",), frames="all")
    loader = pairs.loader(1, drop_last=False)
    batches = iter(loader)
    next(batches)

    # In numpy: torch's own threads do not survive a fork.
    assert fork_and(lambda: np.testing.assert_array_equal(pairs[3]["left"], expected)) == 0
    assert len([*batches]) == len(loader) - 1
    loader.close()
    pairs.close()


def test_an_error_comes_at_the_sample_that_needs_the_bytes(small_shards, alone):
    scenes = [*scenes_of(small_shards).values()]
    first, shard = scenes[0], scenes[-1].members[rgb_name(0)].path
    last = next(scene for scene in scenes if scene.members[rgb_name(0)].path == shard)
    assert shard != first.members[rgb_name(0)].path
    with serving(small_shards) as server:
        server.always = {shard: Answer(status=403)}
        pairs = StereoPairs(server.url, fields=("left", "__key__"))
        loader = pairs.loader(1, shuffle=False, drop_last=False)
        batches = iter(loader)
        assert next(batches)["__key__"][0].startswith(first.id.key)
        with pytest.raises(StorageError, match=rf"{last.id.key}.*frames \(0,\).*{shard}.*403"):
            list(batches)
        loader.close()


def test_what_is_fetched_ahead_fills_a_cache(served, large_shards, tmp_path, alone):
    cache = ShardCache(tmp_path / "cache", limit_bytes=10**9)
    options = {"fields": FIELDS, "frames": "all", "check": "opened"}
    for _ in range(2):
        loader = StereoPairs(served.url, cache=cache, **options).loader(2, drop_last=False)
        expected = StereoPairs(large_shards, **options).loader(2, drop_last=False)
        assert all(same(*each) for each in zip(loader, expected, strict=True))
        loader.close()
        asked, served.asked[:] = parts_asked(served), []

    assert asked == []
    assert cache.used_bytes() > 0


def with_tables(shards, folder, change):
    """Return a copy of shards whose index has other seek tables, or none."""
    path = shutil.copytree(shards, folder) / "index.parquet"
    table = pq.read_table(path)
    place = table.schema.get_field_index("seek_tables")
    if change is None:
        table = table.remove_column(place)
    else:
        packed = [change(each) for each in table.column("seek_tables").to_pylist()]
        table = table.set_column(place, "seek_tables", pa.array(packed, type=pa.binary()))
    pq.write_table(table, path)
    return folder


def shifted(packed):
    """Tables whose packets lie elsewhere: in order, within the file, and wrong."""
    tables = {}
    for name, table in parse_tables(packed).items():
        first, last = table.bounds[0], table.bounds[-1]
        even = [first + (last - first) * n // table.packets for n in range(table.packets + 1)]
        object.__setattr__(table, "bounds", tuple(even))
        tables[name] = table
    return packed_tables(tables)


def swapped(packed):
    """Tables that each stand for the next video."""
    tables = parse_tables(packed)
    names = sorted(tables)
    return packed_tables(dict(zip(names, [tables[n] for n in names[1:] + names[:1]], strict=True)))


@pytest.mark.parametrize(
    "change",
    [shifted, swapped, lambda packed: packed[:-3]],
    ids=["shifted", "swapped", "cut"],
)
@pytest.mark.filterwarnings("ignore::stereogenbench_data.datasets.mapped.SeekTableWarning")
def test_a_wrong_seek_table_gives_the_right_frames(change, large_shards, tmp_path, alone):
    folder = with_tables(large_shards, tmp_path / "shards", change)
    options = {"fields": FIELDS, "frames": [0, 2, 4, 6], "check": "metadata"}
    expected = StereoPairs(large_shards, **options)
    with serving(folder) as server:
        pairs = StereoPairs(server.url, **options)
        assert all(same(pairs[number], expected[number]) for number in (3, 0, 1))
        pairs.close()


def test_an_index_of_an_earlier_version_reads_with_a_hint(large_shards, tmp_path, alone):
    folder = with_tables(large_shards, tmp_path / "shards", None)
    with serving(folder) as server:
        with pytest.warns(SeekTableWarning, match=rf"{server.url}.*stereogenbench index"):
            pairs = StereoPairs(server.url, fields=("left",))
        expected = StereoPairs(large_shards, fields=("left",))
        assert same(pairs[0], expected[0])
        pairs.close()


def test_closing_does_not_wait_for_requests_that_hang_and_they_end(served):
    index = SceneIndex.open(served.url, retry=RetryPolicy(timeout_s=0.5))
    pairs = StereoPairs(index, fields=("left",), frames="all")
    shards = {member.path for member in pairs.index.scene(0).members.values()}
    served.always = {path: Answer(delay_s=2 * LONGEST_S) for path in shards}
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(next, iter(pairs.loader(1)))
        wait_until(fetching)
        ended(pairs.close)
        assert isinstance(waiting.exception(), StorageError)

    ended(lambda: [thread.join() for thread in threading.enumerate() if "fetch" in thread.name])
    assert fetching() == []
