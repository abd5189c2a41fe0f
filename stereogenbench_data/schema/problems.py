"""The problems of one metadata file, gathered so that a user sees them all at once."""

import json
import re
from typing import Final

from stereogenbench_data.errors import SchemaError

_SHOWN: Final = 20
_PLAIN_KEY: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_BRIEF_LENGTH: Final = 60


def child_path(path: str, key: str | int) -> str:
    """Return the JSON path of an object's or a list's element.

    >>> child_path("$.frames", 3), child_path("$", "map name")
    ('$.frames[3]', '$["map name"]')
    """
    if isinstance(key, int):
        return f"{path}[{key}]"
    return f"{path}.{key}" if _PLAIN_KEY.match(key) else f"{path}[{json.dumps(key)}]"


def brief(value: object) -> str:
    """Return a JSON value as a message shows it: containers by their size, long texts cut."""
    if isinstance(value, dict):
        return f"an object with {len(value)} keys ({names(value)})" if value else "an empty object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    shown = "null" if value is None else repr(value)
    return shown if len(shown) <= _BRIEF_LENGTH else f"{shown[: _BRIEF_LENGTH - 3]}..."


def names(document: dict[str, object]) -> str:
    """Return an object's keys, sorted, for a message."""
    keys = sorted(document)
    more = f", and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    plain = (key if key.isascii() and key.isprintable() else ascii(key) for key in keys[:_SHOWN])
    return ", ".join(key[:_BRIEF_LENGTH] for key in plain) + more or "none"


class Problems:
    """What is wrong with one file; the same complaint about many places is told once."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._paths: dict[str, list[str]] = {}
        self._count = 0

    def __len__(self) -> int:
        """The number of problems noted so far."""
        return self._count

    def add(self, path: str, complaint: str) -> None:
        """Note a complaint about the value at a JSON path."""
        self._paths.setdefault(complaint, []).append(path)
        self._count += 1

    def require_none(self) -> None:
        """Raise one error that tells every problem noted so far.

        Raises:
            SchemaError: If any was noted. Twenty are told, the rest counted.
        """
        if not self._paths:
            return
        lines = []
        for complaint, paths in list(self._paths.items())[:_SHOWN]:
            again = f" (and so in {len(paths) - 1} more places)" if len(paths) > 1 else ""
            lines.append(f"{paths[0]}: {complaint}{again}")
        if len(self._paths) > _SHOWN:
            lines.append(f"and {sum(map(len, list(self._paths.values())[_SHOWN:]))} more")
        head = "1 problem" if self._count == 1 else f"{self._count} problems"
        raise SchemaError(f"{self._where}: {head}:\n  " + "\n  ".join(lines))


def counted(count: int, noun: str) -> str:
    """Return a number with its noun.

    >>> counted(1, "shard"), counted(0, "shard")
    ('1 shard', '0 shards')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def markdown_text(text: str) -> str:
    r"""Return text that came with data as Markdown that shows it, in a table's cell too.

    Nothing in it is taken for a tag, a link, a picture, code or the end of a cell.

    >>> print(markdown_text("<img src=x onerror=alert(1)>|[a](b)"))
    &lt;img src=x onerror=alert(1)&gt;\|[a]\(b)
    """
    escaped = text.replace("\\", "\\\\").replace("&", "&amp;")
    escaped = escaped.replace("<", "&lt;").replace(">", "&gt;")
    for mark, inert in (("|", r"\|"), ("`", r"\`"), ("](", r"]\(")):
        escaped = escaped.replace(mark, inert)
    return plain_line(escaped)


def plain_line(text: str) -> str:
    r"""Return text on one line, without what steers a terminal: such characters are spelled out.

    >>> print(plain_line("a" + chr(27) + "[31mb" + chr(10) + "c"))
    a\x1b[31mb\nc
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
