"""The command as a whole, run as a user runs it."""

import pytest

from tests.cli.command import invoke, run


def test_help_tells_a_newcomer_what_to_do_first():
    shown = run("--help")

    assert shown.returncode == 0
    assert (
        "New here? Draw two small scenes, look at one, browse them all: stereogenbench synth"
        in (" ".join(shown.stdout.split()))
    )


def test_no_arguments_show_the_help():
    shown = run()

    assert "Usage" in shown.stdout + shown.stderr


def test_the_version_is_the_packages():
    from stereogenbench_data import __version__

    assert run("--version").stdout.strip() == f"stereogenbench-data {__version__}"


def test_an_error_is_reported_without_a_traceback_and_ends_with_exit_status_2(tmp_path):
    shown = run("index", tmp_path / "nowhere")

    assert shown.returncode == 2
    assert "nowhere" in shown.stderr
    assert "Traceback" not in shown.stderr
    assert len(shown.stderr.strip().splitlines()) <= 2


@pytest.mark.parametrize("arguments", [["idnex"], ["index"], ["synth", "out", "--scenes", "some"]])
def test_a_wrong_call_is_a_usage_error(arguments, tmp_path):
    shown = run(*arguments, cwd=tmp_path)

    assert shown.returncode == 2
    assert "Usage" in shown.stderr
    assert list(tmp_path.iterdir()) == []


def test_scenes_are_drawn_indexed_and_opened(tmp_path):
    drawn = run("synth", "scenes", "--family", "Uniform", "--size", 32, "--frames", 3,
                "--seed", 1, "--workers", 1, cwd=tmp_path)  # fmt: skip
    indexed = invoke("index", tmp_path / "scenes", "--workers", 1)

    from stereogenbench_data import StereoPairs

    assert (drawn.returncode, indexed.exit_code) == (0, 0)
    assert (tmp_path / "scenes" / "index.parquet").is_file()
    assert len(StereoPairs(tmp_path / "scenes", pairs="all", frames="all")) == 15 * 3
