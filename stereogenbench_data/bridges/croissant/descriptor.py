"""A Croissant 1.1 descriptor with RAI 1.0 properties, written from an index.

Its files and record sets are templates, one for each kind of data:

    shards.json     shards, with tables of scenes and pairs beside the descriptor
    folders.json    a git repository with scenes as folders, read from their JSON files
    release.json    the public release, whose record sets hold their data themselves
    common.json     the context and the enumerations of all three

A word such as ``@rgb@`` in a template is filled in here. A regex that takes the scene of a path
does not change a scene's key, because mlcroissant's joins apply it twice. Where mlcroissant 1.1
reads a narrower form than the specification allows, the narrower form is written. What a descriptor
says of the dataset as a whole is in `dataset_facts`.

Source: the Croissant 1.1 and RAI 1.0 specifications.
"""

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.bridges import dataset_facts
from stereogenbench_data.bridges.croissant.shards import (
    SHARD_LIST,
    WrittenTable,
    bound_shards,
    write_tables,
)
from stereogenbench_data.errors import DescriptorError, explain_os_errors
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import is_remote, shown

Node = dict[str, Any]

_HUB_FILE: Final = re.compile(r"(https?://[^/]+/datasets/[^/]+/[^/]+)/(?:resolve|tree|blob|raw)/")
"""A URL of files of a dataset on the Hub; the group is the dataset's page."""
_VERSION: Final = re.compile(r"\d+\.\d+\.\d+")
_MEDIA_TYPES: Final = {"mp4": "video/mp4", "mkv": "video/x-matroska"}
"""By suffix. Depth packed by blosc2 has no media type of its own."""
_TAR: Final = "application/x-tar"
_TABLES: Final = {
    "scenes.parquet": "One row a scene.",
    "pairs.parquet": "One row a camera pair, 15 a scene.",
    "shards.parquet": "One row a shard, with its checksum.",
    SHARD_LIST: "The paths of all shards, one a line.",
}


@dataclass(frozen=True, slots=True)
class Publication:
    """The name, version and URLs that a descriptor states.

    Attributes:
        name: The dataset's name; None for what its maker states.
        version: MAJOR.MINOR.PATCH; None for what its maker states, else 1.0.0.
        published: The day of publication; None for what its maker states, else today.
        data_url: URL of the folder of shards, pinned to a revision, or of the git repository of a
            tree. With None, shards have paths relative to the descriptor, and a tree of the
            release has the URL of the release's own repository.
        tables_url: URL of the folder of tables. None for the folder in ``data_url`` with the name
            of the descriptor, or for paths relative to the descriptor.
        about: What the user states of the scenes, as for `dataset_facts.facts_of`.
    """

    name: str | None = None
    version: str | None = None
    published: date | None = None
    data_url: str | None = None
    tables_url: str | None = None
    about: dataset_facts.About | None = None


def template(name: str, **words: str) -> Node:
    """Return a template of this folder, with words filled in."""
    text = Path(__file__).with_name(f"{name}.json").read_text(encoding="utf-8")
    for word, value in words.items():
        text = text.replace(f"@{word}@", value)
    node: Node = json.loads(text)
    return node


def write_descriptor(
    index: SceneIndex | None, path: Path, *, publication: Publication | None = None
) -> Node:
    """Write the descriptor of an index's data, and its tables beside it.

    Args:
        index: The index of shards, or of a tree in the released layout; None for the release in
            its own repository.
        path: The descriptor to write, such as ``croissant/sample.json``; the tables of shards are
            written into the folder of the same name without its suffix.
        publication: What it states about name, version and URLs.

    Returns:
        The descriptor as written.

    Raises:
        DescriptorError: If a file cannot be written, the version or a URL is not valid,
            ``data_url`` is None but shards are behind a URL or a tree is not the release's, a URL
            contains a login or a query, or who made the scenes is not known.
    """
    publication = publication or Publication()
    _require_valid(publication)
    facts = dataset_facts.facts_of(index, about=publication.about)
    if index is None:
        data_url = publication.data_url or facts["url"]
        files = template("release", repository=data_url)
    elif index.shards:
        data_url = publication.data_url or _relative(index.root, to=path.parent)
        beside = publication.data_url and f"{publication.data_url}/{path.stem}"
        tables_url = publication.tables_url or beside or path.stem
        tables = write_tables(index, path.with_suffix(""))
        files = _shard_nodes(index, tables, data_url=data_url, tables_url=tables_url)
        facts = facts | dataset_facts.packing_facts(index, facts)
    else:
        data_url = publication.data_url or facts.get("url", "")
        if not data_url:
            raise DescriptorError(
                f"{index.where}: folders of scenes are described as a git repository, so name its "
                "URL (--base-url). Or pack them: shards are described where they are."
            )
        files = _of_videos("folders", index, repository=data_url)
    head = _head(facts, publication, url=_page(data_url, beside=path))
    records = [*_enumerations(index), *files["recordSet"]]
    descriptor = head | {"distribution": files["distribution"], "recordSet": records}
    write_node(descriptor, path)
    return descriptor


def write_node(node: Mapping[str, Any], path: Path) -> None:
    """Write a JSON object as descriptors are written.

    Raises:
        DescriptorError: If the file cannot be written.
    """
    cannot = f"{path}: cannot be written"
    with explain_os_errors(cannot, "Choose another place with --out.", kind=DescriptorError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, (json.dumps(node, indent=1, ensure_ascii=False) + "\n").encode())


