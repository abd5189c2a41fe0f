"""The cache: each member fetched once, whole, within its limit, and nobody else's files touched."""

import errno
import multiprocessing
import os
import subprocess
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.schema.records import Member
from stereogenbench_data.sources import cache as cache_module
from stereogenbench_data.sources.cache import FOLDER_NAME, ShardCache
from stereogenbench_data.sources.remote import RemoteObject
from tests.servers.failing_server import Answer
from tests.servers.tools import small_disk, wait_until

FORK = multiprocessing.get_context("fork")
DATA = bytes(number * 7 % 256 for number in range(100_000))


class Shard(RemoteObject):
    """A local shard that records what is fetched, and returns the bytes in `wrong` first."""

    def __init__(self, data=DATA, *, where="https://h/x.tar"):
        super().__init__(where)
        self.data = data
        self.fetched = []
        self.wrong = []

    def chunks(self, start, stop):
        self.fetched.append((start, stop))
        data = self.wrong.pop() if self.wrong else self.data[start:stop]
        for first in range(0, len(data), 400):
            yield data[first : first + 400]


def member(offset, size, **how):
    crc32 = how.get("crc32", zlib.crc32(DATA[offset : offset + size]))
    return Member(how.get("path", "x.tar"), offset, size, crc32)


def read(cache, wanted, shard, *, revision="1"):
    with cache.open(wanted, remote=shard, revision=revision) as file:
        return file.read()


def items(folder):
    return sorted((folder / FOLDER_NAME / "items").iterdir())


@pytest.fixture
def shard():
    return Shard()


@pytest.fixture
def cache(tmp_path):
    return ShardCache(tmp_path, limit_bytes=10_000)


def test_a_member_is_fetched_once(cache, shard):
    for _ in range(3):
        assert read(cache, member(1000, 2000), shard) == DATA[1000:3000]

    assert shard.fetched == [(1000, 3000)]
    assert cache.used_bytes() == 2000


@pytest.mark.parametrize(
    ("other", "revision"),
    [
        (member(1000, 2000), "2"),
        (member(1000, 2000, path="y.tar"), "1"),
        (member(1000, 2000, crc32=None), "1"),
        (member(1001, 2000), "1"),
    ],
    ids=["revision", "shard", "checksum", "offset"],
)
def test_what_differs_in_anything_is_another_item(cache, shard, other, revision):
    read(cache, member(1000, 2000), shard)

    assert read(cache, other, shard, revision=revision) == DATA[other.offset :][: other.size]
    assert len(shard.fetched) == 2


def test_members_with_a_checksum_are_shared_by_all_addresses_others_are_not(cache):
    one, other = Shard(where="https://a/x.tar"), Shard(where="https://b/x.tar")
    for crc32 in (zlib.crc32(DATA[:50]), None):
        read(cache, member(0, 50, crc32=crc32), one)
        read(cache, member(0, 50, crc32=crc32), other)

    assert (len(one.fetched), len(other.fetched)) == (2, 1)


def test_wrong_bytes_are_fetched_again_once(cache, shard):
    shard.wrong = [bytes(2000)]

    assert read(cache, member(1000, 2000), shard) == DATA[1000:3000]
    assert len(shard.fetched) == 2


def test_bytes_that_stay_wrong_are_an_error_and_are_not_kept(cache, shard, tmp_path):
    shard.wrong = [bytes(2000), bytes(2000)]

    with pytest.raises(ShardError, match=r"h/x.tar : the 2000 bytes from 1000 .*, twice"):
        cache.open(member(1000, 2000), remote=shard, revision="1")
    assert items(tmp_path) == []
    assert cache.used_bytes() == 0


def test_an_item_that_was_written_into_is_fetched_again(cache, shard, tmp_path):
    read(cache, member(1000, 2000), shard)
    items(tmp_path)[0].write_bytes(bytes(2000))

    assert read(cache, member(1000, 2000), shard) == DATA[1000:3000]
    assert len(shard.fetched) == 2


