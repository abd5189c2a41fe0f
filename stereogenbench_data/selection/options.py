"""The options of public calls: which there are, whose they are, and which do not exist."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.selection.spelling import did_you_mean


def require_options(
    call: Callable[..., Any],
    given: Iterable[str],
    *,
    elsewhere: Mapping[str, Iterable[str]] | None = None,
) -> None:
    """Refuse options that a call does not have, naming the nearest, and all in their order.

    Args:
        call: A function or a class, whose options are its keyword-only and optional parameters:
            `signatures.list_options` lists those of a typed dictionary.
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
    return [
        name
        for name, each in inspect.signature(call).parameters.items()
        if each.kind is each.KEYWORD_ONLY
        or (each.kind is each.POSITIONAL_OR_KEYWORD and each.default is not each.empty)
    ]


def split_options(options: Mapping[str, Any], kind: Any) -> tuple[Any, Any]:
    """Return the options that a typed dictionary declares, and the others."""
    own = kind.__annotations__
    return (
        {name: options[name] for name in options if name in own},
        {name: options[name] for name in options if name not in own},
    )
