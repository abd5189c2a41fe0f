"""Options of public calls, and other names: a misspelled one is answered with what there is."""

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, get_args

from stereogenbench_data.errors import SelectionError

_CLOSE: Final = 0.6
"""The likeness from which on a name is taken for another one misspelled."""
_OF_PART: Final = 0.25
"""How much likelier a name is that holds the other one whole."""
_LEAST_PART: Final = 4
"""Characters that a part of a name has at least."""


def require_options(
    call: Callable[..., Any],
    given: Iterable[str],
    *,
    elsewhere: Mapping[str, Iterable[str]] | None = None,
) -> None:
    """Refuse options that a call does not have, naming the nearest, and all in their order.

    Args:
        call: A function or a class, whose options are its keyword-only and optional parameters and
            the keys of the typed dictionary that it unpacks.
        given: The names that the caller gave.
        elsewhere: Calls that a user may have meant, such as "loader", with their options.

    Raises:
        SelectionError: If there is such an option.
    """
    known = options_of(call)
    for name in given:
        if name in known:
            continue
        hint = did_you_mean(name, known)
        for place, names in (elsewhere or {}).items():
            if name in names:
                hint = f"; it is an option of {place}."
        raise SelectionError(
            f"{call.__name__} has no option {name!r}{hint} It has {', '.join(known)}."
        )


def options_of(call: Callable[..., Any]) -> list[str]:
    """Return the names of the options of a call, in the order of their declaration."""
    names: list[str] = []
    for parameter in inspect.signature(call).parameters.values():
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY or (
            parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
            and parameter.default is not inspect.Parameter.empty
        ):
            names.append(parameter.name)
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            for unpacked in get_args(parameter.annotation):
                names += unpacked.__annotations__
    return list(dict.fromkeys(names))


def split_options(options: Mapping[str, Any], kind: Any) -> tuple[Any, Any]:
    """Return the options that a typed dictionary declares, and the others."""
    own = kind.__annotations__
    return (
        {name: options[name] for name in options if name in own},
        {name: options[name] for name in options if name not in own},
    )


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return how a message about an unknown name goes on: with the name that was meant, or a dot.

    >>> did_you_mean("dispairty", ["left", "disparity"]), did_you_mean("colour", ["left"])
    ("; did you mean 'disparity'?", '.')
    """
    nearest = nearest_first(name, known)
    is_close = bool(nearest) and _likeness(name, nearest[0]) >= _CLOSE
    return f"; did you mean {nearest[0]!r}?" if is_close else "."


def nearest_first(name: str, known: Iterable[str]) -> list[str]:
    """Return the known names, the most like a name first."""
    return sorted(known, key=lambda each: _likeness(name, each), reverse=True)


def _likeness(name: str, known: str) -> float:
    """Return how like a known name a name is; one that has the other whole is like it."""
    typed, meant = name.lower(), known.lower()
    holds = len(typed) >= _LEAST_PART and (typed in meant or meant in typed)
    return difflib.SequenceMatcher(None, typed, meant).ratio() + holds * _OF_PART
