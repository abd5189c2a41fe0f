"""What commands write: reports whole or not at all, and the place where it failed is named."""

import errno
import os
import resource
import signal
import stat
from contextlib import contextmanager
from pathlib import Path

import pytest

from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import write_report, writing
from tests.cli.command import invoke, one_line


@contextmanager
def files_of_at_most(size):
    """Let no file grow beyond a size, as a full disk lets none."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_only_an_error_of_writing_that_names_no_file_gets_the_place():
    with pytest.raises(OSError, match=r"report\.md"), writing(Path("report.md")):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match=r"other\.md") as named, writing(Path("report.md")):
        raise OSError(errno.ENOSPC, "No space left on device", "other.md")
    with pytest.raises(OSError, match="Input/output error") as reading, writing(Path("report.md")):
        raise OSError(errno.EIO, "Input/output error")

    assert named.value.filename == "other.md"
    assert reading.value.filename is None


@pytest.mark.parametrize(
    "words",
    [
        ("show", "-o", "sheet.png"),
        ("show", "-o", "clip.mp4"),
        ("show", "-o", "clip.gif"),
        ("stats", "-o", "plots"),
        ("audit", "--per-scene", "1", "--workers", "1", "-o", "audit.md"),
    ],
    ids=lambda words: words[-1],
)
def test_a_file_that_cannot_be_written_is_named_and_not_left_half(
    small_shards, tmp_path, monkeypatch, words
):
    monkeypatch.chdir(tmp_path)
    pytest.importorskip("matplotlib.backends.backend_agg")  # its font cache is a file, too
    with files_of_at_most(100):
        shown = invoke(words[0], small_shards, *words[1:])

    last = shown.stderr.splitlines()[-1]
    assert shown.exit_code == 2
    assert last.startswith(f"StorageError: {words[-1]}"), last
    assert "(File too large). Choose a place that takes files of this size." in last
    left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert [name for name in left if not name.endswith(".journal")] == []


def test_a_report_may_go_through_a_link_or_a_pipe(tmp_path):
    link, target, pipe = tmp_path / "link.md", tmp_path / "target.md", tmp_path / "pipe"
    target.write_text("before")
    link.symlink_to(target)
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)

    write_report(link, "PSNR\u2191")
    write_report(pipe, "through")

    assert link.is_symlink()
    assert target.read_text(encoding="utf-8") == "PSNR\u2191"
    assert os.read(reading, 100) == b"through"
    os.close(reading)


def test_an_index_does_not_replace_a_device_or_a_pipe(small_release, tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    shown = invoke("index", small_release, "-o", pipe)

    assert shown.exit_code == 2
    assert "is not a regular file" in one_line(shown.stderr)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.fixture
def printed_progress(monkeypatch, capsys):
    """Return the lines about three megabytes where stderr is not a terminal."""

    def lines(*, width, every_s, done_mb=(1, 2, 3)):
        monkeypatch.setenv("COLUMNS", str(width))
        with progress_bar("packing", unit="MB", log_every_s=every_s) as report:
            for done in done_mb:
                report(done * 1_000_000, 3_000_000)
        return capsys.readouterr().err.splitlines()

    return lines


def test_a_log_gets_progress_line_by_line_as_time_passes(printed_progress):
    often = printed_progress(width=80, every_s=0)
    seldom = printed_progress(width=80, every_s=60)

    assert [line.split("MB")[0].split()[-1] for line in often] == ["1/3", "2/3", "3/3", "3/3"]
    assert len(seldom) == 1


@pytest.mark.parametrize(
    "words",
    [
        "index nowhere -o out/index.parquet",
        "pack nowhere out",
        "verify nowhere",
        "publish croissant nowhere -o out/croissant.json",
        "publish upload nowhere a/b",
        "download nowhere -o out",
        "show nowhere -o out/sheet.png",
        "audit nowhere -o out/audit.md",
        "eval score nowhere nothing --tier G1 -o out",
        "export clips nowhere out --layout musubi",
    ],
)
def test_a_mistyped_path_is_reported_and_makes_no_folder(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = invoke(*words.split())

    assert shown.exit_code == 2
    assert "nowhere: does not exist" in str(shown.exception or "") + shown.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        "index nowhere",
        "unpack nowhere out",
        "audit nowhere",
        "eval score SHARDS nowhere --tier G1",
        "eval inputs SHARDS out --tier G1 --where scene=nowhere",
        "audit SHARDS --where family=Pairwise_Uniform --where map=Nowhere",
    ],
)
def test_a_command_that_fails_at_once_prints_its_error_and_nothing_else(
    words, small_shards, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    ended = invoke(*words.replace("SHARDS", str(small_shards)).split())

    assert ended.exit_code == 2
    assert len(ended.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
