"""A check of a descriptor that catches what ``mlcroissant validate`` accepts.

`validate` opens no data file. A missing file, a wrong checksum, an unknown column, a dangling key
and a misspelt name all pass it. So does a context of another version, and then no record loads.
This check reads the files that are available locally and follows every reference.
"""

import fnmatch
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from stereogenbench_data.bridges.croissant.nodes import (
    CONTEXT,
    CROISSANT,
    PARQUET,
    RAI,
    TAR,
    TEXT,
    Node,
)
from stereogenbench_data.errors import DescriptorError, StorageError
from stereogenbench_data.shards.tar import read_members

RAI_NAMES: Final = frozenset(
    {
        "dataCollection", "dataCollectionMissingData", "dataCollectionRawData",
        "dataCollectionTimeframe", "dataCollectionType", "dataImputationProtocol",
        "dataManipulationProtocol", "dataPreprocessingProtocol", "dataAnnotationProtocol",
        "dataAnnotationPlatform", "dataAnnotationAnalysis", "annotationsPerItem",
        "annotatorDemographics", "machineAnnotationTools", "dataBiases", "dataUseCases",
        "dataLimitations", "dataSocialImpact", "personalSensitiveInformation",
        "dataReleaseMaintenancePlan", "hasSyntheticData",
    }
)  # fmt: skip
"""The properties of the RAI 1.0 specification, and hasSyntheticData."""
REQUIRED_RAI: Final = (
    "rai:dataLimitations", "rai:dataBiases", "rai:personalSensitiveInformation",
    "rai:dataUseCases", "rai:dataSocialImpact", "rai:hasSyntheticData", "prov:wasDerivedFrom",
    "prov:wasGeneratedBy",
)  # fmt: skip
REQUIRED: Final = (
    "name", "description", "url", "license", "creator", "version", "datePublished", "citeAs",
    "keywords", "distribution", "recordSet",
)  # fmt: skip
RAI_ONCE: Final = (
    "dataCollection", "dataCollectionMissingData", "dataCollectionRawData",
    "dataImputationProtocol", "annotationsPerItem", "dataSocialImpact",
    "dataReleaseMaintenancePlan",
)  # fmt: skip
"""Properties of which mlcroissant keeps only the first value."""
PROV_NAMES: Final = frozenset(
    {"wasGeneratedBy", "wasDerivedFrom", "wasAttributedTo", "type", "label"}
)
_KNOWN: Final = frozenset(
    {
        *CONTEXT, *REQUIRED, "affiliation", "contentSize", "contentUrl", "encodingFormat",
        "excludes", "inLanguage", "md5", "sha256", "usageInfo", "@context", "@type", "@id",
        "@value", "@language",
    }
)  # fmt: skip
_VERSION: Final = re.compile(r"\d+\.\d+\.\d+")
_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_MOVING: Final = re.compile(r"/(?:resolve|raw|blob|tree)/(?:main|master|HEAD)(?:/|$)")
_DATA_SUFFIXES: Final = (".tar", ".parquet", ".txt")
_NO_PATH: Final = re.compile(r"^[/~]|\\|:|[\x00-\x1f]")
_CHUNK_BYTES: Final = 1 << 20
_PROPERTIES: Final = ("fullpath", "filename", "filepath", "content", "lines", "lineNumbers")


@dataclass(slots=True)
class _CheckedDescriptor:
    """A descriptor and the problems found in it."""

    node: Node
    folder: Path
    mapping: Mapping[str, Path]
    problems: list[str] = field(default_factory=list)
    _members: dict[str, list[str] | None] = field(default_factory=dict)

    def report(self, where: str, what: str) -> None:
        """Add a problem with its place."""
        self.problems.append(f"{where}: {what}")

    @property
    def files(self) -> dict[str, Node]:
        """Files and sets of files by id."""
        return {str(each.get("@id")): each for each in self.node.get("distribution", [])}

    @property
    def fields(self) -> dict[str, Node]:
        """The fields of all record sets by id."""
        return {
            str(each.get("@id")): each
            for records in self.node.get("recordSet", [])
            for each in records.get("field", [])
        }

    def local(self, file: Node) -> Path | None:
        """Return the local path of a file, None where it is behind a URL or must not be read.

        Anybody can write a descriptor. So a path in it must be relative to its folder and lead to
        a table or a shard; `_check_files` reports any other path.
        """
        name, url = str(file.get("@id")), str(file.get("contentUrl", ""))
        if name in self.mapping:
            return self.mapping[name]
        return None if "://" in url or not _is_data_path(url) else self.folder / url

    def members(self, name: str) -> list[str] | None:
        """Return the files in a container, None if it is not available or not a container."""
        if name not in self._members:
            self._members[name] = _members(self, name)
        return self._members[name]


