"""The journal of a long run over scenes: what is done, so that a killed run continues.

One JSON object a line. The first says what the work is, each other one holds a scene's value and a
digest of its files. A line that was cut short is ignored, and its scene is read again.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TextIO

from stereogenbench_data.errors import explain_os_errors

_JOURNAL_FORMAT: Final = 2


class Journal:
    """JSON values by scene, on disk; leaving its block keeps the file, `delete` removes it."""

    def __init__(self, path: Path, *, work: Mapping[str, Any]) -> None:
        """Read a journal; that of other work is ignored, and replaced by the first new value.

        Args:
            path: The journal's file.
            work: What the work is, as JSON: runs of the same work share their values.

        Raises:
            StorageError: If the file exists and cannot be read.
        """
        self._path = path
        self._file: TextIO | None = None
        self._head = json.dumps({"journal": _JOURNAL_FORMAT, **work})
        what = f"{path}: the journal of an earlier run cannot be read"
        lines: list[str] = []
        with (
            explain_os_errors(what, "Remove it, or write the result to another folder."),
            suppress(FileNotFoundError, NotADirectoryError),
        ):
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        self._is_same = bool(lines) and lines[0] == self._head
        self._known: dict[str, tuple[str, Any]] = {}
        for line in lines[1:] if self._is_same else ():
            with suppress(ValueError, KeyError, TypeError):
                entry: Any = json.loads(line)
                self._known[str(entry["key"])] = (entry["stamp"], entry["value"])

    def __len__(self) -> int:
        """The number of scenes that earlier runs have done."""
        return len(self._known)

    def value(self, key: str, *, stamp: str) -> Any:
        """Return a scene's value; None if there is none, or its files have changed."""
        known = self._known.get(key)
        return known[1] if known is not None and known[0] == stamp else None

    def record(self, key: str, value: Any, *, stamp: str) -> None:
        """Write a scene's value, any JSON but null.

        Raises:
            StorageError: If the file cannot be written.
        """
        line = json.dumps({"key": key, "stamp": stamp, "value": value})
        what = f"{self._path}: the journal cannot be written"
        with explain_os_errors(what, "Write the result to another folder."):
            if self._file is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._path.open("a" if self._is_same else "w", encoding="utf-8")
                self._file.write("\n" if self._is_same else f"{self._head}\n")
            self._file.write(f"{line}\n")
            self._file.flush()

    def delete(self) -> None:
        """Remove the file, whose values were written elsewhere."""
        self.__exit__()
        self._path.unlink(missing_ok=True)

    def __enter__(self) -> "Journal":
        """Return the journal itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the file, and keep it."""
        if self._file is not None:
            self._file.close()
