"""Whether a finished shard still is what packing it now would give: if not, that is an error.

Files that have gone since contradict nothing.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError, cure_of
from stereogenbench_data.index.scene_folder import metadata_differences
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import METADATA_FILES
from stereogenbench_data.shards.manifest import SeenFile, ShardNote, ShardTask, row_digest

_CHUNK_BYTES: Final = 4 * 1024 * 1024


def require_same_sources(task: ShardTask, note: ShardNote) -> None:
    """Refuse to keep a finished shard if the files that it was made from are others now.

    Metadata files are read, of videos the size and the time of change are looked at; where these
    differ they are read too.

    Raises:
        ShardError: Naming the first such file, and what to do.
    """
    for member, seen, _ in note.members(task):
        key, _, name = member.name.partition(".")
        found = _seen_now(Path(task.root, member.source), seen, is_text=name in METADATA_FILES)
        if found is not None and found != (seen.size, seen.crc32):
            raise ShardError(
                f"{key}: its {member.source.rpartition('/')[2]} is not the one that "
                f"{task.target} was packed from: it has {found[0]} bytes with crc32 "
                f"{found[1]:08x}, and had {seen.size} with {seen.crc32:08x}. Remove that shard to "
                f"have it packed anew and run the same command again, or put the file back, or "
                f"pack into an empty folder."
            )


def require_same_rows(task: ShardTask, note: ShardNote) -> None:
    """Refuse to keep a finished shard if the index tells its scenes otherwise than it does.

    Raises:
        ShardError: Naming the first such scene, and what to do.
    """
    for scene in task.shard.scenes:
        key = scene.id.key
        if note.rows.get(key) == row_digest(scene):
            continue
        texts = {}
        with task.target.open("rb") as file:
            for member, seen, offset in note.members(task):
                of_scene, _, name = member.name.partition(".")
                if of_scene == key and name in METADATA_FILES:
                    file.seek(offset)
                    texts[name] = file.read(seen.size)
        require_indexed_metadata(scene, texts, root=task.root)


def require_indexed_metadata(scene: Scene, texts: Mapping[str, bytes], *, root: str) -> None:
    """Refuse to pack metadata files that tell otherwise than the index of their release.

    Raises:
        ShardError: Naming the first such file, what it tells and what to do.
    """
    for name, told in metadata_differences(scene, texts)[:1]:
        where = Path(root, scene.id.key, name)
        raise ShardError(
            f"{where}: {told}. The index is older than the file: run `stereogenbench index` on "
            f"the release again, then the same command."
        )


def _seen_now(source: Path, seen: SeenFile, *, is_text: bool) -> tuple[int, int] | None:
    """Return a source's size and crc32; the noted ones where it was not touched, None if gone."""
    try:
        status = source.stat()
        is_untouched = (status.st_size, status.st_mtime_ns) == (seen.size, seen.modified_ns)
        if is_untouched and not is_text:
            return seen.size, seen.crc32
        crc32 = 0
        with source.open("rb", buffering=0) as file:
            while chunk := file.read(_CHUNK_BYTES):
                crc32 = zlib.crc32(chunk, crc32)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ShardError(
            f"{source}: cannot be read ({error.strerror}). "
            + cure_of(error, "Check the disk, then run the same command again.")
        ) from error
    return status.st_size, crc32
