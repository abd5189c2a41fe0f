"""Signatures that list each option of a call, for `help`, notebooks and the reference.

A call takes its options as ``**options: Unpack[SomeOptions]``, so that each is declared once, in a
typed dictionary. Python itself then shows no more than ``**options``.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, get_args, get_type_hints

Call = TypeVar("Call", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Told:
    """A default that depends on something else; a signature shows what it is."""

    text: str

    def __repr__(self) -> str:
        return f"<{self.text}>"


class ListedSignature(inspect.Signature):
    """A signature that is shown with a line for each parameter, and types without modules."""

    def __str__(self) -> str:
        """Return the signature as `help` shows it."""
        lines = ["("]
        for parameter in self.parameters.values():
            is_first_option = parameter.kind is parameter.KEYWORD_ONLY and "    *," not in lines
            lines += ["    *,"] if is_first_option else []
            lines.append(f"    {_as_written(parameter)},")
        returned = self.return_annotation
        ending = f") -> {_plain(returned)}" if isinstance(returned, type) else ")"
        return "\n".join([*lines, ending])

    def format(self, **_: Any) -> str:
        """Return the same: Python 3.13 and later ask for a width, which lines have anyway."""
        return str(self)


def _plain(annotation: Any) -> str:
    """Return a type as it is written, without the modules that its parts are of."""
    return re.sub(r"\b\w+\.(?=\w)", "", inspect.formatannotation(annotation))


def _as_written(parameter: inspect.Parameter) -> str:
    """Return a parameter with its type and default, as a reader would write it."""
    if parameter.annotation is parameter.empty:
        return str(parameter)
    shown = f"{parameter.name}: {_plain(parameter.annotation)}"
    return shown if parameter.default is parameter.empty else f"{shown} = {parameter.default!r}"


def list_options(*defaults: Mapping[str, Any]) -> Callable[[Call], Call]:
    """Let the signature of a function list each option that it unpacks, with type and default.

    The types are those of the typed dictionary. The default of an option that no mapping has is
    None where its type admits that.

    Args:
        *defaults: The defaults of options; others in them do not matter, and the last counts.
    """
    known = {name: default for each in defaults for name, default in each.items()}

    def listed(call: Call) -> Call:
        signature = inspect.signature(call)
        *parameters, unpacked = signature.parameters.values()
        (options,) = get_args(unpacked.annotation)
        for name, kind in get_type_hints(options).items():
            if name not in signature.parameters:
                otherwise = None if type(None) in get_args(kind) else Told("see its options")
                default = known.get(name, otherwise)
                parameters.append(
                    inspect.Parameter(name, unpacked.KEYWORD_ONLY, default=default, annotation=kind)
                )
        call.__dict__["__signature__"] = ListedSignature(
            parameters, return_annotation=signature.return_annotation
        )
        return call

    return listed
