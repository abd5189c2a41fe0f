"""README and documentation: their Python runs."""

import gc
import re
import shlex
import warnings
from pathlib import Path

import pytest

from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.cli.command import CALLS, succeed

README = Path(__file__).resolve().parents[1] / "README.md"
PAGES = sorted((README.parent / "docs").glob("*.md"))
WITH_COMMANDS = [
    README, README.parent / "CONTRIBUTING.md", README.parent / "shards" / "README.md",
    *sorted((README.parent / "docs").rglob("*.md")),
]  # fmt: skip


def blocks_of(path):
    return re.findall(r"```python\n(.*?)```", path.read_text(), flags=re.DOTALL)


DOCUMENTED = [(path, block) for path in PAGES for block in blocks_of(path)]


@pytest.fixture(scope="module")
def folder_with_scenes(tmp_path_factory):
    """A folder with ``scenes/``, as a reader of the README makes it."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "shards").symlink_to(README.parent / "shards")
    for split, scenes in (("train", 2), ("eval", 1)):
        request = SynthRequest(
            family="Uniform", split=split, scenes=scenes, size_px=96, frames=5, seed=11
        )
        synthesise(folder / "scenes", request)
    return folder


def test_the_readme_runs_in_its_own_order_in_one_folder(here, monkeypatch):
    """As a person would copy it: commands and Python alike, and nothing warns."""
    monkeypatch.setenv("COLUMNS", "100")
    ran = 0
    for language, block in re.findall(r"```(\w*)\n(.*?)```", README.read_text(), flags=re.DOTALL):
        if language == "python":
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                exec(compile(block, README.name, "exec"), {"__name__": "__main__"})
            ran += 1
        for line in block.splitlines() if not language else ():
            words = shlex.split(line, comments=True)
            if words[:1] == ["stereogenbench"] and words[1] != "browse":  # that serves until Ctrl-C
                quick = ["--workers", "1"] if words[1] in ("synth", "pack") else []
                succeed(*words[1:], *quick)
                ran += 1

    assert ran == 7


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)
@pytest.mark.parametrize(
    ("path", "block"),
    DOCUMENTED,
    ids=[f"{path.stem} {n + 1}" for n, (path, _) in enumerate(DOCUMENTED)],
)
def test_a_block_of_the_documentation_runs_by_itself(folder_with_scenes, monkeypatch, path, block):
    monkeypatch.chdir(folder_with_scenes)

    exec(compile(block, path.name, "exec"), {"__name__": "__main__"})
    # Webdataset leaves its files to the garbage collector, which warns of them.
    gc.collect()


def commands_of(path):
    """The commands of a page in its blocks and in its text, those with arguments."""
    text = path.read_text().replace("\\\n", " ")
    blocks = "\n".join(re.findall(r"```\w*\n(.*?)```", text, flags=re.DOTALL))
    lines = [line.strip() for line in blocks.splitlines()] + re.findall(
        r"`(stereogenbench [^`]+)`", text
    )
    words = [
        shlex.split(line, comments=True) for line in lines if line.startswith("stereogenbench ")
    ]
    return [each[1:] for each in words if len(each) > 2 and "--help" not in each]


@pytest.mark.parametrize("path", WITH_COMMANDS, ids=[path.stem for path in WITH_COMMANDS])
def test_every_command_of_a_page_has_arguments_and_options_that_exist(path):
    for words in commands_of(path):
        (path,) = (each for each in CALLS if each == tuple(words[: len(each)]))
        if given := words[len(path) :]:
            CALLS[path].make_context(path[-1], given)


def test_there_are_blocks_to_run():
    assert len(DOCUMENTED) >= 10
    assert sum(len(commands_of(path)) for path in WITH_COMMANDS) > 60