def check_descriptor(path: Path, *, mapping: Mapping[str, Path] | None = None) -> list[str]:
    """Return the problems of a descriptor, one line each: place, what was found, cure.

    Args:
        path: The descriptor.
        mapping: Local paths, by id, of files that the descriptor names by URL. Of other files
            behind a URL only the entries in the descriptor are checked.

    Raises:
        DescriptorError: If the file cannot be read or is not a JSON object.
    """
    try:
        node = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DescriptorError(
            f"{path}: cannot be read as JSON ({error}). Name a descriptor, such as croissant.json."
        ) from error
    if not isinstance(node, dict):
        raise DescriptorError(
            f"{path}: must be a JSON object, found a {type(node).__name__}. Name a descriptor."
        )
    checked = _CheckedDescriptor(node, path.parent, mapping or {})
    try:
        for check in (
            _context,
            _properties,
            _ids,
            _check_files,
            _check_sets,
            _records,
            _check_fields,
        ):
            check(checked)
    except (AttributeError, TypeError) as error:
        checked.report(
            path.name, f"does not have the structure of a descriptor ({error}): write it again"
        )
    return checked.problems


def _context(checked: _CheckedDescriptor) -> None:
    conforms = _listed(checked.node.get("conformsTo"))
    for wanted in (CROISSANT, RAI):
        if wanted not in conforms:
            checked.report("conformsTo", f"lacks {wanted} (it has {', '.join(map(str, conforms))})")
    context = checked.node.get("@context")
    if not isinstance(context, dict):
        checked.report("@context", f"is {context!r}, and must be an object with every term")
        return
    for term, meaning in CONTEXT.items():
        if context.get(term) != meaning:
            checked.report(
                "@context",
                f"{term} is {context.get(term)!r} and must be {meaning!r}: with another version's "
                "context no file is found and no record loads",
            )
    if "value" in context:
        checked.report(
            "@context", "defines value, and then constant fields have no value: remove it"
        )


def _properties(checked: _CheckedDescriptor) -> None:
    for name in (*REQUIRED, *REQUIRED_RAI):
        if checked.node.get(name) in (None, "", [], {}):
            checked.report(name, "is missing" if name not in checked.node else "is empty")
    for local in RAI_ONCE:
        if len(_listed(checked.node.get(f"rai:{local}"))) > 1:
            checked.report(
                f"rai:{local}", "has several values, but readers keep only the first: join them"
            )
    if not _VERSION.fullmatch(str(checked.node.get("version", ""))):
        checked.report(
            "version", f"is {checked.node.get('version')!r}, and must be MAJOR.MINOR.PATCH"
        )
    _known_names(checked)


def _known_names(checked: _CheckedDescriptor) -> None:
    for place, name in _names(checked.node, at=""):
        prefix, _, local = name.rpartition(":")
        if prefix == "rai" and local not in RAI_NAMES:
            checked.report(f"{place}{name}", "is not a property of RAI 1.0: check its spelling")
        elif prefix == "prov" and local not in PROV_NAMES:
            checked.report(
                f"{place}{name}",
                f"must be one of {', '.join(sorted(PROV_NAMES))}: check its spelling",
            )
        elif not prefix and name not in _KNOWN:
            checked.report(
                f"{place}{name}", "is not a property of Croissant 1.1: check its spelling"
            )
        elif prefix and prefix not in {"rai", "prov", "sc", "cr", "dct"}:
            checked.report(
                f"{place}{name}",
                "has a prefix that the context does not define: add it or remove the property",
            )


