"""What was meant by a misspelled name."""

import difflib
from collections.abc import Iterable
from typing import Final

_CLOSE: Final = 0.6
"""The likeness from which on a name is taken for another one misspelled."""
_OF_PART: Final = 0.25
"""How much likelier a name is that holds the other one whole."""
_LEAST_PART: Final = 4
"""Characters that a part of a name has at least."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return how a message about an unknown name goes on: with the name that was meant, or a dot.

    >>> did_you_mean("dispairty", ["left", "disparity"]), did_you_mean("colour", ["left"])
    ("; did you mean 'disparity'?", '.')
    """
    nearest = max(known, key=lambda each: _likeness(name, each), default="")
    return f"; did you mean {nearest!r}?" if _likeness(name, nearest) >= _CLOSE else "."


def _likeness(name: str, known: str) -> float:
    """Return how like a known name a name is; one that has the other whole is like it."""
    typed, meant = name.lower(), known.lower()
    holds = len(typed) >= _LEAST_PART and (typed in meant or meant in typed)
    return difflib.SequenceMatcher(None, typed, meant).ratio() + holds * _OF_PART
