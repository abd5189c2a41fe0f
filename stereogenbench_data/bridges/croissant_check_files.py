"""What a descriptor says of files, against the files that are at hand."""

import fnmatch
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from stereogenbench_data.bridges.croissant_terms import PARQUET, TAR, TEXT, Node
from stereogenbench_data.errors import StorageError
from stereogenbench_data.shards.tar import read_members

_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_MOVING: Final = re.compile(r"/(?:resolve|raw|blob|tree)/(?:main|master|HEAD)(?:/|$)")
_DATA_SUFFIXES: Final = (".tar", ".parquet", ".txt")
_NO_PATH: Final = re.compile(r"^[/~]|\\|:|[\x00-\x1f]")
_CHUNK_BYTES: Final = 1 << 20


@dataclass(slots=True)
class Descriptor:
    """A descriptor under check, and what was found wrong with it."""

    node: Node
    folder: Path
    mapping: Mapping[str, Path]
    problems: list[str] = field(default_factory=list)
    _members: dict[str, list[str] | None] = field(default_factory=dict)

    def say(self, where: str, what: str) -> None:
        """Note what is wrong, and where."""
        self.problems.append(f"{where}: {what}")

    @property
    def files(self) -> dict[str, Node]:
        """Its files and sets of files, by id."""
        return {str(each.get("@id")): each for each in self.node.get("distribution", [])}

    @property
    def fields(self) -> dict[str, Node]:
        """The fields of all record sets, by id."""
        return {
            str(each.get("@id")): each
            for records in self.node.get("recordSet", [])
            for each in records.get("field", [])
        }

    def local(self, file: Node) -> Path | None:
        """Return where a file is at hand, None where it lies behind a URL or may not be read.

        A descriptor may be anybody's: a path in it leads from its own folder, and to tables and
        shards alone. `check_files` says what is wrong with another.
        """
        name, url = str(file.get("@id")), str(file.get("contentUrl", ""))
        if name in self.mapping:
            return self.mapping[name]
        return None if "://" in url or not _is_data_path(url) else self.folder / url

    def members(self, name: str) -> list[str] | None:
        """Return the files in a container, None where it is not at hand or is no container."""
        if name not in self._members:
            self._members[name] = _members(self, name)
        return self._members[name]


def _is_data_path(path: str) -> bool:
    """Return whether a path is a relative one of a file that descriptors describe."""
    return path.endswith(_DATA_SUFFIXES) and not _NO_PATH.search(path)


def check_files(told: Descriptor) -> None:
    """Check that files exist, are those that were described, and have pinned addresses."""
    for name in told.mapping.keys() - told.files.keys():
        told.say(name, "is mapped to a place, and is no file of the descriptor")
    for name, file in told.files.items():
        if file.get("@type") != "cr:FileObject":
            continue
        if "contentUrl" not in file or "encodingFormat" not in file:
            told.say(name, "has no contentUrl or no encodingFormat")
            continue
        is_repository = "git+https" in listed(file["encodingFormat"])
        if not is_repository and not _SHA256.fullmatch(str(file.get("sha256", ""))):
            told.say(name, f"has the sha256 {file.get('sha256')!r}, and must have 64 hex digits")
        if _MOVING.search(str(file["contentUrl"])) and not is_repository:
            told.say(name, f"{file['contentUrl']} is a branch, which moves: pin a revision")
        if name.endswith(".tar") and TAR not in listed(file["encodingFormat"]):
            told.say(name, f"has the encodingFormat {file['encodingFormat']!r}, and must be {TAR}")
        if not is_repository:
            _at_hand(told, name, file)


def _at_hand(told: Descriptor, name: str, file: Node) -> None:
    """Check a file that is at hand."""
    path = told.local(file)
    if path is None and "://" not in str(file["contentUrl"]):
        told.say(
            name,
            f"has the contentUrl {file['contentUrl']!r}, and a path must be relative and of a file "
            f"that ends in {', '.join(_DATA_SUFFIXES)}",
        )
    elif path is not None and not path.is_file():
        told.say(name, f"{path} does not exist: write the descriptor where its files are")
    elif path is not None:
        _content(told, name, file, path)


def _content(told: Descriptor, name: str, file: Node, path: Path) -> None:
    size = f"{path.stat().st_size} B"
    if file.get("contentSize", size) != size:
        told.say(name, f"has {size}, and the descriptor says {file['contentSize']}")
    found = _sha256(path)
    if found != file.get("sha256"):
        told.say(
            name,
            f"has the sha256 {found}, and the descriptor says {file.get('sha256')}: the file was "
            "replaced or damaged: fetch it again, or write the descriptor anew",
        )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def check_sets(told: Descriptor) -> None:
    """Check that each set of files has containers that exist, and finds something in them."""
    for name, files in told.files.items():
        if files.get("@type") != "cr:FileSet":
            continue
        if not files.get("includes"):
            told.say(name, "has no includes: say which files belong to it")
            continue
        containers = [_container(each) for each in listed(files.get("containedIn"))]
        for container in containers:
            if container not in told.files:
                told.say(name, f"is contained in {container!r}, which is not in the descriptor")
        if files_of_set(told, name) == []:
            patterns = ", ".join(str(each) for each in listed(files["includes"]))
            told.say(name, f"includes {patterns}, which matches none of its files")


def files_of_set(told: Descriptor, name: str) -> list[str] | None:
    """Return the paths of a set's files in what holds them, None where that is not at hand."""
    files = told.files.get(name, {})
    containers = [_container(each) for each in listed(files.get("containedIn"))]
    found = [told.members(each) for each in containers if each in told.files]
    if any(members is None for members in found) or not found:
        return None
    patterns = [str(each) for each in listed(files.get("includes"))]
    return [
        member
        for members in found
        for member in members or ()
        if any(fnmatch.fnmatch(member, pattern) for pattern in patterns)
    ]


def _container(node: Node) -> str:
    source = node.get("fileObject", node)
    return str(source.get("@id"))


def _members(told: Descriptor, name: str) -> list[str] | None:
    """Return the files in a container, None where it is not at hand or is no container."""
    file = told.files[name]
    path = told.local(file)
    if path is None:
        return None
    if path.is_dir():
        return [each.relative_to(path).as_posix() for each in path.rglob("*") if each.is_file()]
    if not path.is_file():
        return None
    encodings = listed(file.get("encodingFormat"))
    if TAR in encodings:
        try:
            with path.open("rb") as opened:
                size = path.stat().st_size
                return [each.name for each in read_members(opened, size, where=str(path))]
        except StorageError as error:
            told.say(name, str(error))
            return None
    return path.read_text().splitlines() if TEXT in encodings else None


def columns_at_hand(told: Descriptor) -> dict[str, list[str]]:
    """Return the columns of every table that is at hand."""
    columns = {}
    for name, file in told.files.items():
        path = told.local(file)
        if path is not None and path.is_file() and PARQUET in listed(file.get("encodingFormat")):
            try:
                columns[name] = pq.read_schema(path).names
            except (pa.ArrowException, OSError) as error:
                told.say(name, f"is no Parquet file that can be read ({error})")
    return columns


def listed(value: Any) -> list[Any]:
    """Return a value that may be one or several as a list."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]
