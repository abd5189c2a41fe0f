"""Facts for developers: the tested versions, and the paths that pages name."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version

HOME = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((HOME / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
TOOLS = {"bench", "dev", "docs"}
"""Extras for developers: only the newest releases of their packages are tested."""


def lower_bounds():
    """Return the stated lowest version of each package that users install."""
    lines = PROJECT["dependencies"] + [
        line for extra, lines in EXTRAS.items() if extra not in TOOLS for line in lines
    ]
    bounds = {}
    for requirement in map(Requirement, lines):
        (lowest,) = (each for each in requirement.specifier if each.operator in (">=", "=="))
        assert bounds.setdefault(requirement.name, lowest.version) == lowest.version
    return bounds


def pins(name):
    lines = (HOME / "constraints" / f"{name}.txt").read_text().splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


def test_the_lowest_versions_that_are_tested_are_those_that_are_stated():
    tested = {pin.name: str(pin.specifier).removeprefix("==") for pin in pins("lowest")}

    for name, lowest in lower_bounds().items():
        # If no release has this number, the next one is pinned.
        assert Version(tested[name]) in SpecifierSet(f">={lowest},=={lowest}.*"), name


def test_the_newest_versions_that_are_tested_are_admitted():
    stated = {each.name: each.specifier for each in map(Requirement, PROJECT["dependencies"])}

    for pin in pins("newest"):
        (lowest,) = pin.specifier
        assert stated[pin.name].contains(lowest.version), pin


def test_every_python_that_is_named_is_tested_and_admitted():
    named = {
        line.rpartition(" ")[2]
        for line in PROJECT["classifiers"]
        if line.startswith("Programming Language :: Python :: ")
    }
    workflow = (HOME / ".github" / "workflows" / "test.yml").read_text()

    assert set(re.findall(r'python: "([\d.]+)"', workflow)) == named
    assert all(version in SpecifierSet(PROJECT["requires-python"]) for version in named)


def test_blender_is_asked_for_by_the_one_python_that_it_has_wheels_for():
    (bpy,) = map(Requirement, EXTRAS["blender"])
    minors = [f"3.{minor}" for minor in range(11, 16)]

    asking = [each for each in minors if bpy.marker.evaluate({"python_version": each})]

    assert asking == ["3.13"]


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_every_path_and_name_on_a_page_for_developers_exists(page):
    whole = (HOME / page).read_text()
    text = re.sub(r"```.*?```", "", whole, flags=re.DOTALL)
    words = {*re.findall(r"`([^`\n]+)`", text), *re.findall(r"(?:[\w.]+/)+\w+\.py", whole)} - {
        "shared/"
    }
    is_path = re.compile(r"[\w.-]+(/[\w.-]+)*(/|\.(py|md|txt|toml))").fullmatch
    is_name = re.compile(r"_?[A-Z][A-Za-z]+[a-z]|_?[A-Z_]{6,}").fullmatch
    folders = (HOME / "stereogenbench_data", HOME / "tests")
    code = "\n".join(path.read_text() for folder in folders for path in folder.rglob("*.py"))

    paths = [word for word in words if is_path(word)]
    roots = (HOME, HOME / "stereogenbench_data")
    assert [path for path in paths if not any((root / path).exists() for root in roots)] == []
    assert [word for word in words if is_name(word) and not re.search(rf"\b{word}\b", code)] == []
