"""Docstrings as the reference shows them: doctests as code, and each option in a signature.

Without a fence Markdown takes doctests for text and links. Options that a call unpacks from a typed
dictionary are taken from the signature that the code makes of them, as `help` does.
"""

import importlib
import inspect
import re
from typing import Any

import griffe

from stereogenbench_data.selection.signatures import Told

_DOCTEST = re.compile(r"(?:^[ ]*>>> .*\n?(?:^[ ]*\S.*\n?)*)+", flags=re.MULTILINE)
_PLACES = {"small_release": "scenes/", "detailed_release": "scenes/", "small_shards": "shards/"}
"""What a reader has where a test has a fixture."""


class ReferenceDocstrings(griffe.Extension):
    """Puts a fence around every doctest of every docstring, and options into signatures."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Fence the doctests of one object's docstring."""
        if obj.docstring is not None:
            obj.docstring.value = fenced(obj.docstring.value)

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Replace what a function unpacks by its options."""
        unpacked = [each for each in func.parameters if "Unpack[" in str(each.annotation)]
        for parameter in unpacked:
            del func.parameters[parameter.name]
            if func.docstring is not None:
                func.docstring.value = with_options(func.docstring.value, parameter.name)
            for each in inspect.signature(_found(func.path)).parameters.values():
                if each.name not in func.parameters:
                    func.parameters.add(_option(each))


def with_options(text: str, name: str) -> str:
    """Return a docstring that tells of unpacked options before its arguments, as they are many."""
    entry = re.search(rf"^    \*\*{name}: (.*\n?(?:^     +.*\n?)*)", text, flags=re.MULTILINE)
    if entry is None:
        return text
    without = text[: entry.start()] + text[entry.end() :]
    about = f"Options: {' '.join(entry[1].split())}"
    return without.replace("Args:\n\n", "").replace("Args:\n", f"{about}\n\nArgs:\n")


def _found(path: str) -> Any:
    """Return what a dotted path leads to: attributes of the longest part that is a module."""
    parts = path.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for name in parts[end:]:
            found = getattr(found, name)
        return found
    raise ModuleNotFoundError(path)


def _option(parameter: inspect.Parameter) -> griffe.Parameter:
    kind = re.sub(r"\b\w+\.(?=\w)", "", inspect.formatannotation(parameter.annotation))
    return griffe.Parameter(
        parameter.name,
        annotation=kind,
        kind=griffe.ParameterKind.keyword_only,
        default="..." if isinstance(parameter.default, Told) else repr(parameter.default),
    )


def fenced(text: str) -> str:
    """Return a docstring with its doctests as blocks of code, as a reader would type them."""
    return _DOCTEST.sub(lambda found: _block(found[0]), text)


def _block(doctest: str) -> str:
    shown = re.sub(r"[ ]*# doctest:.*", "", doctest.rstrip())
    shown = re.sub(
        r'getfixture\("(\w+)"\)', lambda found: f'"{_PLACES.get(found[1], "scenes/")}"', shown
    )
    return f"```pycon\n{shown}\n```\n"
