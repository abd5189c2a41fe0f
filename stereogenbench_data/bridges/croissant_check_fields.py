"""What a descriptor's fields would read, against the files that are at hand.

A regex that finds nothing, or that changes what it found before, gives empty or wrong records
without a word; so do values that refer to no record.
"""

import re
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from stereogenbench_data.bridges.croissant_check_files import (
    Descriptor,
    columns_at_hand,
    files_of_set,
    listed,
)
from stereogenbench_data.bridges.croissant_terms import Node

_PROPERTIES: Final = ("fullpath", "filename", "filepath", "content", "lines", "lineNumbers")


def check_fields(told: Descriptor) -> None:
    """Check what fields take from files, and what their references lead to."""
    columns = columns_at_hand(told)
    for records in told.node.get("recordSet", []):
        read: dict[tuple[str, str], str] = {}
        for each in records.get("field", []):
            _joined_once(told, each, read=read)
            _property(told, each)
            _values(told, each, columns=columns)


def _joined_once(told: Descriptor, node: Node, *, read: dict[tuple[str, str], str]) -> None:
    """Check that no other field reads what a reference is joined by: the join rewrites it."""
    place = _file_property(node)
    if place is None:
        return
    name = str(node.get("@id"))
    other = read.setdefault(place, name)
    references = [each for each in (name, other) if "references" in told.fields[each]]
    if other != name and references:
        told.say(name, f"reads what {other} reads, {place[1]} of {place[0]}: a join rewrites it")


def _file_property(node: Node) -> tuple[str, str] | None:
    source = node.get("source", {})
    wanted = source.get("extract", {}).get("fileProperty")
    return None if wanted is None else (str(source.get("fileSet", {}).get("@id")), str(wanted))


def _property(told: Descriptor, node: Node) -> None:
    place = _file_property(node)
    if place is None:
        return
    name = str(node.get("@id"))
    files, wanted = place
    if wanted not in _PROPERTIES:
        told.say(name, f"takes {wanted!r} of each file; there are {', '.join(_PROPERTIES)}")
    regex = node["source"].get("transform", {}).get("regex")
    paths = files_of_set(told, files)
    if regex is None or not paths or wanted not in {"fullpath", "filename"}:
        return
    if not _has_group(regex):
        return
    texts = [path if wanted == "fullpath" else path.rpartition("/")[2] for path in paths]
    missed = [text for text in texts if not re.match(regex, text)]
    if missed:
        told.say(name, f"takes {regex!r}, which does not match {missed[0]}")
    elif "references" in node and not _is_kept(regex, texts[0]):
        told.say(name, f"takes {regex!r}, which changes its own result: a join applies it twice")


def _has_group(regex: str) -> bool:
    try:
        return re.compile(regex).groups >= 1
    except re.error:
        return False


def _is_kept(regex: str, text: str) -> bool:
    """Return whether a regex leaves what it found as it is."""
    once = re.match(regex, text)
    again = None if once is None else re.match(regex, once[1])
    return once is not None and again is not None and again[1] == once[1]


def _values(told: Descriptor, node: Node, *, columns: dict[str, list[str]]) -> None:
    """Check that every value of a column that refers to another field is among its values."""
    target = told.fields.get(node.get("references", {}).get("field", {}).get("@id"))
    here = None if target is None else _column(told, node, columns=columns)
    if target is None or here is None:
        return
    name, meant = str(node.get("@id")), str(target.get("@id"))
    there = _inline(told, meant)
    if there is None:
        there = _column(told, target, columns=columns)
    strange = sorted(here - there) if there is not None else []
    if strange:
        told.say(name, f"has the value {strange[0]!r}, which {meant} has not")


def _column(told: Descriptor, node: Node, *, columns: dict[str, list[str]]) -> set[str] | None:
    """Return the texts in the column that a field reads, None where it is not at hand."""
    source = node.get("source", {})
    file = str(source.get("fileObject", {}).get("@id"))
    column = source.get("extract", {}).get("column")
    path = told.local(told.files[file]) if file in columns else None
    if path is None or column not in columns[file]:
        return None
    values: pa.ChunkedArray = pq.read_table(path, columns=[column]).column(0)
    return {str(value) for value in values.unique().to_pylist() if value not in (None, "")}


def _inline(told: Descriptor, name: str) -> set[str] | None:
    """Return a field's values in inline data, None where it has none."""
    for records in told.node.get("recordSet", []):
        rows: list[dict[str, Any]] = listed(records.get("data"))
        if rows and name in {str(each.get("@id")) for each in records.get("field", [])}:
            return {str(row.get(name)) for row in rows}
    return None