def _names(node: Any, *, at: str) -> Iterator[tuple[str, str]]:
    """Yield every property below a node with its place, except in inline data."""
    if isinstance(node, list):
        for item in node:
            yield from _names(item, at=at)
    elif isinstance(node, dict):
        here = f"{node['@id']}." if "@id" in node else at
        for name, value in node.items():
            yield here, name
            if name not in {"@context", "data", "examples"}:
                yield from _names(value, at=here)


def _ids(checked: _CheckedDescriptor) -> None:
    seen: set[str] = set()
    nodes = [*checked.node.get("distribution", []), *checked.node.get("recordSet", [])]
    nodes += [field for records in checked.node.get("recordSet", []) for field in records["field"]]
    for node in nodes:
        name = str(node.get("@id", ""))
        if not name or re.search(r"\s", name):
            checked.report(name or "a node", "must have an @id without a space")
        elif name in seen:
            checked.report(
                name, "is the @id of two nodes, and only one of them is read: rename one"
            )
        seen.add(name)


def _records(checked: _CheckedDescriptor) -> None:
    columns = _local_columns(checked)
    for records in checked.node.get("recordSet", []):
        name = str(records.get("@id"))
        own = {str(each.get("@id")) for each in records.get("field", [])}
        keys = [str(each.get("@id")) for each in _listed(records.get("key"))]
        for key in keys:
            if key not in own:
                checked.report(name, f"has the key {key}, which is not one of its fields")
        for row in _listed(records.get("data")):
            if set(row) - own:
                checked.report(
                    name,
                    f"has data for {', '.join(sorted(set(row) - own))}, which it has no field for",
                )
        for each in records.get("field", []):
            _field(checked, each, columns=columns, has_data="data" in records)


def _field(
    checked: _CheckedDescriptor, node: Node, *, columns: dict[str, list[str]], has_data: bool
) -> None:
    name = str(node.get("@id"))
    target = node.get("references", {}).get("field", {}).get("@id")
    if "references" in node and target is None:
        checked.report(
            name, 'has a reference without a field: write {"references": {"field": {"@id": ...}}}'
        )
    elif target is not None and target not in checked.fields:
        checked.report(name, f"refers to {target!r}, which is not in the descriptor")
    elif target is not None and "references" in checked.fields[target]:
        checked.report(
            name, f"refers to {target}, which is itself a reference: chains load wrong rows"
        )
    source = node.get("source")
    if source is None:
        if not has_data:
            checked.report(name, "has neither a source nor inline data")
        return
    of = source.get("fileObject") or source.get("fileSet") or source.get("field") or {}
    origin = of.get("@id")
    if origin not in checked.files and origin not in checked.fields:
        checked.report(name, f"is read from {origin!r}, which is not in the descriptor")
    column = source.get("extract", {}).get("column")
    if column is not None and origin in columns and column not in columns[origin]:
        checked.report(
            name, f"reads the column {column!r} of {origin}; its columns are {columns[origin]}"
        )
    regex = source.get("transform", {}).get("regex")
    if regex is not None and not _has_group(regex):
        checked.report(name, f"takes the first group of the regex {regex!r}, which has no group")


def _has_group(regex: str) -> bool:
    try:
        return re.compile(regex).groups >= 1
    except re.error:
        return False


def _is_data_path(path: str) -> bool:
    """Return whether a path is relative and that of a table or a shard."""
    return path.endswith(_DATA_SUFFIXES) and not _NO_PATH.search(path)


def _check_files(checked: _CheckedDescriptor) -> None:
    """Check that files exist, match their description, and have pinned addresses."""
    for name in checked.mapping.keys() - checked.files.keys():
        checked.report(name, "is mapped to a path, but the descriptor has no such file")
    for name, file in checked.files.items():
        if file.get("@type") != "cr:FileObject":
            continue
        if "contentUrl" not in file or "encodingFormat" not in file:
            checked.report(name, "must have a contentUrl and an encodingFormat")
            continue
        is_repository = "git+https" in _listed(file["encodingFormat"])
        if not is_repository and not _SHA256.fullmatch(str(file.get("sha256", ""))):
            checked.report(
                name, f"has the sha256 {file.get('sha256')!r}, and must have 64 hex digits"
            )
        if _MOVING.search(str(file["contentUrl"])) and not is_repository:
            checked.report(name, f"{file['contentUrl']} is a branch, which changes: pin a revision")
        if name.endswith(".tar") and TAR not in _listed(file["encodingFormat"]):
            checked.report(
                name, f"has the encodingFormat {file['encodingFormat']!r}, and must be {TAR}"
            )
        if not is_repository:
            _local_file(checked, name, file)