@pytest.mark.parametrize(("crc32", "fetched"), [(zlib.crc32(DATA[1000:3000]), 1), (None, 2)])
def test_an_item_of_another_time_is_kept_by_its_checksum(cache, shard, tmp_path, crc32, fetched):
    wanted = member(1000, 2000, crc32=crc32)
    read(cache, wanted, shard)
    os.utime(items(tmp_path)[0])
    read(cache, wanted, shard)

    assert len(shard.fetched) == fetched
    assert read(cache, wanted, shard) == DATA[1000:3000]
    assert len(shard.fetched) == fetched


def test_a_damaged_item_is_found_and_dropped_when_it_is_looked_for(cache, shard, tmp_path):
    wanted = member(1000, 2000)
    how = {"where": shard.where, "revision": "1"}
    assert not cache.drop_damaged(wanted, **how)
    read(cache, wanted, shard)
    assert not cache.drop_damaged(wanted, **how)
    item = items(tmp_path)[0]
    times = item.stat()
    item.write_bytes(bytes(2000))
    os.utime(item, ns=(times.st_atime_ns, times.st_mtime_ns))

    assert cache.drop_damaged(wanted, **how)
    assert read(cache, wanted, shard) == DATA[1000:3000]


def test_what_was_not_used_for_longest_goes_first(cache, shard, tmp_path):
    first, second, third = (member(3000 * each, 3000) for each in range(3))
    for age, wanted in enumerate((first, second, third)):
        known = set(items(tmp_path))
        read(cache, wanted, shard)
        newest = (set(items(tmp_path)) - known).pop()
        os.utime(newest, (1000 + age, newest.stat().st_mtime))
    read(cache, first, shard)
    shard.fetched.clear()

    read(cache, member(9000, 2000), shard)
    assert cache.used_bytes() == 8000
    read(cache, third, shard)
    read(cache, first, shard)
    assert shard.fetched == [(9000, 11_000)]
    read(cache, second, shard)
    assert len(shard.fetched) == 2


def test_a_reader_keeps_what_was_evicted_under_it(cache, shard):
    with cache.open(member(0, 6000), remote=shard, revision="1") as file:
        read(cache, member(6000, 6000), shard)

        assert cache.used_bytes() == 6000
        assert file.read() == DATA[:6000]


def test_an_item_above_the_limit_is_refused_with_both_sizes(cache, shard):
    with pytest.raises(StorageError, match="limit of 10000 bytes is below the 10001 bytes"):
        cache.open(member(0, 10_001), remote=shard, revision="1")
    assert shard.fetched == []
    assert len(read(cache, member(0, 10_000), shard)) == 10_000


def test_files_of_others_are_neither_counted_nor_deleted(cache, shard, tmp_path):
    (tmp_path / "mine.txt").write_bytes(bytes(50_000))
    (tmp_path / FOLDER_NAME / "items" / "mine.tar").write_bytes(bytes(50_000))
    for each in range(8):
        read(cache, member(4000 * each, 4000), shard)

    assert cache.used_bytes() == 8000
    assert (tmp_path / "mine.txt").stat().st_size == 50_000
    assert (tmp_path / FOLDER_NAME / "items" / "mine.tar").stat().st_size == 50_000


@pytest.mark.parametrize("limit", [0, -1, True], ids=repr)
def test_a_limit_that_is_no_number_of_bytes_is_refused(tmp_path, limit):
    with pytest.raises(StorageError, match=rf"{tmp_path}: .*, got {limit!r}: give a number"):
        ShardCache(tmp_path, limit_bytes=limit)


