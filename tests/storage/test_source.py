"""Members: the file that was indexed, or an error that says what was found."""

import os

import pytest

from stereogenbench_data.errors import SchemaError, StorageError
from stereogenbench_data.schema.records import Member
from stereogenbench_data.storage.source import member_path, read_member


@pytest.fixture
def root(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.json").write_bytes(b"12345")
    return tmp_path


def test_a_member_is_read_from_below_the_root(root):
    member = Member("a/b.json", 0, 5)

    assert member_path(root, member) == root / "a" / "b.json"
    assert read_member(str(root), member) == b"12345"


@pytest.mark.parametrize(
    "path",
    ["/etc/passwd", "../a/b.json", "a/../../x", "a/..", "..", "", "a//b", "a/./b", "C:/a", "a\\b"],
)
def test_a_path_that_could_leave_the_root_is_refused(root, path):
    with pytest.raises(StorageError, match="is relative to the data's root and stays inside it"):
        member_path(root, Member(path, 0, 5))


def test_a_name_that_begins_or_ends_with_dots_is_let_through(root):
    (root / "a" / "..b.").write_bytes(b"1")

    assert read_member(root, Member("a/..b.", 0, 1)) == b"1"


def test_a_file_of_another_size_is_named_with_both_sizes(root):
    with pytest.raises(StorageError, match=r"b.json: has 5 bytes, and the index says 6. The file"):
        read_member(root, Member("a/b.json", 0, 6))


def test_a_file_that_is_gone_is_named(root):
    with pytest.raises(StorageError, match=r"c.json: cannot be read \(No such file.*index` again"):
        read_member(root, Member("a/c.json", 0, 5))


def test_a_metadata_file_that_is_too_large_is_not_read(root):
    os.truncate(root / "a" / "b.json", 2**26)

    with pytest.raises(SchemaError, match=r"this one has 67,108,864. It was not read"):
        read_member(root, Member("a/b.json", 0, 2**26))


def test_a_pipe_in_a_files_place_is_named_and_not_waited_for(root):
    os.mkfifo(root / "pipe")

    with pytest.raises(StorageError, match=r"pipe: is no file. Put the release's own file"):
        read_member(root, Member("pipe", 0, 0))


def test_a_folder_in_a_files_place_is_named(root):
    size = (root / "a").stat().st_size

    with pytest.raises(StorageError, match=r"a: is no file. Put the release"):
        read_member(root, Member("a", 0, size))
