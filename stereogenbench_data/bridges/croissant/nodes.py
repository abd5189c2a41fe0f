"""The parts of a Croissant 1.1 descriptor: context, kinds of nodes, record sets of both layouts.

Nodes are plain dicts; their keys are in the order in which they are written. Where mlcroissant 1.1
reads a narrower form than the specification allows (references by ``field``, ``https`` schema.org),
the narrower form is written.

Source: the Croissant 1.1 and RAI 1.0 specifications.
"""

import re
from typing import Any, Final

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    COMPLETE_JSON,
    FAMILIES,
    TRAIN_MAPS,
    TRAJECTORY_JSON,
    UNSEEN_MAPS,
)

Node = dict[str, Any]

CROISSANT: Final = "http://mlcommons.org/croissant/1.1"
RAI: Final = "http://mlcommons.org/croissant/RAI/1.0"

_OTHER_TERMS: Final[Node] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "prov": "http://www.w3.org/ns/prov#",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
}
_CROISSANT_TERMS: Final = (
    "arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field",
    "fileObject", "fileProperty", "fileSet", "format", "includes", "isArray", "isLiveDataset",
    "jsonPath", "key", "md5", "parentField", "path", "readLines", "recordSet", "references",
    "regex", "repeated", "replace", "samplingRate", "separator", "source", "subField",
    "transform", "unArchive",
)  # fmt: skip
CONTEXT: Final[Node] = dict(
    sorted((_OTHER_TERMS | {term: f"cr:{term}" for term in _CROISSANT_TERMS}).items())
)
"""The terms of a descriptor, in alphabetical order."""

TAR: Final = "application/x-tar"
VERSION: Final = re.compile(r"\d+\.\d+\.\d+")
"""The form of a dataset's version: MAJOR.MINOR.PATCH."""
PARQUET: Final = "application/x-parquet"
GIT: Final = "git+https"
TEXT: Final = "text/plain"

SPLIT_URLS: Final = {"train": "cr:TrainingSplit", "eval": "cr:TestSplit"}
"""The roles of splits, as the specification writes them."""

GIT_CHECKSUM: Final = "https://github.com/mlcommons/croissant/issues/80"
"""The checksum of a git repository, by common practice: it has none of its own."""

RELEASED_SUFFIXES: Final = {"rgb": "mp4", "depth": "mkv"}
ENCODINGS: Final = {"mp4": "video/mp4", "mkv": "video/x-matroska"}
"""The media type of videos by suffix. Depth packed by blosc2 has no media type of its own."""
UNKNOWN_ENCODING: Final = "application/octet-stream"

TEXT_FILES = {
    "baseline": (BASELINE_JSON, "Intrinsics and baselines"),
    "trajectory": (TRAJECTORY_JSON, "Poses"),
    "scene_complete": (COMPLETE_JSON, "Marks of completion"),
}
VIDEO_TEXTS: Final = {"rgb": "RGB videos.", "depth": "Depth videos."}
_FAMILIES: Final = {
    "IPD_Gaussian": "Adjacent cameras about 6.4 cm apart, as human eyes are.",
    "Uniform": "Adjacent cameras 1 to 150 cm apart, evenly.",
    "Pairwise_Uniform": "All pairs up to 200 cm apart; in train alone.",
}


def file_object(
    name: str, *, url: str, encoding: str, sha256: str, size: int | None = None, about: str = ""
) -> Node:
    """Return a file at a relative path or URL."""
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
    """Return the set of files in containers (tars, a repository) that match a pattern."""
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
    """Return a field of a record set. Its id is ``SET/FIELD``."""
    node: Node = {"@type": "cr:Field", "@id": name, "name": name.rpartition("/")[2]}
    return node | {"description": about, "dataType": kind} | more


def column(file: str, name: str) -> Node:
    """Return the source of a field: a column of a table."""
    return {"source": {"fileObject": {"@id": file}, "extract": {"column": name}}}


