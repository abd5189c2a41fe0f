"""Doctests in docstrings, shown as code: without a fence Markdown takes them for text and links."""

import re
from typing import Any

import griffe

_DOCTEST = re.compile(r"(?:^[ ]*>>> .*\n?(?:^[ ]*\S.*\n?)*)+", flags=re.MULTILINE)
_PLACES = {"small_release": "scenes/", "detailed_release": "scenes/", "small_shards": "shards/"}
"""What a reader has where a test has a fixture."""


class FencedDoctests(griffe.Extension):
    """Puts a fence around every doctest of every docstring."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Fence the doctests of one object's docstring."""
        if obj.docstring is not None:
            obj.docstring.value = fenced(obj.docstring.value)


def fenced(text: str) -> str:
    """Return a docstring with its doctests as blocks of code, as a reader would type them."""
    return _DOCTEST.sub(lambda found: _block(found[0]), text)


def _block(doctest: str) -> str:
    shown = re.sub(r"[ ]*# doctest:.*", "", doctest.rstrip())
    shown = re.sub(
        r'getfixture\("(\w+)"\)', lambda found: f'"{_PLACES.get(found[1], "scenes/")}"', shown
    )
    return f"```pycon\n{shown}\n```\n"