def _require_valid(publication: Publication) -> None:
    version = publication.version
    if version is not None and not _VERSION.fullmatch(version):
        raise DescriptorError(
            f"{version!r} is not a version: it must be MAJOR.MINOR.PATCH, such as 1.0.0."
        )
    for url in (publication.data_url, publication.tables_url):
        if url is not None and not is_remote(url):
            raise DescriptorError(
                f"{url!r} is not a URL, under which others find the data: give one such as "
                "https://HOST/PATH, or leave it out."
            )
        if url is not None and shown(url) != url:
            raise DescriptorError(
                f"{shown(url)}: the URL contains a login or a query, which must not be published. "
                f"Give the URL without them."
            )


def _of_videos(name: str, index: SceneIndex, **words: str) -> Node:
    """Return a template with the suffixes of the data's videos, without the kinds they lack."""
    held = index.scene(0).held_videos
    missing = set()
    for kind in ("rgb", "depth"):
        suffix = next((each.rpartition(".")[2] for each in held if f"_{kind}." in each), "")
        media_type = _MEDIA_TYPES.get(suffix, "application/octet-stream") if suffix else ""
        words |= {kind: suffix, f"{kind}_type": media_type}
        if not suffix:
            missing |= {f"{kind}-files", f"{kind}_videos"}
    nodes = template(name, **words)
    for files in nodes["distribution"]:
        if isinstance(files["encodingFormat"], list):
            files["encodingFormat"] = [each for each in files["encodingFormat"] if each]
    return {
        part: [each for each in found if each["@id"] not in missing]
        for part, found in nodes.items()
    }


def _shard_nodes(
    index: SceneIndex, tables: Sequence[WrittenTable], *, data_url: str, tables_url: str
) -> Node:
    """Return the files and record sets of shards."""
    nodes = _of_videos("shards", index)
    bound = bound_shards(index)
    is_listed = any(table.name == SHARD_LIST for table in tables)
    files = []
    for table in tables:
        kind = "text/plain" if table.name == SHARD_LIST else "application/x-parquet"
        about = {"description": _TABLES[table.name]}
        place = f"{tables_url}/{table.name}"
        files.append(_file(table.name, place, kind, table.sha256, table.size, about))
    for shard in bound if is_listed else sorted(index.shards):
        facts = index.shards[shard]
        files.append(_file(shard, f"{data_url}/{shard}", _TAR, facts.sha256, facts.size, {}))
    contained: Any = [{"@id": each} for each in bound]
    for each in nodes["distribution"]:
        if each["containedIn"] == []:
            each["containedIn"] = contained if len(bound) != 1 else contained[0]
        if each["@id"] != "shard-files" or is_listed:
            files.append(each)
    return {"distribution": files, "recordSet": nodes["recordSet"]}


def _file(name: str, url: str, kind: str, sha256: str, size: int, about: Mapping[str, str]) -> Node:
    node: Node = {"@type": "cr:FileObject", "@id": name, "name": name, **about}
    node |= {"contentSize": f"{size} B", "contentUrl": url}
    return node | {"encodingFormat": kind, "sha256": sha256}


def _enumerations(index: SceneIndex | None) -> list[Node]:
    """Return the record sets of all splits, subsets, families and maps; the release's for None."""
    nodes: list[Node] = template("common")["recordSet"]
    if index is None:
        return nodes
    train = set(index.column("map_name")[index.column("split") == "train"])
    maps = sorted(set(index.column("map_name")))
    _, _, families, places = nodes
    known = {row["families/name"]: row["families/meaning"] for row in families["data"]}
    families["data"] = [
        {"families/name": name, "families/meaning": known.get(name, "A family of its own.")}
        for name in sorted(set(index.column("family")))
    ]
    places["data"] = [
        {"maps/name": name, "maps/meaning": "in train" if name in train else "in eval alone"}
        for name in maps
    ]
    return nodes


def _page(data_url: str, *, beside: Path) -> str:
    """Return the page of data: on the Hub, or their README.md if they are local."""
    found = _HUB_FILE.match(f"{data_url}/")
    if found:
        return found[1]
    readme = f"{data_url}/README.md"
    return readme if "://" not in data_url and (beside.parent / readme).is_file() else data_url


def _relative(root: str, *, to: Path) -> str:
    if "://" in root:
        raise DescriptorError(
            f"{shown(root)}: the shards are behind a URL, so paths cannot be relative. Give their "
            "URL for the descriptor, pinned to a revision (--base-url)."
        )
    return Path(os.path.relpath(root, to)).as_posix()


def _head(facts: Mapping[str, Any], publication: Publication, *, url: str) -> Node:
    """Return the properties of the dataset as a whole, in the order in which people read them."""
    head = template("common")
    del head["recordSet"]
    published = publication.published or facts.get("datePublished", datetime.now(UTC).date())
    head |= {
        "name": publication.name or facts["name"],
        "description": facts["description"],
        "url": url,
        "license": facts["license"],
        "usageInfo": facts["usageInfo"],
        "version": publication.version or facts.get("version", "1.0.0"),
        "datePublished": str(published),
    }
    rest = {name: value for name, value in facts.items() if name not in head}
    return head | rest | {"inLanguage": facts.get("inLanguage", "en")}
