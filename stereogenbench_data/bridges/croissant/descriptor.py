"""A Croissant 1.1 descriptor with RAI 1.0 properties, written from an index.

It describes either shards or a tree in the released layout. Shards are files with checksums, and
small tables beside the descriptor hold their scenes and pairs (`shards`). A tree is a repository,
and its JSON files hold its scenes and pairs (`folders`).

Source: the Croissant 1.1 and RAI 1.0 specifications.
"""

import json
import os
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

from stereogenbench_data.bridges import dataset_facts
from stereogenbench_data.bridges.croissant.folders import folder_nodes
from stereogenbench_data.bridges.croissant.nodes import CONTEXT, CROISSANT, RAI, Node
from stereogenbench_data.bridges.croissant.shards import packed_nodes, write_tables
from stereogenbench_data.errors import DescriptorError, describe_os_error
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.shards.companion_files import derivation_facts
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import shown


@dataclass(frozen=True, slots=True)
class Publication:
    """The name, version and URLs that a descriptor states.

    Attributes:
        name: The dataset's name.
        version: MAJOR.MINOR.PATCH.
        published: The day of publication; None for today.
        data_url: URL of the folder of shards, pinned to a revision, or of the repository of a
            tree. With None, shards have paths relative to the descriptor, and a tree has the URL
            of the release's own repository.
        tables_url: URL of the folder of tables. None for the folder in ``data_url`` with the name
            of the descriptor, or for paths relative to the descriptor.
    """

    name: str = dataset_facts.TITLE
    version: str = dataset_facts.VERSION
    published: date | None = None
    data_url: str | None = None
    tables_url: str | None = None


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
        DescriptorError: If a file cannot be written, the shards are behind a URL and ``data_url``
            is None, or a URL contains a login or a query.
    """
    publication = publication or Publication()
    for url in (publication.data_url, publication.tables_url):
        if url is not None and shown(url) != url:
            raise DescriptorError(
                f"{shown(url)}: the URL contains a login or a query, which must not be published. "
                f"Give the URL without them."
            )
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
    else:
        data_url = publication.data_url or dataset_facts.HOME
        files, records = folder_nodes(index, repository_url=data_url)
    descriptor = _head(publication, url=data_url) | {"distribution": files, "recordSet": records}
    if index is not None and index.is_derived:
        descriptor |= _derived(index)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(descriptor, indent=1, ensure_ascii=False) + "\n"
        write_atomic(path, text.encode())
    except OSError as error:
        raise DescriptorError(
            describe_os_error(
                f"{path}: cannot be written", error, "Choose another place with --out."
            )
        ) from error
    return descriptor


def _derived(index: SceneIndex) -> Node:
    """Return what the descriptor of training shards says instead: from what, how, what error."""
    facts = derivation_facts(index)
    psnr_db = facts["psnr_db"]
    encoding = {
        "@type": "prov:Activity",
        "prov:type": {"@id": "https://www.wikidata.org/wiki/Q1172378"},
        "prov:label": "Derivation for training",
        "description": (
            f"Pictures scaled to {facts['size']} and encoded by {facts['codec']} (quality "
            f"{facts['quality']}, settings {json.dumps(facts['settings'], sort_keys=True)}), PSNR "
            f"{psnr_db['mean']:.2f} dB on average and {psnr_db['worst_frame']:.2f} dB in the worst "
            f"frame; depth of the nearest pixels, by blosc2 without loss."
        ),
    }
    source = {
        "@type": "prov:Entity",
        "prov:label": dataset_facts.TITLE,
        "description": f"The release, with the index {facts['source_digest']}.",
    }
    return {
        "description": f"{dataset_facts.DESCRIPTION} {dataset_facts.DERIVED}",
        "prov:wasGeneratedBy": [*dataset_facts.PROVENANCE["prov:wasGeneratedBy"], encoding],
        "prov:wasDerivedFrom": [*dataset_facts.PROVENANCE["prov:wasDerivedFrom"], source],
    }


def _relative(root: str, *, to: Path) -> str:
    if "://" in root:
        raise DescriptorError(
            f"{shown(root)}: the shards are behind a URL, so paths cannot be relative. Give their "
            "URL for the descriptor, pinned to a revision (--base-url)."
        )
    return Path(os.path.relpath(root, to)).as_posix()


def _head(publication: Publication, *, url: str) -> Node:
    """Return the properties of the dataset as a whole."""
    published = publication.published or datetime.now(UTC).date()
    organisation = {"@type": "sc:Organization", "name": dataset_facts.AFFILIATION}
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, RAI],
        "name": publication.name,
        "description": dataset_facts.DESCRIPTION,
        "url": url if "://" in url else dataset_facts.HOME,
        "license": dataset_facts.DATA_LICENCE,
        "usageInfo": dataset_facts.LICENCE_NOTE,
        "version": publication.version,
        "datePublished": published.isoformat(),
        "citeAs": dataset_facts.CITATION,
        "keywords": list(dataset_facts.KEYWORDS),
        "creator": [
            {"@type": "sc:Person", "name": author, "affiliation": organisation}
            for author in dataset_facts.AUTHORS
        ],
        "inLanguage": "en",
        **dataset_facts.RESPONSIBLE_USE,
        **dataset_facts.PROVENANCE,
    }
