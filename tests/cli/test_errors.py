"""How commands end: with an exit status, and one or two lines on stderr about any error."""

import errno
import os
import shlex
import signal
import subprocess
import time
import warnings
from pathlib import Path

import pytest

from stereogenbench_data.cli.errors import ErrorsReported
from stereogenbench_data.errors import SelectionError
from tests.cli.command import COMMAND, invoke, run


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (SelectionError("no pair; take another"), "SelectionError: no pair; take another\n"),
        (
            PermissionError(errno.EACCES, "Permission denied", "out/sheet.png"),
            "PermissionError: out/sheet.png (Permission denied). Give permission, or choose "
            "another place.\n",
        ),
        (
            MemoryError(),
            "MemoryError: memory is short. Use fewer workers or smaller pictures.\n",
        ),
        (KeyError("a bug"), "in test_an_error_ends_the_command_and_is_told"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_an_error_ends_the_command_and_is_told(error, said, capfd):
    """One that nobody expected shows where it arose."""
    with pytest.raises(SystemExit) as ended, ErrorsReported():
        raise error

    printed = capfd.readouterr()
    assert (ended.value.code, printed.out) == (2, "")
    assert printed.err == said or (isinstance(error, KeyError) and said in printed.err)


def test_a_warning_is_one_line_and_afterwards_looks_as_before(capsys):
    before = warnings.formatwarning
    with ErrorsReported(), warnings.catch_warnings():
        warnings.simplefilter("always")
        line = warnings.formatwarning("two scenes are odd", UserWarning, "file.py", 3)

    assert line == "UserWarning: two scenes are odd\n"
    assert warnings.formatwarning is before


def test_a_full_disk_is_reported():
    with Path("/dev/full").open("w") as full:
        printed = run("--version", stdout=full)

    (line,) = printed.stderr.splitlines()
    told = "StorageError: the output cannot be written (No space left on device). Make room"
    assert (printed.returncode, line.startswith(told)) == (2, True)


@pytest.mark.parametrize("words", ["publish croissant --template -o about.json", "--version"])
def test_output_that_nobody_reads_ends_quietly(tmp_path, words):
    """As `| head` does it: the pipe is closed before anything is written."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        ended = run(*words.split(), stdout=closed, cwd=tmp_path)

    assert (ended.returncode, ended.stderr) == (141, "")


@pytest.mark.usefixtures("usual_signals")
def test_a_signal_ends_the_browser_at_once_with_130(small_shards):
    with subprocess.Popen(
        [*COMMAND, "browse", str(small_shards), "--no-open"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as browsing:  # fmt: skip
        assert browsing.stdout is not None
        line = browsing.stdout.readline()
        time.sleep(0.2)
        browsing.send_signal(signal.SIGTERM)
        try:
            _, message = browsing.communicate(timeout=60)
        finally:
            browsing.kill()

    assert line.startswith("http://127.0.0.1:")
    assert "4 scenes" in line
    assert browsing.returncode == 130
    assert message.strip().splitlines()[-1].startswith("stopped")
    assert "Traceback" not in message


def test_control_characters_of_a_name_are_escaped(tmp_path):
    odd = tmp_path / "a\x1b]0;title\x07\x1b[31m"
    shown = invoke("stats", odd)
    odd_scene = tmp_path / "tree" / "train" / "F" / "M" / "s\x1b[2J"
    odd_scene.mkdir(parents=True)
    indexed = invoke("index", tmp_path / "tree")

    assert shown.exit_code == 2
    assert "\x1b" not in shown.stderr + indexed.stderr + indexed.stdout
    assert r"a\x1b]0;title\x07\x1b[31m" in shown.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        *((words, "Usage") for words in ("", "idnex", "index", "synth out --scenes some")),
        *((words, "the path is empty") for words in ("synth ''", "pack scenes ''", "index ''")),
    ],
)
def test_a_wrong_call_is_refused_and_nothing_is_written(words, told, here):
    ended = invoke(*shlex.split(words))

    assert (ended.exit_code, told in ended.output) == (2, True)
    assert list(here.iterdir()) == []
