"""A member as a file: its own bytes and no others, each fetched once, ahead of the reader."""

import io
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.schema.records import Member
from stereogenbench_data.sources.ranged_file import (
    FIRST_BLOCK,
    KEPT_BYTES,
    LARGEST_BLOCK,
    FileSlice,
    RangedFile,
)

MIB = 1024 * 1024


class Store:
    """Bytes that can be fetched; it notes what was asked for."""

    def __init__(self, size):
        self.data = bytes(number % 251 for number in range(4099)) * (size // 4099 + 1)
        self.data = self.data[:size]
        self.asked = []

    def fetch(self, start, stop):
        assert 0 <= start < stop <= len(self.data)
        self.asked.append((start, stop))
        return self.data[start:stop]

    @property
    def fetched(self):
        return sum(stop - start for start, stop in self.asked)

    def open(self):
        return RangedFile(self.fetch, size=len(self.data))


steps = st.lists(
    st.one_of(
        st.tuples(st.just("read"), st.integers(-1, 3000)),
        st.tuples(st.just("seek"), st.integers(0, 6000)),
        st.tuples(st.just("skip"), st.integers(0, 500)),
        st.tuples(st.just("from end"), st.integers(-4000, 0)),
    ),
    max_size=20,
)


def do(file, what, number):
    if what == "read":
        return file.read(number)
    where = {"seek": io.SEEK_SET, "skip": io.SEEK_CUR, "from end": io.SEEK_END}[what]
    return file.seek(number, where), file.tell()


@given(steps=steps)
@settings(max_examples=60)
def test_ranged_files_and_slices_read_as_a_file_of_their_bytes_does(tmp_path_factory, steps):
    store = Store(5000)
    path = tmp_path_factory.getbasetemp() / "slice.bin"
    path.write_bytes(b"before" + store.data + b"behind")
    plain = io.BytesIO(store.data)
    expected = [do(plain, *step) for step in steps]

    with FileSlice(path, Member("slice.bin", 6, 5000)) as cut, store.open() as ranged:
        for file in (cut, ranged):
            assert [do(file, *step) for step in steps] == expected


def passed_over(file):
    """Read a file as FFmpeg reads MP4: the start, the table at the end, then all between."""
    file.read(100)
    file.seek(-500, io.SEEK_END)
    file.read()
    file.seek(100)
    read_on(file)


def read_on(file):
    while file.read(32768):
        pass


def test_a_pass_forwards_fetches_every_byte_once_in_blocks_that_grow():
    store = Store(9 * MIB + 17)
    read_on(store.open())

    assert store.fetched == len(store.data)
    sizes = [stop - start for start, stop in store.asked]
    assert sizes[:5] == [FIRST_BLOCK, 2 * FIRST_BLOCK, 4 * FIRST_BLOCK, 8 * FIRST_BLOCK, MIB]
    assert max(sizes) == LARGEST_BLOCK
    assert len(sizes) < 16


def test_a_visit_to_the_end_and_back_fetches_no_byte_twice():
    """MP4 may hold its table behind the pictures."""
    store = Store(1 * MIB)
    passed_over(store.open())

    assert store.fetched == len(store.data)


def test_what_is_kept_is_bounded():
    store = Store(9 * MIB)
    file = store.open()
    read_on(file)
    asked = len(store.asked)
    for start in (9 * MIB - KEPT_BYTES // 2, 9 * MIB - KEPT_BYTES - LARGEST_BLOCK, 0):
        file.seek(start)
        file.read(1)

    assert len(store.asked) == asked + 2
    assert store.asked[-1] == (0, FIRST_BLOCK)


def test_a_file_ends_where_a_fetch_failed_and_nothing_is_fetched_again():
    """FFmpeg may take an error for the end of the file, and PyAV prints the first of two."""
    tries = []

    def fail(start, stop):
        tries.append(start)
        raise StorageError("the server is gone")

    file = RangedFile(fail, size=10)
    with pytest.raises(StorageError, match="the server is gone"):
        file.read(1)

    assert file.read(1) == b""
    assert len(tries) == 1
    assert str(file.failure) == "the server is gone"


@pytest.mark.parametrize("size", [700, 5 * MIB + 3])
def test_a_pass_over_all_bytes_compares_them_with_their_checksum(size):
    store = Store(size)
    right = zlib.crc32(store.data)
    passed_over(RangedFile(store.fetch, size=size, name="a.mp4", crc32=right))
    passed_over(RangedFile(store.fetch, size=size, name="a.mp4"))
    wrong = RangedFile(store.fetch, size=size, name="a.mp4", crc32=right ^ 1)

    with pytest.raises(ShardError, match=f"a.mp4: has crc32 {right:08x}, .* {right ^ 1:08x}"):
        passed_over(wrong)
    assert isinstance(wrong.failure, ShardError)


def test_a_jump_back_over_what_is_no_longer_kept_changes_no_checksum():
    store = Store(4 * MIB)
    file = RangedFile(store.fetch, size=4 * MIB, name="a.mp4", crc32=zlib.crc32(store.data) ^ 1)
    while file.tell() < 3 * MIB + 5:
        file.read(32768)
    file.seek(MIB // 2)
    with pytest.raises(ShardError, match="has crc32"):
        read_on(file)

    assert store.fetched > 4 * MIB


def test_parts_of_a_member_are_not_compared():
    store = Store(9 * MIB)
    file = RangedFile(store.fetch, size=9 * MIB, name="a.mp4", crc32=1)
    for place in (8 * MIB, 5 * MIB, 2 * MIB):
        file.seek(place)
        file.read(MIB)

    assert file.failure is None


def test_a_slice_of_a_file_that_is_cut_while_it_is_open_says_so(tmp_path):
    path = tmp_path / "x.tar"
    path.write_bytes(bytes(100))
    with FileSlice(path, Member("x.tar", 50, 50)) as cut:
        path.write_bytes(bytes(70))
        with pytest.raises(StorageError, match="ends at byte 70, within a member of 50 bytes"):
            cut.read()
