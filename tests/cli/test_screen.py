"""On a terminal a report is one screen that says where the rest is; through a pipe it is whole."""

import fcntl
import os
import pty
import re
import struct
import sys
import termios

import pytest

from stereogenbench_data.cli.screen import COLUMNS, LINES
from tests.cli.command import invoke

ESCAPES = re.compile(rb"\x1b\[[0-9;?]*[A-Za-z]")


def on_a_terminal(*words, columns=100, rows=40):
    """Return the lines that the command leaves on a terminal's standard output."""
    child, terminal = pty.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the progress bar
        os.execv(
            sys.executable,
            [sys.executable, "-c", "import sys; sys.stdin.readline(); from "
             "stereogenbench_data.cli.main import main; main()", *map(str, words)],
        )  # fmt: skip
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    os.write(terminal, b"\n")
    shown = b""
    while True:
        try:
            read = os.read(terminal, 65536)
        except OSError:
            break
        if not read:
            break
        shown += read
    os.waitpid(child, 0)
    return ESCAPES.sub(b"", shown).decode().replace("\r\n", "\n").strip("\n").split("\n")


@pytest.fixture(scope="module")
def release(small_release):
    return str(small_release)


@pytest.mark.parametrize(
    ("words", "first", "last"),
    [
        (("stats", "{release}"), "4 scenes of ", "-o FILE.md writes the whole report."),
        (
            ("audit", "{release}", "--per-scene", "2", "--workers", "1"),
            r"(Nothing wrong found|WRONG).*4 of 4 scenes audited\.",
            "-o FILE.md writes the whole report.",
        ),
        (
            ("eval", "controls", "{release}", "--split", "all", "--frames", "0", "--metrics",
             "psnr,ssim", "--size", "64x64", "--workers", "1", "-o", "{out}"),
            r"The rendered target scores best in 2 of 2 columns\.",
            "Whole report: {out}/report.md",
        ),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)  # fmt: skip
def test_a_report_is_one_screen(release, tmp_path, words, first, last):
    places = {"release": release, "out": str(tmp_path / "out")}
    given = [word.format(**places) for word in words]
    lines = on_a_terminal(*given)

    assert re.search(first, " ".join(lines[:3]))
    assert lines[-1] == last.format(**places)
    assert len(lines) <= LINES
    assert max(map(len, lines[:-1])) <= COLUMNS
    whole = invoke(*given).stdout
    assert len(whole) > 2 * len("\n".join(lines))


def test_what_does_not_fit_is_counted(capsys, monkeypatch):
    from stereogenbench_data.cli import screen

    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    rows = [("map", "scenes"), *((f"Town{number}", str(number)) for number in range(60))]
    screen.print_report("All is well.", [("Maps", rows)], whole="", rest="The rest is elsewhere.")
    lines = capsys.readouterr().out.splitlines()

    assert lines[0] == "All is well."
    assert lines[-1] == "The rest is elsewhere."
    assert len(lines) <= LINES
    shown = sum(line.startswith(" Town") for line in lines)
    assert f"... and {60 - shown} more" in lines
