"""Files written whole or not at all: what killed writers left goes, what living ones have stays."""

import errno
import fcntl
import multiprocessing
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.files import (
    locked,
    open_atomic,
    open_output,
    try_locked,
    write_atomic,
)

FORK = multiprocessing.get_context("fork")


@contextmanager
def process_in(block):
    """A process that is inside a block, until it is killed."""
    begun = FORK.Event()

    def act():
        with block:
            begun.set()
            time.sleep(60)

    process = FORK.Process(target=act)
    process.start()
    assert begun.wait(60)
    yield process
    process.kill()
    process.join()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_a_killed_writer_left_is_removed_by_the_next_one(tmp_path):
    with process_in(open_atomic(tmp_path / "notes.json")):
        pass
    assert names(tmp_path) == [".notes.json.unfinished"]

    write_atomic(tmp_path / "notes.json", b"whole")

    assert names(tmp_path) == ["notes.json"]
    assert (tmp_path / "notes.json").read_bytes() == b"whole"


def test_what_a_living_writer_has_is_left_alone(tmp_path):
    with process_in(open_atomic(tmp_path / "notes.json")) as writer:
        write_atomic(tmp_path / "notes.json", b"whole")

        assert names(tmp_path) == [".notes.json.unfinished", "notes.json"]
        assert writer.is_alive()


def test_an_error_leaves_the_file_as_it_was_and_names_it(tmp_path):
    path = tmp_path / "notes.json"
    path.write_bytes(b"before")

    def fail():
        with open_atomic(path) as file:
            file.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        fail()
    with pytest.raises(FileNotFoundError, match=r"gone/notes\.json'"):
        write_atomic(tmp_path / "gone" / "notes.json", b"")

    assert names(tmp_path) == ["notes.json"]
    assert path.read_bytes() == b"before"


def test_nothing_is_written_through_links_that_lie_where_unfinished_files_do(tmp_path):
    other = tmp_path / "other"
    other.write_bytes(b"kept")
    (tmp_path / ".notes.json.unfinished").symlink_to(other)
    os.link(other, tmp_path / ".notes.json.unfinished1")

    write_atomic(tmp_path / "notes.json", b"whole")

    assert other.read_bytes() == b"kept"
    assert names(tmp_path) == ["notes.json", "other"]


def test_a_link_that_the_user_named_is_followed(tmp_path):
    (tmp_path / "report.md").symlink_to(tmp_path / "real.md")

    with open_output(tmp_path / "report.md") as file:
        file.write(b"text")

    assert (tmp_path / "report.md").is_symlink()
    assert (tmp_path / "real.md").read_bytes() == b"text"


def _write_often(path, number):
    for _ in range(30):
        write_atomic(path, bytes([number]) * 1000)


def test_writers_of_one_file_at_once_leave_one_whole_file(tmp_path):
    path = tmp_path / "notes.json"
    with FORK.Pool(4) as pool:
        pool.starmap(_write_often, [(path, number) for number in range(4)], chunksize=1)

    assert names(tmp_path) == ["notes.json"]
    assert len(path.read_bytes()) == 1000
    assert len(set(path.read_bytes())) == 1


def _is_free(lock):
    with try_locked(lock) as is_held:
        return is_held


def test_a_lock_is_held_against_other_threads(tmp_path):
    with locked(tmp_path / "lock"), ThreadPoolExecutor(1) as thread:
        assert not thread.submit(_is_free, tmp_path / "lock").result()

    assert _is_free(tmp_path / "lock")


def test_a_lock_is_freed_when_its_process_is_killed(tmp_path):
    with process_in(locked(tmp_path / "lock")) as process:
        assert not _is_free(tmp_path / "lock")
        threading.Timer(0.2, process.kill).start()

        with locked(tmp_path / "lock"):
            process.join(60)
            assert process.exitcode != 0


def test_a_lock_is_freed_though_a_forked_process_has_its_file_open(tmp_path):
    ended = FORK.Event()
    with locked(tmp_path / "lock"):
        child = FORK.Process(target=ended.wait)
        child.start()
    try:
        assert _is_free(tmp_path / "lock")
    finally:
        ended.set()
        child.join()


def test_a_file_system_without_locks_is_named_where_locks_are_needed(tmp_path, monkeypatch):
    def unsupported(handle, operation):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    with (
        pytest.raises(StorageError, match=r"/lock: .*\(No locks available\)\. Choose another"),
        locked(tmp_path / "lock"),
    ):
        pass
    assert _is_free(tmp_path / "lock")
