"""Journals of what was done for each scene, so that work that was killed goes on where it stopped.

One JSON object a line: the first says what the work is, each further one holds what became of a
scene and a stamp of its files. A line that a kill cut short is passed over, and so its scene read
again.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TextIO

from stereogenbench_data.errors import StorageError, cure_of
from stereogenbench_data.index.rows import SCHEMA, row_of, scene_of
from stereogenbench_data.schema.records import Scene

_FORMAT: Final = 2


class RecordJournal:
    """JSON values by scene, on disk; leaving its block keeps the file, `delete` removes it."""

    def __init__(self, path: Path, *, work: Mapping[str, Any]) -> None:
        """Read what a journal holds; that of other work is begun anew.

        Nothing is written before the first value is added.

        Args:
            path: The journal's file.
            work: What the work is, as JSON: two runs that say the same share their values.

        Raises:
            StorageError: If the file is there and cannot be read.
        """
        self._path = path
        self._file: TextIO | None = None
        self._head = json.dumps({"journal": _FORMAT, **work})
        try:
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        except (FileNotFoundError, NotADirectoryError):
            lines = []
        except OSError as error:
            raise StorageError(
                f"{path}: the journal of an earlier run cannot be read ({error.strerror}). "
                + cure_of(error, "Remove it, or write the result to another folder.")
            ) from error
        self._is_same = bool(lines) and lines[0] == self._head
        self._known = _known(lines[1:]) if self._is_same else {}

    def __len__(self) -> int:
        """The number of scenes that earlier runs have done."""
        return len(self._known)

    def value(self, key: str, *, stamp: str) -> Any:
        """Return what was noted of a scene; None if nothing was, or its files have changed."""
        known = self._known.get(key)
        return known[1] if known is not None and known[0] == stamp else None

    def note(self, key: str, value: Any, *, stamp: str) -> None:
        """Note a scene's value, any JSON but null, so that it outlives this process.

        Raises:
            StorageError: If the file cannot be written.
        """
        line = json.dumps({"key": key, "stamp": stamp, "value": value})
        try:
            if self._file is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._path.open("a" if self._is_same else "w", encoding="utf-8")
                self._file.write("\n" if self._is_same else f"{self._head}\n")
            self._file.write(f"{line}\n")
            self._file.flush()
        except OSError as error:
            raise StorageError(
                f"{self._path}: the journal cannot be written ({error.strerror}). "
                + cure_of(error, "Write the result to another folder.")
            ) from error

    def delete(self) -> None:
        """Remove the file: what it holds was written elsewhere."""
        self._close()
        self._path.unlink(missing_ok=True)

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> "RecordJournal":
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


class Journal(RecordJournal):
    """A journal of scenes that were described."""

    def __init__(self, path: Path, *, walk: str) -> None:
        """Read what a journal of this walk holds; see `RecordJournal`."""
        super().__init__(path, work={"walk": walk, "columns": SCHEMA.names})

    def __enter__(self) -> "Journal":
        """Return the journal itself."""
        return self

    def find(self, key: str, *, stamp: str) -> Scene | None:
        """Return a scene described before, None if it was not or its files have changed."""
        row = self.value(key, stamp=stamp)
        try:
            return None if row is None else scene_of(row)
        except (ValueError, KeyError, TypeError, IndexError, AttributeError):
            return None

    def add(self, scene: Scene, *, stamp: str) -> None:
        """Note a scene, so that it outlives this process.

        Raises:
            StorageError: If the file cannot be written.
        """
        self.note(scene.id.key, row_of(scene), stamp=stamp)


def _known(lines: list[str]) -> dict[str, tuple[str, Any]]:
    known: dict[str, tuple[str, Any]] = {}
    for line in lines:
        try:
            entry: Any = json.loads(line)
            known[str(entry["key"])] = (entry["stamp"], entry["value"])
        except (ValueError, KeyError, TypeError):
            continue
    return known
