"""The files of one scene in the released layout, on this machine or behind a URL."""

import os
from pathlib import Path
from typing import Protocol, runtime_checkable

from stereogenbench_data.errors import StorageError, cure_of
from stereogenbench_data.schema.document import require_text_size
from stereogenbench_data.schema.release import METADATA_FILES, PACKED_DEPTH_NAMES, VIDEO_FILES
from stereogenbench_data.sources.location import is_remote, joined
from stereogenbench_data.sources.members import read_text_file
from stereogenbench_data.sources.ranged_file import MemberFile, RangedFile
from stereogenbench_data.sources.remote import RemoteObject

_WANTED = frozenset({*METADATA_FILES, *VIDEO_FILES, *PACKED_DEPTH_NAMES.values()})


@runtime_checkable
class SceneFiles(Protocol):
    """What a walk asks of a scene's folder."""

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes and the time of change in ns (0 if unknown) of each file.

        Raises:
            StorageError: If the folder cannot be read.
        """
        ...

    def text(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        ...

    def video(self, name: str) -> Path | MemberFile:
        """Return a video: its path, or an open file that is the caller's to close.

        Raises:
            StorageError: If it cannot be read.
        """
        ...


def files_of(root: str | Path, key: str) -> SceneFiles:
    """Return the files of the scene with a key below a root, which may be a URL."""
    return RemoteSceneFiles(str(root), key) if is_remote(root) else LocalSceneFiles(root, key)


class LocalSceneFiles:
    """A scene's folder on this machine."""

    def __init__(self, root: str | Path, key: str) -> None:
        """Name the folder."""
        self._folder = Path(root, key)
        self._key = key

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return size and time of change of each file."""
        try:
            with os.scandir(self._folder) as entries:
                found = {entry.name: entry.stat() for entry in entries if entry.name in _WANTED}
        except OSError as error:
            raise StorageError(
                f"{self._folder}: cannot be read ({error.strerror}). "
                + cure_of(error, "Fetch the scene again.")
            ) from error
        return {name: (found[name].st_size, found[name].st_mtime_ns) for name in sorted(found)}

    def text(self, name: str) -> bytes:
        """Return a metadata file."""
        return read_text_file(self._folder / name, where=f"{self._key}/{name}")

    def video(self, name: str) -> Path:
        """Return a video's path."""
        return self._folder / name


class RemoteSceneFiles:
    """A scene's folder behind a URL, of which only what is asked for is fetched."""

    def __init__(self, root: str, key: str) -> None:
        """Name the folder; nothing is asked of it yet."""
        self._url = joined(root, key)
        self._key = key
        self._sizes: dict[str, int] = {}

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size of each file; the time of change is not known."""
        if not self._sizes:
            entries = RemoteObject(self._url).entries()
            self._sizes = {
                name: size
                for name, size in sorted(entries.items())
                if name in _WANTED and size is not None
            }
        return {name: (size, 0) for name, size in self._sizes.items()}

    def text(self, name: str) -> bytes:
        """Fetch a metadata file."""
        size, _ = self.stamps()[name]
        require_text_size(size, where=f"{self._key}/{name}")
        return RemoteObject(joined(self._url, name)).read(0, size)

    def video(self, name: str) -> MemberFile:
        """Return a video that is fetched as it is read."""
        size, _ = self.stamps()[name]
        return RangedFile(RemoteObject(joined(self._url, name)).read, size=size)
