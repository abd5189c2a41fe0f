"""Tars, folders of shards and their damage, for tests."""

import os
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.shards.tar import END_OF_ARCHIVE, member_header, padded


def tar_of(members):
    """A tar by our own headers, of (name, content) each."""
    blocks = [
        member_header(name, len(content)) + content + bytes(padded(len(content)) - len(content))
        for name, content in members
    ]
    return b"".join(blocks) + END_OF_ARCHIVE


def bytes_of(folder: Path) -> dict[str, str]:
    """What is public in a folder: name to sha256."""
    return {
        path.relative_to(folder).as_posix(): sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not {".parts", ".generation"} & set(path.parts)
    }


def scenes_of(root: Path) -> dict[str, Scene]:
    """The scenes of an index, by key."""
    index = SceneIndex.open(root)
    return {scene.id.key: scene for scene in map(index.scene, range(len(index)))}


def flip_byte(path: Path, at: int | None = None) -> bytes:
    """Change a byte of a file, by default in its middle; its modification time changes, too."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2 if at is None else at] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 10**9))
    return bytes(content)


def alter_scene(folder: Path, key: str, change: Callable[[Scene], dict[str, Any]]) -> None:
    """Write the index of shards again with other values of a scene."""
    index, scenes = SceneIndex.open(folder), scenes_of(folder)
    scenes[key] = replace(scenes[key], **change(scenes[key]))
    altered = SceneIndex.from_scenes(scenes.values(), folder, shards=index.shards)
    altered.write(folder / "index.parquet")
