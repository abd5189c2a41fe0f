"""One scene by its key, or by a part of it."""

import difflib
from typing import Final

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.filters import told_stale

_SHOWN: Final = 6


def find_scene(index: SceneIndex, text: str) -> int:
    """Return the row of the one scene whose key is a text, or ends in it, or holds it.

    A text that is whole folders of one key is that scene's, whatever other keys it is a part of.

    Args:
        index: Where to look.
        text: A key, or a part of one, in any case.

    Raises:
        SelectionError: If no key or several keys hold the text, naming those that are close.
    """
    keys = [str(key) for key in index.column("key")]
    lowered = [key.lower() for key in keys]
    wanted = text.strip("/").lower()
    for matches in (
        [row for row, key in enumerate(keys) if key == text],
        [row for row, key in enumerate(lowered) if f"/{key}".endswith(f"/{wanted}")],
        [row for row, key in enumerate(lowered) if f"/{wanted}/" in f"/{key}/"],
        [row for row, key in enumerate(lowered) if wanted in key],
    ):
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise SelectionError(
                f"{text!r} is a part of {len(matches)} keys: "
                f"{_listed([keys[row] for row in matches])}. Give more of the key."
            )
    near = _near(wanted, keys)
    raise SelectionError(
        f"{text!r} is no key of {counted(len(keys), 'scene')}, nor a part of one. "
        + (f"Did you mean {_listed(near)}?" if near else f"There is {_listed(keys)}.")
        + told_stale(index)
    )


def _near(wanted: str, keys: list[str]) -> list[str]:
    """Return the keys whose end, as long as what is wanted, is most like it."""
    levels = wanted.count("/") + 1
    ends: dict[str, list[str]] = {}
    for key in keys:
        ends.setdefault("/".join(key.lower().split("/")[-levels:]), []).append(key)
    close = difflib.get_close_matches(wanted, ends, n=_SHOWN)
    return [key for end in close for key in ends[end]]


def _listed(keys: list[str]) -> str:
    more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    return ", ".join(keys[:_SHOWN]) + more
