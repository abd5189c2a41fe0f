"""Help, examples and completion: what a newcomer meets first."""

import os
import re
import shlex
import subprocess
import sys
from typing import get_args

import pytest
import typer

from stereogenbench_data.cli.commands import app
from stereogenbench_data.cli.synth import RotationForm
from stereogenbench_data.schema.release import FAMILIES
from tests.cli.command import invoke, one_line, run

COMMANDS = typer.main.get_command(app).commands


def shown(*arguments):
    return one_line(invoke(*arguments, env={"COLUMNS": "200", "TERMINAL_WIDTH": "200"}).output)


def test_help_groups_the_commands_in_the_order_of_use():
    text = shown("--help")
    panels = ("Have scenes", "Look at them", "Pack them", "Check them", "Take them elsewhere")
    places = [text.index(f"{panel}:") for panel in panels]

    assert places == sorted(places)
    assert text.index("synth scenes/") < text.index("show scenes/") < text.index("browse scenes/")


def test_help_says_what_each_exit_status_means():
    text = shown("--help")

    for status in ("0 done", "1 something is wrong with the data", "2 it could", "130 stopped"):
        assert status in text


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_every_command_has_an_example_that_parses(name):
    example = COMMANDS[name].epilog
    assert example in (None, "") or example.startswith("Example: `stereogenbench ")
    words = shlex.split(example.partition("`stereogenbench ")[2].rstrip("`"))

    assert words[0] == name
    COMMANDS[name].make_context(name, words[1:], resilient_parsing=False)


PATHS = [
    *((name,) for name in COMMANDS),
    *((name, inner) for name, each in COMMANDS.items() for inner in getattr(each, "commands", ())),
]


@pytest.mark.parametrize("path", PATHS, ids=" ".join)
def test_help_at_80_columns_cuts_no_option_and_fits_the_screen(path):
    page = invoke(*path, "--help", env={"COLUMNS": "80"}).stdout
    command = COMMANDS[path[0]] if len(path) == 1 else COMMANDS[path[0]].commands[path[1]]
    lines = page.rstrip().splitlines()

    assert max(map(len, lines)) <= 80
    assert len(lines) <= 62
    assert "…" not in page
    assert "<" not in page
    for parameter in command.params:
        if parameter.param_type_name == "option":
            assert re.search(rf"^  (-.*, )?{parameter.opts[0]}\b", page, re.MULTILINE), (
                parameter.opts
            )


def test_help_shows_a_flag_without_a_value_and_a_range_as_it_is_typed():
    page = invoke("eval", "score", "--help", env={"COLUMNS": "80"}).stdout

    assert "\n  --json         " in page
    assert "--plots/--no-plots  " in page
    assert "--focal-mm MIN MAX  " in page
    assert "--baseline-cm MIN MAX  " in page


def test_the_usage_line_has_what_must_be_given():
    page = invoke("eval", "inputs", "--help", env={"COLUMNS": "80"}).stdout

    assert page.startswith("Usage: stereogenbench eval inputs DATA OUT --tier G0|G1|G2 [OPTIONS]")


def test_help_lists_rarely_used_options_last():
    page = invoke("audit", "--help", env={"COLUMNS": "80"}).stdout
    panels = ("Options:", "Which scenes:", "Rarely needed:", "--engine")
    places = [page.index(f"\n{'  ' * each.startswith('--')}{each}") for each in panels]

    assert places == sorted(places)


def test_help_shows_defaults_and_choices():
    page = one_line(invoke("synth", "--help", env={"COLUMNS": "80"}).stdout)

    assert "--split train|eval" in page
    assert "One of rotator, quaternion_xyzw, quaternion_wxyz, matrix. [rotator]" in page


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_every_command_says_what_it_is(name):
    for parameter in COMMANDS[name].params:
        assert getattr(parameter, "help", ""), f"{name} {parameter.name}"


def test_the_forms_of_rotations_are_those_that_can_be_written():
    from stereogenbench_data.synthesis import request

    assert get_args(RotationForm) == get_args(request.RotationForm)


def completed(line):
    words = shlex.split(line)
    last = "" if line.endswith(" ") else words.pop()
    variables = {
        "_STEREOGENBENCH_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join([*words, last]),
        "COMP_CWORD": str(len(words)),
    }
    return run(env=os.environ | variables).stdout.split()


def test_completion_knows_commands():
    assert completed("stereogenbench s") == ["synth", "show", "stats"]


def test_completion_knows_the_values_of_family():
    assert completed("stereogenbench synth --family ") == sorted(FAMILIES)


def test_completion_knows_the_scenes_of_data_with_an_index(small_shards):
    assert completed(f"stereogenbench show {small_shards} train/U") == [
        "train/Uniform/SynthStage/scene_000000",
        "train/Uniform/SynthStage/scene_000001",
    ]


def test_completion_knows_the_scenes_that_an_option_may_name(small_shards):
    assert completed(f"stereogenbench audit {small_shards} --scene train/I") == [
        "train/IPD_Gaussian/SynthStage/scene_000000"
    ]
    assert completed(f"stereogenbench stats {small_shards} --scene ")[-1] == (
        "train/Uniform/SynthStage/scene_000001"
    )


def test_completion_knows_limits_and_what_depth_may_have_lost():
    assert completed("stereogenbench audit x --limit base") == ["baseline_cm="]
    assert set(completed("stereogenbench audit x --accept ")) == {
        "8-bit", "9-bit", "10-bit", "12-bit", "14-bit", "chroma", "lossy",
    }  # fmt: skip


def test_a_completion_script_can_be_had():
    environment = os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    ended = run("--show-completion", "bash", env=environment)

    assert "_STEREOGENBENCH_COMPLETE=complete_bash" in ended.stdout


def test_help_imports_neither_torch_nor_numpy():
    code = (
        "import sys; from stereogenbench_data.cli.commands import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'numpy', 'pyarrow', 'av', 'PIL', 'ray'} & sys.modules.keys()\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)

    assert ended.returncode == 0, ended.stderr.decode()
