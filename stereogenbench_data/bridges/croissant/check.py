"""A check of a descriptor that catches what ``mlcroissant validate`` accepts.

`validate` opens no data file. A missing file, a wrong checksum, an unknown column, a dangling key
and a misspelt name all pass it. So does a context of another version, and then no record loads.
This check reads the files that are available locally and follows every reference.
"""

import fnmatch
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, date, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stereogenbench_data.bridges.croissant.nodes import (
    CONTEXT,
    CROISSANT,
    GIT,
    PARQUET,
    RAI,
    TAR,
    TEXT,
    VERSION,
    Node,
)
from stereogenbench_data.bridges.dataset_facts import blanks, listed
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
_TYPES: Final = frozenset(
    {
        *(f"sc:{name}" for name in (
            "Text", "URL", "Integer", "Float", "Boolean", "Date", "DateTime", "Time", "ImageObject",
            "AudioObject", "VideoObject",
        )),
        *(f"cr:{name}" for name in (
            "BoundingBox", "Float16", "Float32", "Float64", "Int8", "Int16", "Int32", "Int64",
            "UInt8", "UInt16", "UInt32", "UInt64",
        )),
    }
)  # fmt: skip
"""The data types that mlcroissant reads. Others may stand beside one of them."""
_IS_TEXT: Final = (pa.types.is_string, pa.types.is_large_string)
_ARROW_TYPES: Final[dict[str, tuple[str, tuple[Callable[[pa.DataType], bool], ...]]]] = {
    "sc:Text": ("text", _IS_TEXT),
    "sc:URL": ("text", _IS_TEXT),
    "sc:Integer": ("whole numbers", (pa.types.is_integer,)),
    "sc:Float": ("numbers", (pa.types.is_floating, pa.types.is_integer)),
    "sc:Boolean": ("true or false", (pa.types.is_boolean,)),
    "sc:Date": ("days", (pa.types.is_date, *_IS_TEXT)),
    "sc:DateTime": ("times", (pa.types.is_timestamp, *_IS_TEXT)),
}
"""What a column of each data type holds, and the tests of Arrow's types for it."""
_NAMED: Final[dict[str, re.Pattern[str]]] = {
    "sc:Integer": re.compile(r"\d+"),
    "sc:Float": re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"),
    "sc:Boolean": re.compile("true|false", re.IGNORECASE),
    "sc:Date": re.compile(r"\d{4}-\d\d-\d\d"),
    "sc:DateTime": re.compile(r"\d{4}-\d\d-\d\d[T ].+"),
}
"""What a part of a file's name must look like to be of a data type."""
_INLINE_TYPES: Final[dict[str, type | tuple[type, ...]]] = {
    "sc:Text": str, "sc:URL": str, "sc:Integer": int, "sc:Float": (int, float), "sc:Boolean": bool,
}  # fmt: skip
_MONTH: Final = re.compile(r"\d{4}(-(0[1-9]|1[0-2]))?")
_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_MOVING: Final = re.compile(r"/(?:resolve|raw|blob|tree)/(?:main|master|HEAD)(?:/|$)")
_DATA_SUFFIXES: Final = (".tar", ".parquet", ".txt")
_NO_PATH: Final = re.compile(r"^[/~]|\\|:|[\x00-\x1f]")
_PROPERTIES: Final = ("fullpath", "filename", "filepath", "content", "lines", "lineNumbers")


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
    except RecursionError as error:
        raise DescriptorError(
            f"{path}: lists or objects are nested hundreds of levels deep. Name a descriptor, such "
            f"as croissant.json."
        ) from error
    except (OSError, ValueError) as error:
        raise DescriptorError(
            f"{path}: cannot be read as JSON ({error}). Name a descriptor, such as croissant.json."
        ) from error
    if not isinstance(node, dict):
        raise DescriptorError(
            f"{path}: must be a JSON object, found a {type(node).__name__}. Name a descriptor."
        )
    check = _Check(node, path.parent, mapping or {})
    try:
        check.run()
    except (AttributeError, RecursionError, TypeError) as error:
        check.report(
            path.name, f"does not have the structure of a descriptor ({error}): write it again"
        )
    return check.problems


