"""A Croissant 1.1 descriptor with RAI 1.0 properties, written from an index.

It describes either shards or a tree in the released layout. Shards are files with checksums, and
small tables beside the descriptor hold their scenes and pairs (`shards`). A tree is a repository,
and its JSON files hold its scenes and pairs (`folders`). What it says of the dataset as a whole is
in `dataset_facts`.

Source: the Croissant 1.1 and RAI 1.0 specifications.
"""

import json
import os
import re
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.bridges import dataset_facts
from stereogenbench_data.bridges.croissant.folders import folder_nodes, release_nodes
from stereogenbench_data.bridges.croissant.nodes import (
    CONTEXT,
    CROISSANT,
    RAI,
    VERSION,
    Node,
    suffixes_of,
)
from stereogenbench_data.bridges.croissant.shards import packed_nodes, write_tables
from stereogenbench_data.errors import DescriptorError, describe_os_error
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import is_remote, shown

_HUB_FILE: Final = re.compile(r"(https?://[^/]+/datasets/[^/]+/[^/]+)/(?:resolve|tree|blob|raw)/")
"""A URL of files of a dataset on the Hub; the group is the dataset's page."""
_FIRST_VERSION: Final = "1.0.0"


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


def write_descriptor(
    index: SceneIndex | None, path: Path, *, publication: Publication | None = None
) -> dict[str, Any]:
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
        DescriptorError: If a file cannot be written, the version or a URL is none, ``data_url``
            is None but shards are behind a URL or a tree is not the release's, a URL contains a
            login or a query, or who made the scenes is not known.
    """
    publication = publication or Publication()
    if publication.version is not None and not VERSION.fullmatch(publication.version):
        raise DescriptorError(
            f"{publication.version!r} is not a version: it must be MAJOR.MINOR.PATCH, such as "
            "1.0.0."
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
    facts = dataset_facts.facts_of(index, about=publication.about)
    if index is not None and index.shards:
        data_url = publication.data_url or _relative(index.root, to=path.parent)
        beside = (
            path.stem if publication.data_url is None else f"{publication.data_url}/{path.stem}"
        )
        files, records = packed_nodes(
            index,
            write_tables(index, path.with_suffix("")),
            data_url=data_url,
            tables_url=publication.tables_url or beside,
        )
    elif index is not None:
        data_url = publication.data_url or facts.get("url", "")
        if not data_url:
            raise DescriptorError(
                f"{index.where}: folders of scenes are described as a git repository, so name its "
                "URL (--base-url). Or pack them: shards are described where they are."
            )
        files, records = folder_nodes(index, repository_url=data_url)
    else:
        data_url = publication.data_url or dataset_facts.HOME
        files, records = release_nodes(repository_url=data_url)
    if index is not None and index.is_derived:
        facts = facts | _derived(index, facts)
    elif index is not None and index.shards:
        facts = facts | _packed(index, facts)
    head = _head(facts, publication, url=_page(data_url, beside=path))
    descriptor = head | {"distribution": files, "recordSet": records}
    write_node(descriptor, path)
    return descriptor


def write_node(node: Node, path: Path) -> None:
    """Write a JSON object as descriptors are written.

    Raises:
        DescriptorError: If the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(node, indent=1, ensure_ascii=False) + "\n"
        write_atomic(path, text.encode())
    except OSError as error:
        raise DescriptorError(
            describe_os_error(
                f"{path}: cannot be written", error, "Choose another place with --out."
            )
        ) from error


def _page(data_url: str, *, beside: Path) -> str:
    """Return the page of data: on the Hub, or their README.md if they are local."""
    found = _HUB_FILE.match(f"{data_url}/")
    if found:
        return found[1]
    readme = f"{data_url}/README.md"
    return readme if "://" not in data_url and (beside.parent / readme).is_file() else data_url


def _packed(index: SceneIndex, facts: Node) -> Node:
    """Return the provenance of packed shards."""
    depth = (
        ", depth packed by blosc2 without loss" if "b2frame" in suffixes_of(index).values() else ""
    )
    packing = dataset_facts.activity(
        "Packing",
        f"Files of the scenes put into WebDataset shards, unchanged{depth}.",
        by="stereogenbench pack",
    )
    return {"prov:wasGeneratedBy": [*dataset_facts.listed(facts["prov:wasGeneratedBy"]), packing]}


def _derived(index: SceneIndex, facts: Node) -> Node:
    """Return what the descriptor of training shards says instead: from what, how, what error."""
    derived = dataset_facts.derivation_facts(index)
    psnr_db, settings = derived["psnr_db"], json.dumps(derived["settings"], sort_keys=True)
    encoding = dataset_facts.activity(
        "Derivation for training",
        f"Pictures scaled to {derived['size']} and encoded by {derived['codec']} (quality "
        f"{derived['quality']}, settings {settings}), PSNR "
        f"{psnr_db['mean']:.2f} dB on average and {psnr_db['worst_frame']:.2f} dB in the worst "
        f"frame; depth of the nearest pixels, by blosc2 without loss.",
        by="stereogenbench pack --size",
    )
    source = dataset_facts.entity(
        facts["name"], f"The scenes with the index {derived['source_digest']}."
    )
    return {
        "description": f"{facts['description']} {dataset_facts.DERIVED}",
        "prov:wasGeneratedBy": [*dataset_facts.listed(facts["prov:wasGeneratedBy"]), encoding],
        "prov:wasDerivedFrom": [*dataset_facts.listed(facts["prov:wasDerivedFrom"]), source],
    }


def _relative(root: str, *, to: Path) -> str:
    if "://" in root:
        raise DescriptorError(
            f"{shown(root)}: the shards are behind a URL, so paths cannot be relative. Give their "
            "URL for the descriptor, pinned to a revision (--base-url)."
        )
    return Path(os.path.relpath(root, to)).as_posix()


def _head(facts: Node, publication: Publication, *, url: str) -> Node:
    """Return the properties of the dataset as a whole, in the order in which people read them."""
    stated = dict(facts)
    published = publication.published or stated.pop("datePublished", datetime.now(UTC).date())
    head = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, RAI],
        "name": publication.name or stated["name"],
        "description": stated.pop("description"),
        "url": url,
        "license": stated.pop("license"),
        "usageInfo": stated.pop("usageInfo"),
        "version": publication.version or stated.pop("version", _FIRST_VERSION),
        "datePublished": str(published),
    }
    return (
        head
        | {name: value for name, value in stated.items() if name not in head}
        | {"inLanguage": stated.get("inLanguage", "en")}
    )