def _local_file(checked: _CheckedDescriptor, name: str, file: Node) -> None:
    """Check a file that is available locally."""
    path = checked.local(file)
    if path is None and "://" not in str(file["contentUrl"]):
        checked.report(
            name,
            f"has the contentUrl {file['contentUrl']!r}, and a path must be relative and end in "
            f" {', '.join(_DATA_SUFFIXES)}",
        )
    elif path is not None and not path.is_file():
        checked.report(name, f"{path} does not exist: write the descriptor again beside its files")
    elif path is not None:
        _content(checked, name, file, path)


def _content(checked: _CheckedDescriptor, name: str, file: Node, path: Path) -> None:
    size = f"{path.stat().st_size} B"
    if file.get("contentSize", size) != size:
        checked.report(
            name, f"has {size}, and the descriptor says {file['contentSize']}: fetch the file again"
        )
    found = _sha256(path)
    if found != file.get("sha256"):
        checked.report(
            name,
            f"has the sha256 {found}, and the descriptor says {file.get('sha256')}: the file was "
            "replaced or damaged: fetch it again, or write the descriptor again",
        )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def _check_sets(checked: _CheckedDescriptor) -> None:
    """Check that each set of files has containers that exist, and matches files in them."""
    for name, files in checked.files.items():
        if files.get("@type") != "cr:FileSet":
            continue
        if not files.get("includes"):
            checked.report(name, "has no includes: list the patterns of its files")
            continue
        containers = [_container(each) for each in _listed(files.get("containedIn"))]
        for container in containers:
            if container not in checked.files:
                checked.report(
                    name, f"is contained in {container!r}, which is not in the descriptor"
                )
        if _files_of_set(checked, name) == []:
            patterns = ", ".join(str(each) for each in _listed(files["includes"]))
            checked.report(name, f"includes {patterns}, which matches no file: correct the pattern")


def _files_of_set(checked: _CheckedDescriptor, name: str) -> list[str] | None:
    """Return the paths of a set's files in its containers, None if one is not available."""
    files = checked.files.get(name, {})
    containers = [_container(each) for each in _listed(files.get("containedIn"))]
    found = [checked.members(each) for each in containers if each in checked.files]
    if any(members is None for members in found) or not found:
        return None
    patterns = [str(each) for each in _listed(files.get("includes"))]
    return [
        member
        for members in found
        for member in members or ()
        if any(fnmatch.fnmatch(member, pattern) for pattern in patterns)
    ]


def _container(node: Node) -> str:
    source = node.get("fileObject", node)
    return str(source.get("@id"))


def _members(checked: _CheckedDescriptor, name: str) -> list[str] | None:
    """Return the files in a container, None if it is not available or not a container."""
    file = checked.files[name]
    path = checked.local(file)
    if path is None:
        return None
    if path.is_dir():
        return [each.relative_to(path).as_posix() for each in path.rglob("*") if each.is_file()]
    if not path.is_file():
        return None
    encodings = _listed(file.get("encodingFormat"))
    if TAR in encodings:
        try:
            with path.open("rb") as opened:
                size = path.stat().st_size
                return [each.name for each in read_members(opened, size, where=str(path))]
        except StorageError as error:
            checked.report(name, str(error))
            return None
    return path.read_text().splitlines() if TEXT in encodings else None


def _local_columns(checked: _CheckedDescriptor) -> dict[str, list[str]]:
    """Return the columns of every table that is available locally."""
    columns = {}
    for name, file in checked.files.items():
        path = checked.local(file)
        if path is not None and path.is_file() and PARQUET in _listed(file.get("encodingFormat")):
            try:
                columns[name] = pq.read_schema(path).names
            except (pa.ArrowException, OSError) as error:
                checked.report(name, f"cannot be read as Parquet ({error})")
    return columns


