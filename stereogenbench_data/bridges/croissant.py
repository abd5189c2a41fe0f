"""A Croissant 1.1 descriptor with RAI 1.0 properties, made from an index.

Shards are files with their checksums, and their scenes and pairs are read from small tables beside
the descriptor. A tree in the released layout is a repository, whose scenes and pairs are read from
its JSON files.

Source: the Croissant 1.1 and RAI 1.0 specifications.
"""

import json
import os
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

from stereogenbench_data.bridges import about
from stereogenbench_data.bridges.croissant_folders import folder_nodes
from stereogenbench_data.bridges.croissant_packed import packed_nodes
from stereogenbench_data.bridges.croissant_tables import write_tables
from stereogenbench_data.bridges.croissant_terms import CONTEXT, CROISSANT, RAI, Node
from stereogenbench_data.errors import DescriptorError, cure_of
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import shown


@dataclass(frozen=True, slots=True)
class Publication:
    """Where a descriptor's files will be found, and what it says of its release.

    Attributes:
        name: The dataset's name.
        version: MAJOR.MINOR.PATCH.
        published: The day of publication; None for today.
        data_url: URL of the folder of shards, pinned to a revision, or of the repository of
            folders. None for the paths of shards relative to the descriptor, or for the release's
            own repository.
        tables_url: URL of the tables' folder; None for ``data_url``'s folder named as the
            descriptor, or for paths relative to it.
    """

    name: str = about.TITLE
    version: str = about.VERSION
    published: date | None = None
    data_url: str | None = None
    tables_url: str | None = None


def write_descriptor(
    index: SceneIndex | None, path: Path, *, publication: Publication | None = None
) -> dict[str, Any]:
    """Write the descriptor of an index's data, and the tables that it reads beside it.

    Args:
        index: Of shards, or of a tree in the released layout; None for the release as it stands in
            its own repository.
        path: The descriptor to write, such as ``croissant/sample.json``; the tables of shards are
            written into the folder of the same name without its suffix.
        publication: Where its files will be found.

    Returns:
        The descriptor as written.

    Raises:
        DescriptorError: If something cannot be written, shards lie behind a URL while no
            ``data_url`` is given, or such a URL holds a login or a query.
    """
    told = publication or Publication()
    for url in (told.data_url, told.tables_url):
        if url is not None and shown(url) != url:
            raise DescriptorError(
                f"{shown(url)}: the URL has a login or a query, which no descriptor shall publish: "
                f"give the plain URL."
            )
    if index is not None and index.shards:
        data_url = told.data_url or _relative(index.root, to=path.parent)
        beside = path.stem if told.data_url is None else f"{told.data_url}/{path.stem}"
        files, records = packed_nodes(
            index,
            write_tables(index, path.with_suffix("")),
            data_url=data_url,
            tables_url=told.tables_url or beside,
        )
    else:
        data_url = told.data_url or about.HOME
        files, records = folder_nodes(index, repository_url=data_url)
    descriptor = _head(told, url=data_url) | {"distribution": files, "recordSet": records}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(descriptor, indent=1, ensure_ascii=False) + "\n"
        write_atomic(path, text.encode())
    except OSError as error:
        raise DescriptorError(
            f"{path}: cannot be written ({error.strerror or error}). "
            + cure_of(error, "Choose another place with --out.")
        ) from error
    return descriptor


def _relative(root: str, *, to: Path) -> str:
    if "://" in root:
        raise DescriptorError(
            f"{shown(root)}: the shards lie behind a URL: give the URL that the descriptor shall "
            "name, pinned to a revision (--base-url)."
        )
    return Path(os.path.relpath(root, to)).as_posix()


def _head(publication: Publication, *, url: str) -> Node:
    """Return what a descriptor says of the dataset as a whole."""
    published = publication.published or datetime.now(UTC).date()
    organisation = {"@type": "sc:Organization", "name": about.AFFILIATION}
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, RAI],
        "name": publication.name,
        "description": about.DESCRIPTION,
        "url": url if "://" in url else about.HOME,
        "license": about.DATA_LICENCE,
        "usageInfo": about.LICENCE_NOTE,
        "version": publication.version,
        "datePublished": published.isoformat(),
        "citeAs": about.CITATION,
        "keywords": list(about.KEYWORDS),
        "creator": [
            {"@type": "sc:Person", "name": author, "affiliation": organisation}
            for author in about.AUTHORS
        ],
        "inLanguage": "en",
        **about.RESPONSIBLE_USE,
        **about.PROVENANCE,
    }
