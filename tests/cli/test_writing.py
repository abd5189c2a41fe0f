"""What commands write: reports whole or not at all, and the place where it failed is named."""

import os
import resource
import signal
import stat
import sys
from contextlib import contextmanager

import pytest

from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import write_report
from tests.cli.command import invoke, refused, succeed


@contextmanager
def files_of_at_most(size):
    """Let no file grow beyond a size, as a full disk lets none."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    sys.dont_write_bytecode, usual = True, sys.dont_write_bytecode  # of modules, cut for good
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
        sys.dont_write_bytecode = usual


@pytest.mark.parametrize(
    "words",
    [
        ("show", "-o", "sheet.png"),
        ("show", "-o", "clip.mp4"),
        ("stats", "-o", "plots"),
        ("audit", "--per-scene", "1", "--workers", "1", "-o", "audit.md"),
    ],
    ids=lambda words: words[-1],
)
def test_a_file_that_cannot_be_written_is_named_and_not_left_half(small_shards, here, words):
    pytest.importorskip("matplotlib.backends.backend_agg")  # its font cache is a file, too
    with files_of_at_most(100):
        shown = invoke(words[0], small_shards, *words[1:])

    last = shown.stderr.splitlines()[-1]
    assert shown.exit_code == 2
    assert last.startswith(f"StorageError: {words[-1]}"), last
    assert "(File too large). Choose a place that takes files of this size." in last
    left = [path.name for path in here.rglob("*") if path.is_file()]
    assert left == []


@pytest.mark.parametrize(
    "words",
    [
        ("show", "-o", "new/deep/sheet.png"),
        ("show", "-o", "new/deep/clip.mp4"),
        ("stats", "-o", "new/deep/stats.md"),
        ("conventions", "--scenes", "1", "--pictures", "0", "-o", "new/deep/conventions.toml"),
    ],
    ids=lambda words: words[-1],
)
def test_the_folder_of_a_file_is_made(small_release, here, words):
    succeed(words[0], small_release, *words[1:])

    assert (here / words[-1]).stat().st_size > 0


def test_conventions_that_cannot_be_written_leave_those_that_were_there(small_release, tmp_path):
    file = tmp_path / "conventions.toml"
    file.write_text("[depth]\nunit_m = 0.001\n")
    words = ("conventions", small_release, "--scenes", "1", "--pictures", "0")
    with files_of_at_most(10):
        told = refused(*words, "-o", file)

    assert "conventions.toml (File too large)" in told
    assert "1 scene of 1 read" in told
    assert file.read_text() == "[depth]\nunit_m = 0.001\n"
    assert [*tmp_path.iterdir()] == [file]
    told = refused(*words, "--check", file, "-o", file)
    assert "--out: --check tests a file and writes none: leave it out." in told


@pytest.mark.parametrize(
    ("form", "printed"),
    [((), "# Statistics of"), (("--json",), '"root": ')],
    ids=["as a text", "as JSON"],
)
def test_a_report_is_printed_where_its_file_cannot_be_written(
    small_shards, tmp_path, form, printed
):
    shown = invoke("stats", small_shards, *form, "-o", tmp_path)

    assert shown.exit_code == 2
    assert str(tmp_path) in shown.stderr
    assert printed in shown.stdout


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

    assert "is not a regular file" in refused("index", small_release, "-o", pipe)
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
        "unpack nowhere out",
        "verify nowhere",
        "publish croissant nowhere -o out/croissant.json",
        "download nowhere -o out",
        "show nowhere -o out/sheet.png",
        "audit nowhere -o out/audit.md",
        "eval score nowhere nothing --tier G1 -o out",
        "eval score SHARDS nowhere --tier G1",
        "eval inputs SHARDS out --tier G1 --where scene=nowhere",
        "audit SHARDS --where family=nowhere",
        "export clips nowhere out --layout musubi",
    ],
)
def test_a_mistyped_place_is_reported_in_one_line_and_makes_no_folder(words, small_shards, here):
    ended = invoke(*words.replace("SHARDS", str(small_shards)).split())

    (line,) = ended.stderr.splitlines()
    assert (ended.exit_code, "nowhere" in line) == (2, True)
    assert " nowhere " not in words or "SHARDS" in words or "nowhere: does not exist" in line
    assert list(here.iterdir()) == []
