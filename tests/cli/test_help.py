"""Help and examples: what a newcomer meets first."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from tests.cli.command import CALLS, COMMANDS, invoke, one_line
from tests.servers.tools import run_python

HOME = Path(__file__).resolve().parents[2]


def shown(*arguments):
    return one_line(invoke(*arguments, env={"COLUMNS": "200", "TERMINAL_WIDTH": "200"}).output)


def test_help_groups_the_commands_in_the_order_of_use_and_says_what_each_exit_status_means():
    text = shown("--help")
    panels = ("Have scenes", "Look at them", "Pack them", "Check them", "Take them elsewhere")
    places = [text.index(f"─ {panel} ─") for panel in panels]

    assert places == sorted(places)
    assert text.index("synth scenes/") < text.index("show scenes/") < text.index("browse scenes/")
    for status in ("0 done", "1 something is wrong with the data", "2 it could", "130 stopped"):
        assert status in text


@pytest.mark.parametrize("path", CALLS, ids=" ".join)
def test_the_help_of_every_command_has_an_example_that_parses(path):
    command = CALLS[path]
    words = shlex.split(re.search(r"Example: `stereogenbench (.*)`", command.help)[1])

    assert tuple(words[: len(path)]) == path
    command.make_context(path[-1], words[len(path) :], resilient_parsing=False)


def texts_of(path):
    """Return the texts of a module, joined ones as one, or that of a page."""
    if path.suffix != ".py":
        return [path.read_text()]
    texts = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts.append(node.value)
        elif isinstance(node, ast.JoinedStr):
            parts = (getattr(part, "value", "") for part in node.values)
            texts.append("".join(part if isinstance(part, str) else "..." for part in parts))
    return texts


def test_every_command_that_a_message_or_a_page_names_is_there():
    places = [
        HOME / "README.md",
        *HOME.glob("docs/*.md"),
        *HOME.glob("stereogenbench_data/**/*.py"),
    ]
    named = {}
    for place in places:
        for text in texts_of(place):
            for words in re.findall(r"`stereogenbench ([a-z]+)(?: ([a-z]+)\b(?!/))?", text):
                named.setdefault(words, place)
    known = {path[0] for path in CALLS}
    groups = {path[0] for path in CALLS if len(path) > 1}

    assert len(named) > 15
    assert {words: place for words, place in named.items() if words[0] not in known} == {}
    wrong = {
        words: place for words, place in named.items() if words[0] in groups and words not in CALLS
    }
    assert wrong == {}


def test_every_option_says_what_it_is_and_a_flag_takes_no_value():
    for parameter in (each for call in CALLS.values() for each in call.params):
        assert getattr(parameter, "help", ""), parameter.name
        if getattr(parameter, "is_flag", False):
            assert parameter.metavar == "", parameter.name


def test_sixteen_commands_stand_at_the_top_with_220_options_in_all():
    assert len(COMMANDS) <= 16
    options = [each for call in CALLS.values() for each in call.params if each.opts[0][0] == "-"]
    assert len(options) <= 220


def test_help_imports_neither_torch_nor_numpy():
    code = (
        "import sys; from stereogenbench_data.cli.commands import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'numpy', 'pyarrow', 'av', 'PIL', 'ray'} & sys.modules.keys()\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    run_python("-c", code)
