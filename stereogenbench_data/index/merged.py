"""Files of a whole release below ``metadata/``: a record of each scene, in one request for all.

The paper names a merged JSONL of descriptions and scene manifests there, without their names and
keys. So a record is the scene's whose path it holds, or whose split, family, map and folder are all
among its values. A file counts only if it has one record of every scene, and who uses it compares
some scenes with their own files first.
"""

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath
from typing import Any, Final

from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import MissingObject

FOLDER: Final = "metadata"

_LARGEST_BYTES: Final = 64 * 2**20
_KINDS: Final = (".jsonl", ".json")
_PATH: Final = re.compile(r"(?:^|/)((?:train/[^/]+|eval/[^/]+/[^/]+)/[^/]+/[^/]+)(?:/|$)")


def merged_records(root: RemoteObject, keys: Sequence[str]) -> Iterator[dict[str, bytes]]:
    """Yield the records of each file that has one of every scene: key to a JSON object.

    Raises:
        StorageError: If the folder is there, and a file of it cannot be fetched.
    """
    folder = root.below(FOLDER)
    try:
        sizes = folder.entries()
    except MissingObject:
        return
    for name, size in sorted(sizes.items()):
        if size is None or size > _LARGEST_BYTES or PurePosixPath(name).suffix not in _KINDS:
            continue
        text = folder.below(name, expected_size=size).read(0, size)
        found: dict[str, bytes] = {}
        scenes = _Scenes(keys)
        try:
            for name_of_record, record in _records(text.decode("utf-8-sig"), name):
                key = scenes.key_of(record, name_of_record)
                if key in found:  # records of frames or pairs, or of another release, too
                    break
                if key is not None:
                    found[key] = json.dumps(record).encode()
            else:
                if len(found) == len(keys):
                    yield found
        except (ValueError, RecursionError):
            continue  # not a file of records: each scene's own files are read


def _records(text: str, name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the objects of a file, each with the name it stands under, if any."""
    if name.endswith(".jsonl"):
        document: Any = [json.loads(line) for line in text.splitlines() if line.strip()]
    else:
        document = json.loads(text)
    for node in (document, *(document.values() if isinstance(document, dict) else ())):
        listed = [("", each) for each in node] if isinstance(node, list) else []
        named = [*node.items()] if isinstance(node, dict) else listed
        if all(isinstance(record, dict) for _, record in named):
            yield from named


class _Scenes:
    """Finds the scene of a record."""

    def __init__(self, keys: Sequence[str]) -> None:
        self._keys = frozenset(keys)
        self._by_folder: dict[str, list[str]] = {}
        for key in keys:
            self._by_folder.setdefault(key.rpartition("/")[2], []).append(key)

    def key_of(self, record: dict[str, Any], name: str) -> str | None:
        """Return the key of the scene that a record is of, None if it tells none or several."""
        texts = {value for value in (name, *record.values()) if isinstance(value, str)}
        found = {match[1] for text in texts for match in _PATH.finditer(text)} & self._keys
        if not found:
            folders = texts & self._by_folder.keys()
            parts = ((key, key.split("/")) for name in folders for key in self._by_folder[name])
            found = {key for key, needed in parts if texts.issuperset(needed)}
        return found.pop() if len(found) == 1 else None
