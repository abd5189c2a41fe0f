"""Captions of all scenes in one file of JSON lines, as the merged summary that the paper names.

The paper gives neither its name nor its keys, so the user names the file and two places in it.
"""

from pathlib import Path

from stereogenbench_data.errors import SchemaError, explain_os_errors
from stereogenbench_data.index.tree import SPLITS
from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.places import value_at
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.sources.location import is_remote, shown
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy


def captions_of_file(
    root: str | Path, file: str, *, scene: str, caption: str, retry: RetryPolicy | None
) -> dict[str, str]:
    """Return the captions that a file of JSON lines has, by the keys of their scenes.

    Args:
        root: The folder or URL of the data.
        file: The file's path below it.
        scene: The place of the scene's path in a record, such as ``$.scene``.
        caption: The place of the caption.
        retry: How slow a server may be.

    Raises:
        StorageError: If the file cannot be read.
        SchemaError: If a line is no JSON object, or lacks one of the two texts.
    """
    if is_remote(root):
        remote = RemoteObject(str(root), retry=retry).below(file)
        text = remote.read(0, remote.size())
    else:
        with explain_os_errors(f"{Path(root, file)}: cannot be read"):
            text = Path(root, file).read_bytes()
    found: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        where = f"{shown(root)}/{file}, line {number}"
        if not line.strip():
            continue
        record = parse_object(line, where=where)
        values = []
        for place in (scene, caption):
            try:
                value = value_at(record, place)
            except LookupError:
                value = None
            if not isinstance(value, str):
                listed = ", ".join(record)
                raise SchemaError(
                    f"{where}: has no text at {place}; it has {shortened(listed, 200)}. Name the "
                    f"places of the scene's path and of the caption."
                )
            values.append(value)
        found[key_in(values[0])] = values[1]
    return found


def key_in(path: str) -> str:
    """Return the part of a path that is a scene's key, or the path if none is.

    >>> key_in("/data/train/Uniform/Town/scene_000001/"), key_in("scene_000001")
    ('train/Uniform/Town/scene_000001', 'scene_000001')
    """
    parts = path.strip("/").split("/")
    for split, depth in SPLITS.items():
        if len(parts) >= depth and parts[-depth] == split:
            return "/".join(parts[-depth:])
    return path
