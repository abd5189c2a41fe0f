"""The words of Croissant 1.1: its context, and a function for each kind of node.

Nodes are plain dicts in the order in which they are written. Sources: the Croissant 1.1 and RAI 1.0
specifications; where mlcroissant 1.1 reads a narrower form than the specification allows
(references by ``field``, ``https`` schema.org), the narrower form is written.
"""

from typing import Any, Final

Node = dict[str, Any]

CROISSANT: Final = "http://mlcommons.org/croissant/1.1"
RAI: Final = "http://mlcommons.org/croissant/RAI/1.0"

CONTEXT: Final[Node] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "prov": "http://www.w3.org/ns/prov#",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "readLines": "cr:readLines",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
    "unArchive": "cr:unArchive",
}

TAR: Final = "application/x-tar"
PARQUET: Final = "application/x-parquet"
GIT: Final = "git+https"
TEXT: Final = "text/plain"

GIT_CHECKSUM: Final = "https://github.com/mlcommons/croissant/issues/80"
"""What stands for the checksum of a git repository, which has none, by common practice."""


def file_object(
    name: str, *, url: str, encoding: str, sha256: str, size: int | None = None, about: str = ""
) -> Node:
    """Return a file, by its relative path or URL."""
    node: Node = {"@type": "cr:FileObject", "@id": name, "name": name}
    if about:
        node["description"] = about
    if size is not None:
        node["contentSize"] = f"{size} B"
    return node | {"contentUrl": url, "encodingFormat": encoding, "sha256": sha256}


def file_set(
    name: str,
    *,
    within: list[str],
    encoding: str | list[str],
    includes: str | list[str],
    about: str,
) -> Node:
    """Return the files inside others (tars, a repository) that match a pattern."""
    contained: Any = [{"@id": each} for each in within]
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "description": about,
        "containedIn": contained if len(contained) != 1 else contained[0],
        "encodingFormat": encoding,
        "includes": includes,
    }


def field(name: str, kind: str | list[str], about: str, **more: Any) -> Node:
    """Return a field of a record set; its id is the set's name, a slash and its own name."""
    node: Node = {"@type": "cr:Field", "@id": name, "name": name.rpartition("/")[2]}
    return node | {"description": about, "dataType": kind} | more


def column(file: str, name: str) -> Node:
    """Return the source of a field that is a column of a table."""
    return {"source": {"fileObject": {"@id": file}, "extract": {"column": name}}}


def of_file(files: str, what: str, *, regex: str | None = None) -> Node:
    """Return the source of a field that is a property of each file, or a part of it.

    Args:
        files: Id of the set of files.
        what: "fullpath", "filename" or "content".
        regex: Of which the first group is taken.
    """
    source: Node = {"fileSet": {"@id": files}, "extract": {"fileProperty": what}}
    if regex is not None:
        source["transform"] = {"regex": regex}
    return {"source": source}


def refers_to(name: str) -> Node:
    """Return the reference of a field to another record set's field."""
    return {"references": {"field": {"@id": name}}}


def record_set(name: str, about: str, fields: list[Node], **more: Any) -> Node:
    """Return a record set."""
    head: Node = {"@type": "cr:RecordSet", "@id": name, "name": name, "description": about}
    return head | more | {"field": fields}


def enumeration(name: str, about: str, values: dict[str, str], *, kind: str) -> Node:
    """Return a record set that names all values there are, each with what it means."""
    key, meaning = f"{name}/name", f"{name}/meaning"
    fields = [
        field(key, "sc:Text", "The value as it stands in the data."),
        field(meaning, "sc:Text", "What it means."),
    ]
    data = [{key: value, meaning: means} for value, means in values.items()]
    return record_set(name, about, fields, dataType=kind, key={"@id": key}, data=data)
