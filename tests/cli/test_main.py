"""The command as a whole, run as a user runs it."""

import pytest

from stereogenbench_data import __version__
from tests.cli.command import invoke, run


def test_help_tells_a_newcomer_what_to_do_first_and_the_version_is_the_packages():
    shown, version = run("--help"), run("--version")

    assert (shown.returncode, version.stdout) == (0, f"stereogenbench-data {__version__}\n")
    assert (
        "New here? Draw two small scenes, look at one, browse them all: stereogenbench synth"
        in (" ".join(shown.stdout.split()))
    )


@pytest.mark.parametrize("arguments", ["", "idnex", "index", "synth out --scenes some"])
def test_a_wrong_call_is_a_usage_error(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = invoke(*arguments.split())

    assert shown.exit_code == 2
    assert "Usage" in shown.output
    assert list(tmp_path.iterdir()) == []
