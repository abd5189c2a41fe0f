"""Date the changelog of a release, and check what a tag would publish.

python .ci/release.py date           # "Unreleased" becomes the version, with today's date
python .ci/release.py check v0.1.0   # exit 1, with what is wrong, unless v0.1.0 may be published
"""

import re
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

HOME = Path(__file__).resolve().parents[1]
OPEN = "## [Unreleased]"
LINK = re.compile(r"^\[(Unreleased|\d+\.\d+\.\d+)\]: (.+)$", re.MULTILINE)


def dated(changelog: str, *, version: str, day: str) -> str:
    """Return a changelog whose open entries are those of a version, with links to compare pages.

    Links are relative to the changelog's page in the repository, so that they hold wherever it is.

    Raises:
        ValueError: If the changelog has no open entries, or the version already.
    """
    if f"## [{version}]" in changelog:
        raise ValueError(
            f"CHANGELOG.md: has {version} already. Raise the version in pyproject.toml."
        )
    head, found, entries = changelog.partition(f"{OPEN}\n")
    if not found or entries.lstrip().startswith("## ["):
        raise ValueError(f"CHANGELOG.md: has no entries under {OPEN!r}.")
    links = {name: link for name, link in LINK.findall(entries) if name != "Unreleased"}
    before = max(links, key=lambda each: tuple(map(int, each.split("."))), default=None)
    page = f"../../compare/v{before}...v{version}" if before else f"../../releases/tag/v{version}"
    links = {"Unreleased": f"../../compare/v{version}...HEAD", version: page} | links
    body = LINK.sub("", entries).strip("\n")
    listed = "\n".join(f"[{name}]: {link}" for name, link in links.items())
    return f"{head}{OPEN}\n\n## [{version}] - {day}\n\n{body}\n\n{listed}\n"


def problems(tag: str, *, project: dict, changelog: str) -> list[str]:
    """Return why a tag may not be published, one line each: place, what was found, cure."""
    version = project["version"]
    found = []
    if tag != f"v{version}":
        found.append(
            f"pyproject.toml: has the version {version}, and the tag is {tag}: make them equal"
        )
    if not re.search(
        rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d$", changelog, re.MULTILINE
    ):
        found.append(
            f"CHANGELOG.md: has no dated entry for {version}: run `python .ci/release.py date`"
        )
    if version not in dict(LINK.findall(changelog)):
        found.append(f"CHANGELOG.md: has no link for [{version}]: run `python .ci/release.py date`")
    entry = changelog.partition(f"## [{version}]")[2].partition("\n## [")[0]
    sections = re.findall(r"^### (.+)$", entry, re.MULTILINE)
    for name in sorted({each for each in sections if sections.count(each) > 1}):
        found.append(f"CHANGELOG.md: {version} has several sections {name!r}: make them one")
    for name in ("Repository", "Changelog", "Issues"):
        if name not in project["urls"]:
            found.append(
                f"pyproject.toml: has no {name} in [project.urls]: add the repository's address"
            )
    return found


def main(arguments: list[str]) -> int:
    """Run a command and return its exit status."""
    project = tomllib.loads((HOME / "pyproject.toml").read_text())["project"]
    path = HOME / "CHANGELOG.md"
    match arguments:
        case ["date"]:
            today = datetime.now(UTC).date().isoformat()
            try:
                text = dated(path.read_text(), version=project["version"], day=today)
            except ValueError as error:
                sys.stderr.write(f"{error}\n")
                return 1
            path.write_text(text)
            return 0
        case ["check", tag]:
            found = problems(tag, project=project, changelog=path.read_text())
            sys.stderr.writelines(f"{line}\n" for line in found)
            return 1 if found else 0
        case _:
            sys.stderr.write(f"{__doc__}")
            return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
