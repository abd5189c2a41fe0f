"""Ranges fetched ahead: exactly the bytes that are needed, in few requests, within a bound."""

import threading

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.fetch_ahead import LARGEST_GAP, FetchAhead, Wanted

CONTENT = bytes(range(256)) * 40


class Log:
    """What was asked of a place."""

    def __init__(self):
        self.asked = []

    def fetch(self, start, stop):
        self.asked.append((start, stop))
        return CONTENT[start:stop]

    def wanted(self, *ranges):
        return [Wanted("place", start, stop, self.fetch) for start, stop in ranges]


def read(ahead, start, stop):
    """All bytes of a range, from the parts that hold them."""
    data = b""
    while start < stop:
        begin, part = ahead.read("place", start)
        data += part[start - begin : stop - begin]
        start = begin + len(part)
    return data


ranges = st.tuples(st.integers(0, 9000), st.integers(1, 1200)).map(lambda r: (r[0], r[0] + r[1]))


@settings(max_examples=40)
@given(st.lists(st.lists(ranges, max_size=4), min_size=1, max_size=8))
@example([[(2732, 2999), (5047, 5996)]])  # as far apart as one request may join
def test_every_byte_that_is_needed_is_fetched_once_and_no_other(samples):
    ahead, log = FetchAhead(), Log()
    for number, needed in enumerate(samples):
        ahead.plan(number, log.wanted(*needed))
    ahead.begin()
    for number, needed in enumerate(samples):
        for start, stop in needed:
            assert read(ahead, start, stop) == CONTENT[start:stop]
        ahead.release(number)

    needed = {byte for sample in samples for start, stop in sample for byte in range(start, stop)}
    fetched = [byte for start, stop in log.asked for byte in range(start, stop)]
    assert len(fetched) == len(set(fetched))
    assert needed <= set(fetched)
    gaps = sorted(set(fetched) - needed)
    for gap in gaps:  # between two ranges that one request takes
        assert any(byte in needed for byte in range(gap - LARGEST_GAP, gap))
        assert any(byte in needed for byte in range(gap, gap + LARGEST_GAP + 1))
    assert ahead.planned_bytes == 0
    ahead.close()


def test_ranges_of_later_samples_wait_and_grow():
    ahead, log = FetchAhead(), Log()
    ahead.plan(1, log.wanted((0, 10)))
    ahead.plan(2, log.wanted((5000, 5010)))
    ahead.begin(1)
    assert read(ahead, 0, 10) == CONTENT[:10]
    ahead.plan(3, log.wanted((5010, 5020)))
    ahead.begin()

    assert read(ahead, 5000, 5020) == CONTENT[5000:5020]
    assert log.asked == [(0, 10), (5000, 5020)]
    ahead.close()


def test_eight_requests_are_made_at_a_time():
    running, most, lock, eight = [0], [0], threading.Lock(), threading.Barrier(8, timeout=60)

    def fetch(start, stop):
        with lock:
            running[0] += 1
            most[0] = max(most[0], running[0])
        eight.wait()
        with lock:
            running[0] -= 1
        return bytes(stop - start)

    names = [f"place {number}" for number in range(16)]
    ahead = FetchAhead()
    ahead.plan(1, [Wanted(name, 0, 1, fetch) for name in names])
    ahead.begin()
    for name in names:
        ahead.read(name, 0)
    ahead.close()

    assert most[0] == 8


def test_an_error_is_raised_where_the_bytes_are_read_and_not_before():
    def fetch(start, stop):
        raise StorageError("place: gone.")

    ahead = FetchAhead()
    ahead.plan(1, [Wanted("place", 0, 5, fetch)])
    ahead.begin()
    with pytest.raises(StorageError, match="place: gone"):
        ahead.read("place", 3)

    assert ahead.read("place", 3) is None
    ahead.close()
