"""A check of a descriptor that catches what ``mlcroissant validate`` lets through.

`validate` opens no data file: a missing file, a wrong checksum, an unknown column, a dangling key,
a misspelt name and a context of another version all pass it, and the last then loads no record at
all. This check reads the files that are at hand and follows every reference.
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.bridges.croissant_check_fields import check_fields
from stereogenbench_data.bridges.croissant_check_files import (
    Descriptor,
    check_files,
    check_sets,
    columns_at_hand,
    listed,
)
from stereogenbench_data.bridges.croissant_terms import CONTEXT, CROISSANT, RAI, Node
from stereogenbench_data.errors import DescriptorError

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
"""Those of which mlcroissant keeps the first value alone."""
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


def check_descriptor(path: Path, *, mapping: Mapping[str, Path] | None = None) -> list[str]:
    """Return what is wrong with a descriptor, each as one line: place, what was found, cure.

    Args:
        path: The descriptor.
        mapping: Where files that it names by URL are at hand, by their ids; others that lie behind
            a URL are checked as far as the descriptor tells.

    Raises:
        DescriptorError: If the file cannot be read or is no JSON object.
    """
    try:
        node = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DescriptorError(f"{path}: is no JSON file that can be read ({error}).") from error
    if not isinstance(node, dict):
        raise DescriptorError(f"{path}: is no JSON object but a {type(node).__name__}.")
    told = Descriptor(node, path.parent, mapping or {})
    try:
        for check in (_context, _properties, _ids, check_files, check_sets, _records, check_fields):
            check(told)
    except (AttributeError, TypeError) as error:
        told.say(path.name, f"is not shaped as a descriptor is ({error}): write it anew")
    return told.problems


def _context(told: Descriptor) -> None:
    conforms = listed(told.node.get("conformsTo"))
    for wanted in (CROISSANT, RAI):
        if wanted not in conforms:
            told.say("conformsTo", f"lacks {wanted} (it has {', '.join(map(str, conforms))})")
    context = told.node.get("@context")
    if not isinstance(context, dict):
        told.say("@context", f"is {context!r}, and must be an object with every term")
        return
    for term, meaning in CONTEXT.items():
        if context.get(term) != meaning:
            told.say(
                "@context",
                f"{term} is {context.get(term)!r} and must be {meaning!r}: with another version's "
                "context, files are not found and no record is loaded",
            )
    if "value" in context:
        told.say(
            "@context", "defines value: constant fields are then read as nothing; leave it out"
        )


def _properties(told: Descriptor) -> None:
    for name in (*REQUIRED, *REQUIRED_RAI):
        if told.node.get(name) in (None, "", [], {}):
            told.say(name, "is missing" if name not in told.node else "is empty")
    for local in RAI_ONCE:
        if len(listed(told.node.get(f"rai:{local}"))) > 1:
            told.say(
                f"rai:{local}", "has several values, of which readers keep the first: join them"
            )
    if not _VERSION.fullmatch(str(told.node.get("version", ""))):
        told.say("version", f"is {told.node.get('version')!r}, and must be MAJOR.MINOR.PATCH")
    _known_names(told)


def _known_names(told: Descriptor) -> None:
    for place, name in _names(told.node, at=""):
        prefix, _, local = name.rpartition(":")
        if prefix == "rai" and local not in RAI_NAMES:
            told.say(f"{place}{name}", "is no property of RAI 1.0: is it misspelt?")
        elif prefix == "prov" and local not in PROV_NAMES:
            told.say(f"{place}{name}", f"is none of {', '.join(sorted(PROV_NAMES))}: misspelt?")
        elif not prefix and name not in _KNOWN:
            told.say(f"{place}{name}", "is no property of Croissant 1.1: is it misspelt?")
        elif prefix and prefix not in {"rai", "prov", "sc", "cr", "dct"}:
            told.say(f"{place}{name}", "has a prefix that the context does not define")


def _names(node: Any, *, at: str) -> Iterator[tuple[str, str]]:
    """Yield every property below a node with its place, but for what stands in inline data."""
    if isinstance(node, list):
        for item in node:
            yield from _names(item, at=at)
    elif isinstance(node, dict):
        here = f"{node['@id']}." if "@id" in node else at
        for name, value in node.items():
            yield here, name
            if name not in {"@context", "data", "examples"}:
                yield from _names(value, at=here)


def _ids(told: Descriptor) -> None:
    seen: set[str] = set()
    nodes = [*told.node.get("distribution", []), *told.node.get("recordSet", [])]
    nodes += [field for records in told.node.get("recordSet", []) for field in records["field"]]
    for node in nodes:
        name = str(node.get("@id", ""))
        if not name or re.search(r"\s", name):
            told.say(name or "a node", "has no @id, or one with a space in it")
        elif name in seen:
            told.say(name, "is the @id of two nodes: only one of them is read")
        seen.add(name)


def _records(told: Descriptor) -> None:
    columns = columns_at_hand(told)
    for records in told.node.get("recordSet", []):
        name = str(records.get("@id"))
        own = {str(each.get("@id")) for each in records.get("field", [])}
        keys = [str(each.get("@id")) for each in listed(records.get("key"))]
        for key in keys:
            if key not in own:
                told.say(name, f"has the key {key}, which is no field of it")
        for row in listed(records.get("data")):
            if set(row) - own:
                told.say(name, f"has data for {', '.join(sorted(set(row) - own))}: no such field")
        for each in records.get("field", []):
            _field(told, each, columns=columns, has_data="data" in records)


def _field(told: Descriptor, node: Node, *, columns: dict[str, list[str]], has_data: bool) -> None:
    name = str(node.get("@id"))
    target = node.get("references", {}).get("field", {}).get("@id")
    if "references" in node and target is None:
        told.say(name, 'refers to no field: write {"references": {"field": {"@id": ...}}}')
    elif target is not None and target not in told.fields:
        told.say(name, f"refers to {target!r}, which is not in the descriptor")
    elif target is not None and "references" in told.fields[target]:
        told.say(name, f"refers to {target}, which refers on: chains load wrong rows")
    source = node.get("source")
    if source is None:
        if not has_data:
            told.say(name, "has no source")
        return
    of = source.get("fileObject") or source.get("fileSet") or source.get("field") or {}
    origin = of.get("@id")
    if origin not in told.files and origin not in told.fields:
        told.say(name, f"is read from {origin!r}, which is not in the descriptor")
    column = source.get("extract", {}).get("column")
    if column is not None and origin in columns and column not in columns[origin]:
        told.say(name, f"is the column {column!r} of {origin}; there are {columns[origin]}")
    regex = source.get("transform", {}).get("regex")
    if regex is not None and not _has_group(regex):
        told.say(name, f"takes the first group of the regex {regex!r}, which has none")


def _has_group(regex: str) -> bool:
    try:
        return re.compile(regex).groups >= 1
    except re.error:
        return False
