"""The documentation builds as a site; no page, link or docstring gives a warning."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import stereogenbench_data
from tests.cli.command import CALLS
from tests.servers.tools import chromium, require_module, run_python

HOME = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def pages():
    """The script that makes pages before the build."""
    spec = importlib.util.spec_from_file_location("pages", HOME / "docs" / "generated_pages.py")
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.fixture(scope="module")
def built(once):
    """The folder of the site as `make docs` makes it, and beside it what the build said."""
    for module in ("mkdocs", "material", "mkdocstrings"):
        require_module(module)

    def make(root):
        root.mkdir()
        run_python("docs/generated_pages.py")
        done = subprocess.run(
            [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(root / "site")],
            cwd=HOME, capture_output=True, text=True, check=False, timeout=300,
            env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        )  # fmt: skip
        (root / "build.log").write_text(f"{done.stderr}\nexit status {done.returncode}")

    # One process of a run builds it, as the pages are made in a folder of the checkout.
    return once("documentation", make) / "site"


def text_of(site, page):
    return re.sub(r"<[^>]+>", "", (site / page / "index.html").read_text())


def test_the_strict_build_has_no_warning(built):
    said = built.with_name("build.log").read_text()

    assert [line for line in said.splitlines() if line.startswith(("WARNING", "ERROR"))] == []
    assert said.endswith("\nexit status 0"), said[-3000:]


def test_the_page_of_commands_names_every_command_and_option(built):
    page = text_of(built, "commands")

    assert {("export", "clips"), ("export", "colmap")} <= CALLS.keys()
    for words, call in CALLS.items():
        assert f"stereogenbench {' '.join(words)}" in page
        for option in (option for parameter in call.params for option in parameter.opts):
            assert option in page or not option.startswith("--"), f"{words} {option}"


def test_the_tables_of_fields_in_the_file_are_those_of_the_code(pages):
    """`python docs/generated_pages.py tables` writes them anew."""
    page = (HOME / "docs" / "samples.md").read_text()

    assert pages.with_fields_tables(page) == page
    assert page.count("| `world_from_cam` |") == 1


def test_the_navigation_has_four_groups_and_every_page(built, pages):
    text = (HOME / "mkdocs.yml").read_text()
    navigation = text.partition("\nnav:\n")[2].partition("\nplugins:")[0]
    docs = HOME / "build" / "docs"
    left_out = Path("performance", "tables.md")
    made = {path.relative_to(docs) for path in docs.rglob("*.md")} - {left_out}

    assert re.findall(r"^  - (.+):$", navigation, re.MULTILINE) == [
        "Tutorial", "How to", "Explanation", "Reference",
    ]  # fmt: skip
    assert {Path(each) for each in re.findall(r"[\w/]+\.md", navigation)} == made


def test_the_reference_has_every_public_name_and_what_users_call(built, pages):
    shown = "".join(
        (built / "reference" / page / "index.html").read_text() for page in pages.reference()
    )
    called = ("audit.geometry.audit.audit", "audit.contract.doctor.diagnose",
              "audit.statistics.statistics", "synthesis.produce.synthesise",
              "synthesis.request.SynthRequest", "bridges.picture.show")  # fmt: skip
    places = {
        name: getattr(stereogenbench_data, name).__module__
        for name in stereogenbench_data.__all__
        if hasattr(getattr(stereogenbench_data, name), "__module__")
    }
    wanted = [f"{place}.{name}" for name, place in places.items()]

    assert [path for path in wanted if f'id="{path}"' not in shown] == []
    assert [path for path in called if f'id="stereogenbench_data.{path}"' not in shown] == []
    sizes = [len((built / "reference" / page / "index.html").read_text())
             for page in pages.reference()]  # fmt: skip
    assert max(sizes) < 400_000


def test_the_reference_lists_each_option_that_a_call_unpacks(built):
    page = text_of(built, "reference/datasets")

    assert "fetch_ahead_bytes" in page.partition("Stereo pairs of")[0]
    assert "**options" not in page.partition("Stereo pairs of")[0]


def test_the_tutorial_runs_and_shows_what_its_page_shows(pages, tmp_path, monkeypatch):
    """`python docs/generated_pages.py notebook` keeps what it shows anew."""
    for module in ("nbclient", "ipykernel", "matplotlib", "blosc2"):
        require_module(module)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(each for each in sys.path if each))

    ran = pages.executed(pages.NOTEBOOK, tmp_path)

    shown = json.loads(pages.NOTEBOOK.read_text())["cells"]
    assert [kinds_of(cell) for cell in ran["cells"]] == [kinds_of(cell) for cell in shown]
    said = "".join(each["text"] for cell in ran["cells"] for each in cell.get("outputs", ())
                   if "text" in each)  # fmt: skip
    before, after = map(float, re.findall(r"trained +epe +([\d.]+) px", said))
    assert after < before / 2
    assert said.endswith("nothing wrong found\nTrue\n")


def kinds_of(cell):
    """What a cell of a notebook shows: lines of text, pictures."""
    return [
        len("".join(each["text"]).splitlines()) if "text" in each else sorted(each["data"])
        for each in cell.get("outputs", ())
    ]


CUT_CODE = """
const code = [...document.querySelectorAll(arguments[0] + ' pre > code')];
return code.filter(each => each.scrollWidth > each.clientWidth).map(each => each.textContent);
"""


@pytest.mark.parametrize(
    ("width_px", "blocks"),
    [
        pytest.param(1440, "", id="desktop"),
        pytest.param(390, ".highlight:not(.drawing)", id="phone"),
    ],
)
def test_no_line_of_code_is_cut_at_the_right_edge(built, width_px, blocks):
    screen = {"width": width_px, "height": 900, "deviceScaleFactor": 1, "mobile": width_px < 500}
    pages = sorted(built.rglob("index.html"))
    cut = {}
    with chromium() as browser:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        for page in pages:
            browser.get(page.as_uri())
            cut[page.parent.name] = browser.execute_script(CUT_CODE, blocks)
            width = browser.execute_script("return document.documentElement.scrollWidth")
            assert width <= width_px, page

    assert {name: found for name, found in cut.items() if found} == {}
    assert len(pages) >= 12