def of_file(files: str, what: str, *, regex: str | None = None) -> Node:
    """Return the source of a field: a property of each file, or a part of it.

    Args:
        files: Id of the set of files.
        what: "fullpath", "filename" or "content".
        regex: The field is its first group.
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


def enumeration(name: str, about: str, values: dict[str, str]) -> Node:
    """Return a record set of all values with their meanings."""
    key, meaning = f"{name}/name", f"{name}/meaning"
    fields = [
        field(key, "sc:Text", "The value as it stands in the data."),
        field(meaning, "sc:Text", "What it means."),
    ]
    data = [{key: value, meaning: means} for value, means in values.items()]
    kind = "sc:Enumeration"
    return record_set(name, about, fields, dataType=kind, key={"@id": key}, data=data)


def _splits() -> Node:
    """Return the record set of the splits, with the specification's URLs of their roles."""
    node = enumeration(
        "splits", "Parts of the dataset.",
        {"train": "For training.", "eval": "For evaluation; no scene of it is in train."},
    )  # fmt: skip
    url = field("splits/url", ["sc:URL", "cr:Split"], "The role of the split in Croissant's terms.")
    node |= {"dataType": "cr:Split", "field": [*node["field"], url]}
    for row in node["data"]:
        row["splits/url"] = SPLIT_URLS[row["splits/name"]]
    return node


def enumerations(index: SceneIndex | None) -> list[Node]:
    """Return the record sets of all splits, subsets, families and maps.

    Args:
        index: The data; None for the release as the paper lists it.
    """
    if index is None:
        families, train = list(FAMILIES), set(TRAIN_MAPS)
        maps = sorted(TRAIN_MAPS | UNSEEN_MAPS)
    else:
        families = sorted(set(index.column("family")))
        maps = sorted(set(index.column("map_name")))
        train = set(index.column("map_name")[index.column("split") == "train"])
    return [
        _splits(),
        enumeration(
            "eval_subsets", "Parts of eval.", {
                "seen_map": "On maps that train has scenes of.",
                "unseen_map": "On maps that train has no scene of.",
            },
        ),
        enumeration(
            "families", "How the distances between cameras are drawn.",
            {name: _FAMILIES.get(name, "A family of its own.") for name in families},
        ),
        enumeration(
            "maps", "The environments of the scenes.",
            {name: "in train" if name in train else "in eval alone" for name in maps},
        ),
    ]  # fmt: skip


def suffixes_of(index: SceneIndex | None) -> dict[str, str]:
    """Return the file suffix of each kind of video, "rgb" and "depth", that the data have.

    A part of the release may have only one kind, and depth may be packed.

    Args:
        index: The data; None for the release.
    """
    if index is None:
        return dict(RELEASED_SUFFIXES)
    names = index.scene(0).held_videos
    ends = {kind: [name for name in names if f"_{kind}." in name] for kind in RELEASED_SUFFIXES}
    return {kind: found[0].rpartition(".")[2] for kind, found in ends.items() if found}


def video_records(kind: str, *, key: str) -> Node:
    """Return the record set of all "rgb" or "depth" videos, joined to their scenes.

    Args:
        kind: "rgb" or "depth"; the files are those of the set ``rgb-files`` or ``depth-files``.
        key: Regex whose first group is the scene of a path. A join applies it twice, so it must
            not change a scene's key; and no other field may read the path.
    """
    name, files = f"{kind}_videos", f"{kind}-files"
    camera = rf"^.*?cam_(\d{{2}})_{kind}\.\w+$"
    return record_set(
        name, f"Every {kind} video, joined to its scene.", [
            field(
                f"{name}/scene_id", "sc:Text", "Path of the scene.",
                **of_file(files, "fullpath", regex=key), **refers_to("scenes/scene_id"),
            ),
            field(
                f"{name}/camera", "sc:Integer", "Number of the camera.",
                **of_file(files, "filename", regex=camera),
            ),
            field(f"{name}/content", "sc:VideoObject", "The file.", **of_file(files, "content")),
        ],
    )  # fmt: skip


def text_records(*, scene_of: str) -> list[Node]:
    """Return the record sets of all JSON files as text.

    Args:
        scene_of: Regex whose first group is the scene of a path, with ``{file}`` where the file's
            name belongs.
    """
    return [
        record_set(
            f"{name}_json", f"{about}, one a scene, as text.", [
                field(
                    f"{name}_json/scene_id", "sc:Text", "Path of the scene.",
                    **of_file(
                        f"{name}-files", "fullpath",
                        regex=scene_of.format(file=file.replace(".", r"\.")),
                    ),
                ),
                field(
                    f"{name}_json/content", "sc:Text", "The file.",
                    **of_file(f"{name}-files", "content"),
                ),
            ],
        )
        for name, (file, about) in TEXT_FILES.items()
    ]  # fmt: skip
