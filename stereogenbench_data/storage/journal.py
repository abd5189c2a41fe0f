"""A journal of described scenes, so that a walk that was killed goes on where it stopped.

One JSON object a line: the first says what the walk is, each further one holds a scene's row and
a stamp of its files. A line that a kill cut short is passed over, and so its scene read again.
"""

import json
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TextIO

from stereogenbench_data.errors import StorageError
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.storage.rows import SCHEMA, row_of, scene_of

_FORMAT: Final = 1


class Journal:
    """Scenes described so far, on disk; leaving its block keeps the file, `delete` removes it."""

    def __init__(self, path: Path, *, walk: str) -> None:
        """Read what a journal holds; that of another walk is begun anew.

        Nothing is written before the first scene is added.

        Raises:
            StorageError: If the file is there and cannot be read.
        """
        self._path = path
        self._file: TextIO | None = None
        self._head = json.dumps({"journal": _FORMAT, "walk": walk, "columns": SCHEMA.names})
        try:
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        except (FileNotFoundError, NotADirectoryError):
            lines = []
        except OSError as error:
            raise StorageError(
                f"{path}: the journal of an earlier run cannot be read ({error.strerror}). "
                f"Remove it, or write the index to another folder."
            ) from error
        self._is_same = bool(lines) and lines[0] == self._head
        self._known = _known(lines[1:]) if self._is_same else {}

    def __len__(self) -> int:
        """The number of scenes that were described before this walk."""
        return len(self._known)

    def find(self, key: str, *, stamp: str) -> Scene | None:
        """Return a scene described before, None if it was not or its files have changed."""
        known = self._known.get(key)
        return known[1] if known is not None and known[0] == stamp else None

    def add(self, scene: Scene, *, stamp: str) -> None:
        """Note a scene, so that it outlives this process.

        Raises:
            StorageError: If the file cannot be written.
        """
        line = json.dumps({"stamp": stamp, "row": row_of(scene)})
        try:
            if self._file is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._path.open("a" if self._is_same else "w", encoding="utf-8")
                self._file.write("\n" if self._is_same else f"{self._head}\n")
            self._file.write(f"{line}\n")
            self._file.flush()
        except OSError as error:
            raise StorageError(
                f"{self._path}: the journal cannot be written ({error.strerror}). Give write "
                f"permission there, or write the index to another folder."
            ) from error

    def delete(self) -> None:
        """Remove the file: what it holds was written elsewhere."""
        self._close()
        self._path.unlink(missing_ok=True)

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> "Journal":
        """Return the journal itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file, and keep it."""
        self._close()


def _known(lines: list[str]) -> dict[str, tuple[str, Scene]]:
    known: dict[str, tuple[str, Scene]] = {}
    for line in lines:
        try:
            entry: Any = json.loads(line)
            scene = scene_of(entry["row"])
            known[scene.id.key] = (entry["stamp"], scene)
        except (ValueError, KeyError, TypeError, IndexError, AttributeError):
            continue
    return known
