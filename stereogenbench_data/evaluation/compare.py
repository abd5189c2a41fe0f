"""Two evaluations compared: whether one reproduces the other, and what differs if not."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

from stereogenbench_data.errors import EvaluationError

RELATIVE: Final = 1e-6
"""How far numbers may be apart: other processors and releases of libraries round differently."""
_LEFT_OUT: Final = frozenset({"data.root", "settings.versions", "format", "paper"})
"""Where the data lay and which releases computed the scores; what no score depends on."""


def differences(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> list[str]:
    """Return where two documents of `report.document` differ; empty where one reproduces the other.

    The data, the protocol, every choice with the hashes of weights, the right views and each cell
    of each table are compared.

    Args:
        ours: The evaluation that was made now.
        theirs: The one that it is to reproduce.

    Raises:
        EvaluationError: If the second is not such a document.
    """
    if theirs.get("format") != ours["format"]:
        raise EvaluationError(
            f"to be compared, results.json must have format {ours['format']}, and this one has "
            f"{theirs.get('format')!r}: make it again by this version of the package."
        )
    return [
        f"{place}: {_shown(here)} here, {_shown(there)} there"
        for place, here, there in _leaves(ours, theirs, "")
    ]


def _leaves(ours: Any, theirs: Any, place: str) -> Iterator[tuple[str, Any, Any]]:
    if place in _LEFT_OUT:
        return
    if isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        for number, (here, there) in enumerate(zip(ours, theirs, strict=True)):
            yield from _leaves(here, there, f"{place}[{_name(here, number)}]")
    elif isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        for key in dict.fromkeys([*ours, *theirs]):
            inner = f"{place}.{key}" if place else key
            yield from _leaves(ours.get(key), theirs.get(key), inner)
    elif isinstance(ours, float) and isinstance(theirs, int | float):
        if not math.isclose(ours, theirs, rel_tol=RELATIVE, abs_tol=RELATIVE):
            yield place, ours, theirs
    elif ours != theirs:
        yield place, ours, theirs


def _name(row: Any, number: int) -> str:
    """Return what a row of a list is called."""
    if not isinstance(row, Mapping):
        return str(number)
    group = ", ".join(row.get("group", {}).values())
    return " ".join(filter(None, [row.get("name") or row.get("method") or str(number), group]))


def _shown(value: Any) -> str:
    return f"{len(value)} values" if isinstance(value, list | Mapping) else repr(value)
