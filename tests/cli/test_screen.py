"""On a terminal a report is one screen that says where the rest is; through a pipe it is whole."""

import fcntl
import os
import pty
import re
import shutil
import struct
import sys
import termios
from contextlib import suppress

import pytest

from stereogenbench_data.cli.screen import COLUMNS, LINES
from tests.cli.command import invoke

ESCAPES = re.compile(rb"\x1b\[[0-9;?]*[A-Za-z]")


def on_a_terminal(*words, columns=100, rows=40):
    """Return the lines, of one screen, that a command leaves on a terminal's standard output."""
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
    with suppress(OSError):  # as Linux tells that nothing more will come
        while read := os.read(terminal, 65536):
            shown += read
    os.waitpid(child, 0)
    lines = ESCAPES.sub(b"", shown).decode().replace("\r\n", "\n").strip("\n").split("\n")
    assert len(lines) <= LINES
    assert max(map(len, lines[:-1])) <= COLUMNS  # the last one may name a file
    return lines


@pytest.fixture(scope="module")
def release(small_release):
    return str(small_release)


@pytest.mark.parametrize(
    ("words", "first", "last"),
    [
        (("stats", "{release}"), "4 scenes of ", "-o FILE writes the whole report."),
        (
            ("audit", "{release}", "--per-scene", "2", "--workers", "1"),
            r"(Nothing wrong found|WRONG).*4 of 4 scenes audited\.",
            "-o FILE writes the whole report.",
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
    whole = invoke(*given).stdout
    assert len(whole) > 1.5 * len("\n".join(lines))  # 1.8 at 100 columns, 2 at 80


def test_the_doctor_says_first_what_is_wrong(small_release):
    lines = on_a_terminal(
        "doctor", small_release, "--scenes", "2", "--per-scene", "1", "--workers", "1"
    )

    assert lines[0].startswith(("FITS", "CANNOT TELL"))
    assert lines[-1] == "-o FILE writes the whole report."


def test_damaged_shards_are_told_by_kinds_of_damage(shards, tmp_path):
    file = tmp_path / "problems.txt"
    for tar in shards.glob("*.tar"):
        content = bytearray(tar.read_bytes())
        content[2000::5000] = bytes(255 - each for each in content[2000::5000])
        tar.write_bytes(content)
    lines = on_a_terminal("verify", shards, "--workers", "1", "-o", file)

    count = int(re.search(r"; (\d+) problems", " ".join(lines))[1])
    (row,) = (line.split() for line in lines if line.startswith(" altered"))
    assert row[1] == str(count)
    assert lines[-1] == f"Whole report: {file}"
    assert len(file.read_text().splitlines()) == 1 + count


def test_an_index_that_leaves_scenes_out_says_how_many_and_why(small_release, tmp_path):
    root = shutil.copytree(small_release, tmp_path / "tree", copy_function=shutil.copyfile)
    for path in root.rglob("baseline.json"):
        path.write_text("[")
    lines = on_a_terminal("index", root, "-o", root / "index.parquet", "--workers", "1")
    piped = invoke("index", root, "-o", root / "index.parquet", "--workers", "1")

    shown = " ".join(" ".join(lines).split())
    assert "nothing to index; 4 broken, left out" in shown
    assert lines[-1] == "--json prints all that was left out."
    broken = {path.parent.relative_to(root).as_posix() for path in root.rglob("baseline.json")}
    assert len(broken) == 4
    assert all(key in piped.stderr for key in broken)


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
