"""What a release must have, and how its changelog is dated."""

import importlib.util
import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.servers.tools import require_tool

HOME = Path(__file__).resolve().parents[1]
ENTRIES = """# Changelog

## [Unreleased]

### Added
- A thing.

[Unreleased]: ../../commits/main
"""


@pytest.fixture(scope="module")
def release():
    spec = importlib.util.spec_from_file_location("release", HOME / ".ci" / "release.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_first_release_is_dated_and_linked(release):
    text = release.dated(ENTRIES, version="0.1.0", day="2026-11-22")

    assert "## [Unreleased]\n\n## [0.1.0] - 2026-11-22\n\n### Added\n- A thing.\n" in text
    assert text.endswith(
        "[Unreleased]: ../../compare/v0.1.0...HEAD\n[0.1.0]: ../../releases/tag/v0.1.0\n"
    )


def test_the_changelog_can_be_dated_and_its_links_are_those_of_its_headings(release):
    text = (HOME / "CHANGELOG.md").read_text()
    headings = set(re.findall(r"^## \[(.+?)\]", text, re.MULTILINE))

    assert set(dict(release.LINK.findall(text))) == headings
    for entry in text.split("\n## [")[1:]:
        sections = re.findall(r"^### (.+)$", entry, re.MULTILINE)
        assert len(sections) == len(set(sections)), sections
    assert "## [9.9.9] - 2026-11-22" in release.dated(text, version="9.9.9", day="2026-11-22")


def test_what_a_tag_lacks_is_named(release):
    project = {"version": "0.1.0", "urls": {"Paper": "https://example.org"}}

    lines = release.problems("v0.2.0", project=project, changelog=ENTRIES)

    assert [line.partition(":")[0] for line in lines] == [
        "pyproject.toml", "CHANGELOG.md", "CHANGELOG.md", *["pyproject.toml"] * 3,
    ]  # fmt: skip
    assert "has the version 0.1.0, and the tag is v0.2.0" in lines[0]
    assert "no Repository in [project.urls]" in lines[3]


def test_a_dated_release_with_addresses_may_be_published(release):
    urls = dict.fromkeys(("Repository", "Changelog", "Issues"), "https://example.org")
    text = release.dated(ENTRIES, version="0.1.0", day="2026-11-22")

    found = release.problems("v0.1.0", project={"version": "0.1.0", "urls": urls}, changelog=text)

    assert found == []


@pytest.mark.parametrize("target", ["test", "demo"])
def test_make_in_an_sdist_says_that_the_sample_is_missing(tmp_path, target):
    (tmp_path / "Makefile").write_text((HOME / "Makefile").read_text())

    done = subprocess.run(
        [require_tool("make"), target], cwd=tmp_path, capture_output=True, text=True, check=False,
        env=os.environ | {"MAKEFLAGS": ""},
    )  # fmt: skip

    assert done.returncode != 0
    assert "the sdist leaves out the sample scenes (11 MB)" in done.stderr
    assert "clone of the repository" in done.stderr