def test_a_full_disk_is_reported_and_leaves_nothing(cache, shard, tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(cache_module.os, "fsync", full)
    with pytest.raises(StorageError, match=r"\(No space left on device\)\. Make room"):
        cache.open(member(0, 2000), remote=shard, revision="1")
    assert items(tmp_path) == []


def test_a_count_that_was_lost_is_made_again(cache, shard, tmp_path):
    ledger = tmp_path / FOLDER_NAME / "locks" / "size"
    read(cache, member(0, 6000), shard)
    for damage in (b"", b"\xff nonsense"):
        ledger.write_bytes(damage)
        read(cache, member(6000, 3000), shard)
        read(cache, member(10_000, 3000), shard)

        assert cache.used_bytes() <= 10_000


@given(
    opened=st.lists(st.integers(0, 11), max_size=25),
    limit=st.integers(6000, 20_000),
)
@settings(max_examples=25)
def test_it_never_holds_more_than_its_limit_and_never_lies(tmp_path_factory, opened, limit):
    cache = ShardCache(tmp_path_factory.mktemp("cache"), limit_bytes=limit)
    shard = Shard()
    for each in opened:
        wanted = member(1000 * each, 500 * each)

        assert read(cache, wanted, shard) == DATA[1000 * each :][: 500 * each]
        assert cache.used_bytes() <= limit


def fill(folder, url, limit, numbers, barrier):
    """Open members of a shard through a cache, in a process of its own."""
    cache, remote = ShardCache(folder, limit_bytes=limit), RemoteObject(url)
    barrier.wait()
    for number in numbers:
        assert read(cache, member(1000 * number, 5000), remote) == DATA[1000 * number :][:5000]


@pytest.fixture
def fillers(tmp_path, web):
    """Return a function that starts a process for each list of members, all at once."""
    (web.folder / "x.tar").write_bytes(DATA)
    started = []

    def start(*shares, limit=10**6):
        barrier, url = FORK.Barrier(len(shares)), f"{web.url}/x.tar"
        processes = [
            FORK.Process(target=fill, args=(tmp_path / "cache", url, limit, share, barrier))
            for share in shares
        ]
        for process in processes:
            process.start()
        started.extend(processes)
        return processes

    yield start
    for process in started:
        process.kill()
        process.join()


def exit_codes(processes):
    for process in processes:
        process.join(60)
    return [process.exitcode for process in processes]


def test_processes_that_fill_it_at_once_fetch_once(fillers, web):
    web.always["x.tar"] = Answer(delay_s=0.5)

    assert exit_codes(fillers([4], [4], [4])) == [0] * 3
    assert [(asked.start, asked.stop) for asked in web.asked] == [(4000, 9000)]
    assert web.sent == 5000


def test_processes_that_need_more_than_fits_all_read_what_they_ask_for(fillers, tmp_path):
    shares = [[(first * 5 + each * 3) % 20 for each in range(20)] for first in range(3)]

    assert exit_codes(fillers(*shares, limit=22_000)) == [0] * 3
    assert ShardCache(tmp_path / "cache", limit_bytes=22_000).used_bytes() <= 22_000


def test_a_process_that_is_killed_while_it_fills_leaves_no_lock_and_no_half(fillers, web):
    web.answers = [Answer(stop_after=2000), Answer(delay_s=5.0)]
    (killed,) = fillers([4])
    wait_until(lambda: not web.answers)
    killed.kill()
    killed.join()

    assert exit_codes(fillers([4])) == [0]
    assert web.asked[-1].start == 4000


@pytest.fixture
def disk(tmp_path):
    """A small disk that can be made read-only."""
    with small_disk(tmp_path / "disk", size="1M") as place:
        yield place


def test_a_cache_that_may_only_be_read_serves_what_it_holds(disk, shard):
    wanted = member(1000, 2000)
    read(ShardCache(disk, limit_bytes=10_000), wanted, shard)
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)

    cache = ShardCache(disk, limit_bytes=10_000)

    assert read(cache, wanted, shard) == DATA[1000:3000]
    assert not cache.drop_damaged(wanted, where="https://h/x.tar", revision="1")
    assert shard.fetched == [(1000, 3000)]
    with pytest.raises(StorageError, match=r"Read-only file system\). Choose a place that can be"):
        read(cache, member(0, 1000), shard)


def test_the_rest_of_a_fill_that_was_killed_is_cleared_when_room_is_needed(cache, shard, tmp_path):
    (tmp_path / FOLDER_NAME / "items" / ("0" * 64 + ".part")).write_bytes(bytes(7000))
    assert cache.used_bytes() == 7000

    read(cache, member(0, 6000), shard)
    assert cache.used_bytes() == 6000
