"""Signals while the command imports what it needs."""

import subprocess
import sys

import pytest

from stereogenbench_data import __version__

pytestmark = pytest.mark.usefixtures("usual_signals")

STARTING = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == "typer":
            os.kill(os.getpid(), signal.SIGNAL)

SETTING
sys.meta_path.insert(0, Interrupting())
sys.argv = ["stereogenbench", "--version"]
from stereogenbench_data.cli.main import main
main()
"""


def started(name, *, setting=""):
    """Return how the command ends that is sent a signal when it imports typer."""
    code = STARTING.replace("SIGNAL", name).replace("SETTING", setting)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_during_imports_ends_the_command_in_one_word(name):
    ended = started(name)

    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "stopped\n")


def test_ctrl_c_that_is_ignored_stays_ignored():
    ended = started("SIGINT", setting="signal.signal(signal.SIGINT, signal.SIG_IGN)")

    said = f"stereogenbench-data {__version__}\n"
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, said, "")