def _listed(value: Any) -> list[Any]:
    """Return a single value, a list of values or None as a list."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]


def _check_fields(checked: _CheckedDescriptor) -> None:
    """Check what fields read from files, and what their references lead to.

    A regex that matches nothing, or that changes its own result, gives empty or wrong records
    without an error; so do values that refer to no record.
    """
    columns = _local_columns(checked)
    for records in checked.node.get("recordSet", []):
        read: dict[tuple[str, str], str] = {}
        for each in records.get("field", []):
            _joined_once(checked, each, read=read)
            _property(checked, each)
            _values(checked, each, columns=columns)


def _joined_once(
    checked: _CheckedDescriptor, node: Node, *, read: dict[tuple[str, str], str]
) -> None:
    """Check that no other field reads the property that a reference joins on.

    The join rewrites that property in place.
    """
    place = _file_property(node)
    if place is None:
        return
    name = str(node.get("@id"))
    other = read.setdefault(place, name)
    references = [each for each in (name, other) if "references" in checked.fields[each]]
    if other != name and references:
        checked.report(
            name, f"reads what {other} reads, {place[1]} of {place[0]}: a join rewrites it"
        )


def _file_property(node: Node) -> tuple[str, str] | None:
    source = node.get("source", {})
    wanted = source.get("extract", {}).get("fileProperty")
    return None if wanted is None else (str(source.get("fileSet", {}).get("@id")), str(wanted))


def _property(checked: _CheckedDescriptor, node: Node) -> None:
    place = _file_property(node)
    if place is None:
        return
    name = str(node.get("@id"))
    files, wanted = place
    if wanted not in _PROPERTIES:
        checked.report(
            name, f"reads {wanted!r} of each file; must be one of {', '.join(_PROPERTIES)}"
        )
    regex = node["source"].get("transform", {}).get("regex")
    paths = _files_of_set(checked, files)
    if regex is None or not paths or wanted not in {"fullpath", "filename"}:
        return
    if not _has_group(regex):
        return
    texts = [path if wanted == "fullpath" else path.rpartition("/")[2] for path in paths]
    missed = [text for text in texts if not re.match(regex, text)]
    if missed:
        checked.report(name, f"has the regex {regex!r}, which does not match {missed[0]}")
    elif "references" in node and not _is_kept(regex, texts[0]):
        checked.report(
            name,
            f"has the regex {regex!r}, which changes its own result, but a join applies it twice",
        )


def _is_kept(regex: str, text: str) -> bool:
    """Return whether a regex applied to its own result gives the same result."""
    once = re.match(regex, text)
    again = None if once is None else re.match(regex, once[1])
    return once is not None and again is not None and again[1] == once[1]


def _values(checked: _CheckedDescriptor, node: Node, *, columns: dict[str, list[str]]) -> None:
    """Check that every value of a column is among those of the field that it refers to."""
    target = checked.fields.get(node.get("references", {}).get("field", {}).get("@id"))
    here = None if target is None else _column(checked, node, columns=columns)
    if target is None or here is None:
        return
    name, meant = str(node.get("@id")), str(target.get("@id"))
    there = _inline(checked, meant)
    if there is None:
        there = _column(checked, target, columns=columns)
    strange = sorted(here - there) if there is not None else []
    if strange:
        checked.report(name, f"has the value {strange[0]!r}, which {meant} does not have")


def _column(
    checked: _CheckedDescriptor, node: Node, *, columns: dict[str, list[str]]
) -> set[str] | None:
    """Return the texts in the column that a field reads, None if it is not available."""
    source = node.get("source", {})
    file = str(source.get("fileObject", {}).get("@id"))
    column = source.get("extract", {}).get("column")
    path = checked.local(checked.files[file]) if file in columns else None
    if path is None or column not in columns[file]:
        return None
    values: pa.ChunkedArray = pq.read_table(path, columns=[column]).column(0)
    return {str(value) for value in values.unique().to_pylist() if value not in (None, "")}


def _inline(checked: _CheckedDescriptor, name: str) -> set[str] | None:
    """Return a field's values in inline data, None if it has none."""
    for records in checked.node.get("recordSet", []):
        rows: list[dict[str, Any]] = _listed(records.get("data"))
        if rows and name in {str(each.get("@id")) for each in records.get("field", [])}:
            return {str(row.get(name)) for row in rows}
    return None
