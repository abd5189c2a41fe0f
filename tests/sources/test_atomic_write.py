"""Files written whole or not at all: what killed writers left goes, what living ones have stays."""

import errno
import multiprocessing
import os
import subprocess
import sys

import pytest

from stereogenbench_data.sources.atomic_write import write_whole, writing_output, writing_whole

WRITER = """
import sys, time
from pathlib import Path
from stereogenbench_data.sources.atomic_write import writing_whole

with writing_whole(Path(sys.argv[1])) as file:
    file.write(b"half of it")
    file.flush()
    print("begun", flush=True)
    time.sleep(60)
"""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def writer(tmp_path):
    """A process that has half written ``notes.json``; ended at the end."""
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, tmp_path / "notes.json"], stdout=subprocess.PIPE
    )
    assert process.stdout.readline() == b"begun\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_what_a_killed_writer_left_is_removed_by_the_next_one(writer, tmp_path):
    writer.kill()
    writer.wait()
    assert names(tmp_path) == [".notes.json.unfinished"]

    write_whole(tmp_path / "notes.json", b"whole")

    assert names(tmp_path) == ["notes.json"]
    assert (tmp_path / "notes.json").read_bytes() == b"whole"


def test_what_a_living_writer_has_is_left_alone(writer, tmp_path):
    write_whole(tmp_path / "notes.json", b"whole")

    assert names(tmp_path) == [".notes.json.unfinished", "notes.json"]
    assert writer.poll() is None


def test_an_error_leaves_the_file_as_it_was_and_names_it(tmp_path):
    path = tmp_path / "notes.json"
    path.write_bytes(b"before")

    def fail():
        with writing_whole(path) as file:
            file.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        fail()
    with pytest.raises(FileNotFoundError, match=r"gone/notes\.json'"):
        write_whole(tmp_path / "gone" / "notes.json", b"")

    assert names(tmp_path) == ["notes.json"]
    assert path.read_bytes() == b"before"


def test_nothing_is_written_through_links_that_lie_where_unfinished_files_do(tmp_path):
    other = tmp_path / "other"
    other.write_bytes(b"kept")
    (tmp_path / ".notes.json.unfinished").symlink_to(other)
    os.link(other, tmp_path / ".notes.json.unfinished1")

    write_whole(tmp_path / "notes.json", b"whole")

    assert other.read_bytes() == b"kept"
    assert names(tmp_path) == ["notes.json", "other"]


def test_a_link_that_the_user_named_is_followed(tmp_path):
    (tmp_path / "report.md").symlink_to(tmp_path / "real.md")

    with writing_output(tmp_path / "report.md") as file:
        file.write(b"text")

    assert (tmp_path / "report.md").is_symlink()
    assert (tmp_path / "real.md").read_bytes() == b"text"


def _write_often(path, number):
    for _ in range(30):
        write_whole(path, bytes([number]) * 1000)


def test_writers_of_one_file_at_once_leave_one_whole_file(tmp_path):
    path = tmp_path / "notes.json"
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=_write_often, args=(path, number)) for number in range(4)]
    for each in writers:
        each.start()
    for each in writers:
        each.join()

    assert [each.exitcode for each in writers] == [0] * 4
    assert names(tmp_path) == ["notes.json"]
    assert len(path.read_bytes()) == 1000
    assert len(set(path.read_bytes())) == 1
