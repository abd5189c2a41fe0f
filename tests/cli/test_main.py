"""The command as a whole, run as a user runs it."""

import pytest

from stereogenbench_data import StereoPairs, __version__
from tests.cli.command import invoke, run


def test_help_tells_a_newcomer_what_to_do_first_and_the_version_is_the_packages():
    shown, version = run("--help"), run("--version")

    assert (shown.returncode, version.stdout) == (0, f"stereogenbench-data {__version__}\n")
    assert (
        "New here? Draw two small scenes, look at one, browse them all: stereogenbench synth"
        in (" ".join(shown.stdout.split()))
    )


def test_an_error_is_reported_without_a_traceback_and_ends_with_exit_status_2(tmp_path):
    shown = run("index", tmp_path / "nowhere")

    assert shown.returncode == 2
    assert "nowhere" in shown.stderr
    assert "Traceback" not in shown.stderr
    assert len(shown.stderr.strip().splitlines()) <= 2


@pytest.mark.parametrize("arguments", ["", "idnex", "index", "synth out --scenes some"])
def test_a_wrong_call_is_a_usage_error(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = invoke(*arguments.split())

    assert shown.exit_code == 2
    assert "Usage" in shown.output
    assert list(tmp_path.iterdir()) == []


def test_scenes_are_drawn_indexed_and_opened(tmp_path):
    scenes, small = tmp_path / "scenes", ("--size", 32, "--frames", 3, "--workers", 1)
    drawn = invoke("synth", scenes, "--family", "Uniform", *small)
    indexed = invoke("index", scenes, "--workers", 1)

    assert (drawn.exit_code, indexed.exit_code) == (0, 0)
    assert (tmp_path / "scenes" / "index.parquet").is_file()
    assert len(StereoPairs(tmp_path / "scenes", pairs="all", frames="all")) == 15 * 3