class _Check:
    """A descriptor, what it describes, and the problems found so far."""

    def __init__(self, node: Node, folder: Path, mapping: Mapping[str, Path]) -> None:
        self.problems: list[str] = []
        self._node = node
        self._folder = folder
        self._mapping = mapping
        self._members: dict[str, list[str] | None] = {}

    def report(self, where: str, what: str) -> None:
        """Add a problem with its place."""
        self.problems.append(f"{where}: {what}")

    def run(self) -> None:
        """Check the whole descriptor."""
        self._check_context()
        self._check_properties()
        self._check_names()
        self._check_ids()
        self._check_files()
        self._check_sets()
        for records in self._record_sets:
            self._check_records(records)
        for records in self._record_sets:
            read: dict[tuple[str, str], str] = {}
            for field in records.get("field", []):
                self._check_file_property(field, read=read)
                self._check_values(field)

    # What the descriptor describes.

    @cached_property
    def _record_sets(self) -> list[Node]:
        return list(self._node.get("recordSet", []))

    @cached_property
    def _files(self) -> dict[str, Node]:
        """Files and sets of files by id."""
        return {str(each.get("@id")): each for each in self._node.get("distribution", [])}

    @cached_property
    def _fields(self) -> dict[str, Node]:
        """The fields of all record sets by id."""
        nodes = [field for records in self._record_sets for field in records.get("field", [])]
        return {str(node.get("@id")): node for node in nodes}

    @cached_property
    def _columns(self) -> dict[str, pa.Schema]:
        """The columns of every table that is available locally, with their types."""
        columns = {}
        for name, file in self._files.items():
            path = self._local(file)
            if (
                path is not None
                and path.is_file()
                and PARQUET in listed(file.get("encodingFormat"))
            ):
                try:
                    columns[name] = pq.read_schema(path)
                except (pa.ArrowException, OSError) as error:
                    self.report(name, f"cannot be read as Parquet ({error})")
        return columns

    def _local(self, file: Node) -> Path | None:
        """Return the local path of a file, None where it is behind a URL or must not be read.

        Anybody can write a descriptor. So a path in it must be relative to its folder and lead to
        a table or a shard; `_check_files` reports any other path.
        """
        name, path = str(file.get("@id")), str(file.get("contentUrl", ""))
        if name in self._mapping:
            return self._mapping[name]
        is_data = path.endswith(_DATA_SUFFIXES) and not _NO_PATH.search(path)
        return self._folder / path if is_data else None

    def _members_of(self, name: str) -> list[str] | None:
        """Return the files in a container, None if it is not available or not a container."""
        if name not in self._members:
            self._members[name] = self._read_members(name)
        return self._members[name]

    def _read_members(self, name: str) -> list[str] | None:
        file = self._files[name]
        path = self._local(file)
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
                self.report(name, str(error))
                return None
        return path.read_text().splitlines() if TEXT in encodings else None

    def _files_of_set(self, name: str) -> list[str] | None:
        """Return the paths of a set's files in its containers, None if one is not available."""
        files = self._files.get(name, {})
        found = [self._members_of(each) for each in _containers(files) if each in self._files]
        if any(members is None for members in found) or not found:
            return None
        patterns = [str(each) for each in listed(files.get("includes"))]
        return [
            member
            for members in found
            for member in members or ()
            if any(fnmatch.fnmatch(member, pattern) for pattern in patterns)
        ]

    # The dataset as a whole.

    def _check_context(self) -> None:
        conforms = listed(self._node.get("conformsTo"))
        for wanted in (CROISSANT, RAI):
            if wanted not in conforms:
                found = ", ".join(map(str, conforms))
                self.report("conformsTo", f"lacks {wanted} (it has {found})")
        context = self._node.get("@context")
        if not isinstance(context, dict):
            self.report("@context", f"is {context!r}, and must be an object with every term")
            return
        for term, meaning in CONTEXT.items():
            if context.get(term) != meaning:
                self.report(
                    "@context",
                    f"{term} is {context.get(term)!r} and must be {meaning!r}: with another "
                    "version's context no file is found and no record loads",
                )
        if "value" in context:
            self.report(
                "@context", "defines value, and then constant fields have no value: remove it"
            )

    def _check_properties(self) -> None:
        for name in (*REQUIRED, *REQUIRED_RAI):
            if self._node.get(name) in (None, "", [], {}):
                self.report(name, "is missing" if name not in self._node else "is empty")
        for place in blanks(self._node):
            self.report(place, "must be filled in: what stands there is the question")
        for local in RAI_ONCE:
            if len(listed(self._node.get(f"rai:{local}"))) > 1:
                self.report(
                    f"rai:{local}", "has several values, but readers keep only the first: join them"
                )
        version = self._node.get("version")
        if not VERSION.fullmatch(str(version or "")):
            self.report("version", f"is {version!r}, and must be MAJOR.MINOR.PATCH")
        self._check_date(str(self._node.get("datePublished") or ""))

    def _check_date(self, text: str) -> None:
        """Check that the day of publication is a day, month or year that has come."""
        found = None
        try:
            found = date.fromisoformat(text)
        except ValueError:
            if _MONTH.fullmatch(text):
                found = date.fromisoformat(f"{text}-01" if "-" in text else f"{text}-01-01")
        if found is None:
            self.report("datePublished", f"is {text!r}, and must be a date such as 2026-11-22")
        elif found > datetime.now(UTC).date():
            self.report("datePublished", f"is {text}, which has not come yet: write the real date")

    def _check_names(self) -> None:
        """Check the spelling of every property."""
        for place, name in _names(self._node, at=""):
            prefix, _, local = name.rpartition(":")
            problem = ""
            if prefix == "rai" and local not in RAI_NAMES:
                problem = "is not a property of RAI 1.0: check its spelling"
            elif prefix == "prov" and local not in PROV_NAMES:
                problem = f"must be one of {', '.join(sorted(PROV_NAMES))}: check its spelling"
            elif not prefix and name not in _KNOWN:
                problem = "is not a property of Croissant 1.1: check its spelling"
            elif prefix not in {"", "rai", "prov", "sc", "cr", "dct"}:
                problem = (
                    "has a prefix that the context does not define: add it or remove the property"
                )
            if problem:
                self.report(f"{place}{name}", problem)

    def _check_ids(self) -> None:
        seen: set[str] = set()
        nodes = [*self._node.get("distribution", []), *self._record_sets]
        nodes += [field for records in self._record_sets for field in records.get("field", [])]
        for node in nodes:
            name = str(node.get("@id", ""))
            if not name or re.search(r"\s", name):
                self.report(name or "a node", "must have an @id without a space")
            elif name in seen:
                self.report(
                    name, "is the @id of two nodes, and only one of them is read: rename one"
                )
            seen.add(name)

    # Files and sets of files.

    def _check_files(self) -> None:
        """Check that files exist, match their description, and have pinned addresses."""
        for name in self._mapping.keys() - self._files.keys():
            self.report(name, "is mapped to a path, but the descriptor has no such file")
        for name, file in self._files.items():
            if file.get("@type") != "cr:FileObject":
                continue
            if "contentUrl" not in file or "encodingFormat" not in file:
                self.report(name, "must have a contentUrl and an encodingFormat")
                continue
            encodings, url = listed(file["encodingFormat"]), str(file["contentUrl"])
            is_repository = GIT in encodings
            if not is_repository and not _SHA256.fullmatch(str(file.get("sha256", ""))):
                self.report(
                    name, f"has the sha256 {file.get('sha256')!r}, and must have 64 hex digits"
                )
            if _MOVING.search(url) and not is_repository:
                self.report(name, f"{url} is a branch, which changes: pin a revision")
            if name.endswith(".tar") and TAR not in encodings:
                self.report(
                    name, f"has the encodingFormat {file['encodingFormat']!r}, and must be {TAR}"
                )
            if not is_repository:
                self._check_local_file(name, file)

    def _check_local_file(self, name: str, file: Node) -> None:
        path, url = self._local(file), str(file["contentUrl"])
        if path is None:
            if "://" not in url or url[:5].lower() == "file:":
                self.report(
                    name,
                    f"has the contentUrl {url!r}, and a path must be relative and end in "
                    f"{', '.join(_DATA_SUFFIXES)}",
                )
            return
        if not path.is_file():
            self.report(name, f"{path} does not exist: write the descriptor again beside its files")
            return
        size = f"{path.stat().st_size} B"
        if file.get("contentSize", size) != size:
            self.report(
                name,
                f"has {size}, and the descriptor says {file['contentSize']}: fetch the file again",
            )
        with path.open("rb") as opened:
            found = hashlib.file_digest(opened, "sha256").hexdigest()
        if found != file.get("sha256"):
            self.report(
                name,
                f"has the sha256 {found}, and the descriptor says {file.get('sha256')}: the file "
                "was replaced or damaged: fetch it again, or write the descriptor again",
            )

    def _check_sets(self) -> None:
        """Check that each set of files has containers that exist, and matches files in them."""
        for name, files in self._files.items():
            if files.get("@type") != "cr:FileSet":
                continue
            if not files.get("includes"):
                self.report(name, "has no includes: list the patterns of its files")
                continue
            for container in _containers(files):
                if container not in self._files:
                    self.report(
                        name, f"is contained in {container!r}, which is not in the descriptor"
                    )
            if self._files_of_set(name) == []:
                patterns = ", ".join(map(str, listed(files["includes"])))
                self.report(
                    name, f"includes {patterns}, which matches no file: correct the pattern"
                )

    # Record sets and their fields.

    def _check_records(self, records: Node) -> None:
        name = str(records.get("@id"))
        own = {str(each.get("@id")) for each in records.get("field", [])}
        for key in listed(records.get("key")):
            if str(key.get("@id")) not in own:
                self.report(name, f"has the key {key.get('@id')}, which is not one of its fields")
        for row in listed(records.get("data")):
            if set(row) - own:
                strange = ", ".join(sorted(set(row) - own))
                self.report(name, f"has data for {strange}, which it has no field for")
        for field in records.get("field", []):
            self._check_reference(field)
            self._check_type(field, listed(records.get("data")))
            self._check_source(field, has_data="data" in records)

    def _check_reference(self, node: Node) -> None:
        if "references" not in node:
            return
        name = str(node.get("@id"))
        target = node["references"].get("field", {}).get("@id")
        if target is None:
            self.report(
                name,
                'has a reference without a field: write {"references": {"field": {"@id": ...}}}',
            )
        elif target not in self._fields:
            self.report(name, f"refers to {target!r}, which is not in the descriptor")
        elif "references" in self._fields[target]:
            self.report(
                name, f"refers to {target}, which is itself a reference: chains load wrong rows"
            )

    def _check_type(self, node: Node, rows: list[Node]) -> None:
        """Check a field's data type, and that the values given with the descriptor have it."""
        name, kinds = str(node.get("@id")), listed(node.get("dataType"))
        if not _TYPES & {str(kind) for kind in kinds}:
            found = ", ".join(map(str, kinds)) or "none"
            self.report(
                name, f"has the data type {found}, and one must be of {', '.join(sorted(_TYPES))}"
            )
        wanted = [_INLINE_TYPES[kind] for kind in kinds if kind in _INLINE_TYPES]
        for value in (row[name] for row in rows if name in row):
            is_flag = isinstance(value, bool) and "sc:Boolean" not in kinds
            if wanted and (is_flag or not isinstance(value, wanted[0])):
                self.report(name, f"has the value {value!r}, which is not {', '.join(kinds)}")

    def _check_column(self, node: Node, *, file: str, column: str) -> None:
        """Check that a column holds what its field says: type, list or not, length of lists."""
        name, found = str(node.get("@id")), self._columns[file].field(column).type
        is_list = pa.types.is_list(found) or pa.types.is_large_list(found)
        is_list = is_list or pa.types.is_fixed_size_list(found)
        if is_list != bool(node.get("isArray")):
            says = "isArray" if node.get("isArray") else "no isArray"
            self.report(name, f"has {says}, but the column {column!r} of {file} holds {found}")
            return
        value = found.value_type if is_list else found
        for kind in listed(node.get("dataType")):
            what, tests = _ARROW_TYPES.get(kind, ("", ()))
            if tests and not any(test(value) for test in tests):
                self.report(
                    name,
                    f"has the data type {kind} ({what}), but the column {column!r} of {file} "
                    f"holds {found}",
                )
        if is_list:
            self._check_shape(node, file=file, column=column)

    def _check_shape(self, node: Node, *, file: str, column: str) -> None:
        shape = [part.strip() for part in str(node.get("arrayShape", "-1")).split(",")]
        path = self._local(self._files[file])
        if not all(re.fullmatch(r"-1|\d+", part) for part in shape):
            self.report(
                str(node.get("@id")),
                f"has the arrayShape {node['arrayShape']!r}, and must have numbers such as 15 or "
                "2,3 (-1 for any)",
            )
        elif path is not None and len(shape) == 1 and shape != ["-1"]:
            lists = pq.read_table(path, columns=[column]).column(0)
            lengths = set(pc.list_value_length(lists).unique().to_pylist()) - {None, int(shape[0])}
            if lengths:
                self.report(
                    str(node.get("@id")),
                    f"has the arrayShape {shape[0]}, but the column {column!r} of {file} has a "
                    f"list of {min(lengths)}",
                )

    def _check_source(self, node: Node, *, has_data: bool) -> None:
        name, source = str(node.get("@id")), node.get("source")
        if source is None:
            if not has_data:
                self.report(name, "has neither a source nor inline data")
            return
        of = source.get("fileObject") or source.get("fileSet") or source.get("field") or {}
        origin = of.get("@id")
        if origin not in self._files and origin not in self._fields:
            self.report(name, f"is read from {origin!r}, which is not in the descriptor")
        column, columns = source.get("extract", {}).get("column"), self._columns.get(str(origin))
        if column is not None and columns is not None:
            if column in columns.names:
                self._check_column(node, file=str(origin), column=column)
            else:
                self.report(
                    name,
                    f"reads the column {column!r} of {origin}; its columns are {columns.names}",
                )
        regex = source.get("transform", {}).get("regex")
        if regex is not None and not _has_group(regex):
            self.report(name, f"takes the first group of the regex {regex!r}, which has no group")

    def _check_file_property(self, node: Node, *, read: dict[tuple[str, str], str]) -> None:
        """Check what a field reads of each file of a set.

        A regex that matches nothing, or that changes its own result, gives empty or wrong records
        without an error. A join rewrites the property in place, so no other field may read it.

        Args:
            node: The field.
            read: Set of files and property to the first field that reads it; extended.
        """
        name, source = str(node.get("@id")), node.get("source", {})
        wanted = source.get("extract", {}).get("fileProperty")
        if wanted is None:
            return
        files = str(source.get("fileSet", {}).get("@id"))
        other = read.setdefault((files, str(wanted)), name)
        if other != name and ("references" in node or "references" in self._fields[other]):
            self.report(name, f"reads what {other} reads, {wanted} of {files}: a join rewrites it")
        if wanted not in _PROPERTIES:
            self.report(
                name, f"reads {wanted!r} of each file; must be one of {', '.join(_PROPERTIES)}"
            )
        kinds = [kind for kind in listed(node.get("dataType")) if kind in _NAMED]
        if kinds and wanted == "content" and not source.get("transform"):
            self.report(name, f"has the data type {kinds[0]}, but the content of a file is none")
        regex = source.get("transform", {}).get("regex")
        paths = self._files_of_set(files)
        if not paths or wanted not in {"fullpath", "filename"} or not _has_group(regex or ""):
            return
        texts = [path if wanted == "fullpath" else path.rpartition("/")[2] for path in paths]
        found = {text: re.match(regex, text) for text in texts}
        missed = [text for text, match in found.items() if match is None]
        taken = [each[1] or "" for each in found.values() if each]
        odd = {kind: [text for text in taken if not _NAMED[kind].fullmatch(text)] for kind in kinds}
        other_kind = next((kind for kind in kinds if odd[kind]), None)
        if missed:
            self.report(name, f"has the regex {regex!r}, which does not match {missed[0]}")
        elif other_kind is not None:
            self.report(
                name,
                f"is an {other_kind}, but the regex {regex!r} takes {odd[other_kind][0]!r} of a "
                "name",
            )
        elif "references" in node and not _is_kept(regex, texts[0]):
            self.report(
                name,
                f"has the regex {regex!r}, which changes its own result, but a join applies it "
                "twice",
            )

    def _check_values(self, node: Node) -> None:
        """Check that every value of a column is among those of the field that it refers to."""
        target = self._fields.get(node.get("references", {}).get("field", {}).get("@id"))
        if target is None:
            return
        here, meant = self._values_of(node), str(target.get("@id"))
        there = self._inline_values_of(meant) or self._values_of(target)
        strange = sorted(here - there) if here is not None and there is not None else []
        if strange:
            self.report(
                str(node.get("@id")), f"has the value {strange[0]!r}, which {meant} does not have"
            )

    def _values_of(self, node: Node) -> set[str] | None:
        """Return the texts in the column that a field reads, None if it is not available."""
        source = node.get("source", {})
        file = str(source.get("fileObject", {}).get("@id"))
        column = source.get("extract", {}).get("column")
        schema = self._columns.get(file)
        has_column = schema is not None and column in schema.names
        path = self._local(self._files[file]) if has_column else None
        if path is None:
            return None
        values: pa.ChunkedArray = pq.read_table(path, columns=[column]).column(0)
        return {str(value) for value in values.unique().to_pylist() if value not in (None, "")}

    def _inline_values_of(self, name: str) -> set[str]:
        """Return a field's values in inline data, none if it has none."""
        for records in self._record_sets:
            if name in {str(each.get("@id")) for each in records.get("field", [])}:
                return {str(row.get(name)) for row in listed(records.get("data"))}
        return set()


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


def _containers(files: Node) -> list[str]:
    """Return the ids of the files that contain a set of files."""
    nodes = listed(files.get("containedIn"))
    return [str(each.get("fileObject", each).get("@id")) for each in nodes]


def _has_group(regex: str) -> bool:
    try:
        return re.compile(regex).groups >= 1
    except re.error:
        return False


def _is_kept(regex: str, text: str) -> bool:
    """Return whether a regex applied to its own result gives the same result."""
    once = re.match(regex, text)
    again = None if once is None else re.match(regex, once[1])
    return once is not None and again is not None and again[1] == once[1]
