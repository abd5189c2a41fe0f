"""Where a scene's bytes are: checked paths of the members that an index names."""

import re
import stat
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import StorageError
from stereogenbench_data.schema.document import require_text_size
from stereogenbench_data.schema.records import Member

UNSAFE_PATH: Final = r"^/|\\|:|(?:^|/)\.{0,2}(?:/|$)|[\x00-\x1f]"
"""What no member's path may hold: a root, a drive, a backslash, an empty part, '.' or '..'."""

_UNSAFE_PATH: Final = re.compile(UNSAFE_PATH)


def member_path(root: str | Path, member: Member) -> Path:
    """Return where a member's file lies, having checked that it is the one that was indexed.

    Raises:
        StorageError: If the path leaves the root, or the file is missing, unreadable or has
            another size than the index says.
    """
    if _UNSAFE_PATH.search(member.path):
        raise StorageError(
            f"{member.path!r}: a member's path is relative to the data's root and stays inside "
            f"it. The index was not made by this package: run `stereogenbench index` again."
        )
    path = Path(root, member.path)
    try:
        size_bytes = path.stat().st_size
    except OSError as error:
        raise StorageError(
            f"{path}: cannot be read ({error.strerror}), and the index says that it has "
            f"{member.size} bytes. Fetch it again, or run `stereogenbench index` again."
        ) from error
    if size_bytes != member.offset + member.size:
        raise StorageError(
            f"{path}: has {size_bytes} bytes, and the index says "
            f"{member.offset + member.size}. The file was cut short or changed after its index: "
            f"fetch it again, or run `stereogenbench index` again."
        )
    return path


def read_member(root: str | Path, member: Member) -> bytes:
    """Return the bytes of a metadata file, having checked that it is the one that was indexed.

    Raises:
        StorageError: If the file is missing, unreadable or not the one that was indexed.
        SchemaError: If it is too large for a metadata file.
    """
    path = member_path(root, member)
    return read_text_file(path, where=str(path))


def read_text_file(path: Path, *, where: str) -> bytes:
    """Return the bytes of a metadata file, of which the size is checked before it is read.

    Raises:
        StorageError: If the file is missing or unreadable.
        SchemaError: If it is too large for a metadata file.
    """
    try:
        status = path.stat()
        if stat.S_ISREG(status.st_mode):
            require_text_size(status.st_size, where=where)
            return path.read_bytes()
    except OSError as error:
        raise StorageError(
            f"{where}: cannot be read ({error.strerror}). Fetch it again, or give read permission."
        ) from error
    raise StorageError(f"{where}: is no file. Put the release's own file in its place.")
