"""JSON documents that nobody has checked: from bytes to objects, and values as messages show them.

What a document's values mean is said by `declaration`.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, Final, TypeGuard

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.text import shortened

MAX_TEXT_BYTES: Final = 32 * 2**20
"""The largest metadata file that is read. The release's largest is a third of a megabyte."""

MOST_LETTERS: Final = 2**16
"""The longest text of a metadata file or an index that is read; captions have some hundreds."""

_SHOWN: Final = 20
_LARGEST_INT: Final = 2**53
_PLAIN_KEY: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


def require_text_size(size_bytes: int, *, where: str) -> None:
    """Refuse a metadata file that is too large, before it is read.

    Raises:
        SchemaError: If the size is above `MAX_TEXT_BYTES`.
    """
    if size_bytes > MAX_TEXT_BYTES:
        raise SchemaError(
            f"{where}: a metadata file may have {MAX_TEXT_BYTES:,} bytes, this one has "
            f"{size_bytes:,}. It was not read. Replace it with the file of the release."
        )


def parse_text(text: bytes, *, where: str) -> str:
    """Return the text of a metadata file, which is UTF-8 with or without a byte-order mark.

    Raises:
        SchemaError: If it is too large or not UTF-8.
    """
    require_text_size(len(text), where=where)
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SchemaError(
            f"{where}: not UTF-8: byte {error.start} is 0x{text[error.start]:02x}. "
            f"Save the file as UTF-8, or copy it from the release again."
        ) from error


def parse_object(text: bytes, *, where: str) -> dict[str, Any]:
    """Return the JSON object that a metadata file holds.

    Raises:
        SchemaError: As `parse_document` does, or if there is no object at the top level.
    """
    document = parse_document(text, where=where)
    if not isinstance(document, dict):
        raise SchemaError(
            f"{where}: $ must be an object, found {brief(document)}. "
            f"Check that this is the file that its name says."
        )
    return document


def parse_document(text: bytes, *, where: str) -> Any:
    """Return the JSON value that a metadata file holds.

    NaN and Infinity, which are not JSON but which Python writes, are accepted here, so that the
    check of each value can report their place.

    Raises:
        SchemaError: If the text is too large, empty, truncated, not UTF-8, not JSON, nested too
            deep, or has a key twice.
    """
    decoded = parse_text(text, where=where)
    told = "the file is empty. Copy it"
    try:
        if decoded.strip():
            return json.loads(decoded, object_pairs_hook=_unique)
    except RecursionError:
        told = "lists or objects are nested hundreds of levels deep; the release's files have six "
        told += "levels. Copy the file"
    except json.JSONDecodeError as error:
        length = len(decoded.rstrip())
        is_cut = error.pos >= length or error.msg.startswith("Unterminated")
        place = f"line {error.lineno}, column {error.colno}"
        place += f" (character {min(error.pos, length)} of {length})"
        cure = "The file looks truncated: copy it" if is_cut else "Copy it"
        told = f"not valid JSON: {error.msg.removesuffix(' starting at')} at {place}. {cure}"
    except ValueError as error:
        told = f"not valid JSON: {error}. Copy the file"
    raise SchemaError(f"{where}: {told} from the release again.")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON, of which only one of two values of a key could be read."""
    kept = dict(pairs)
    if len(kept) != len(pairs):
        repeated = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {shortened(repr(repeated))} is written twice in one object")
    return kept


def child_path(path: str, key: str | int) -> str:
    """Return the JSON path of an element of an object or a list.

    >>> child_path("$.frames", 3), child_path("$", "map name")
    ('$.frames[3]', '$["map name"]')
    """
    if isinstance(key, int):
        return f"{path}[{key}]"
    key = shortened(key)
    return f"{path}.{key}" if _PLAIN_KEY.match(key) else f"{path}[{json.dumps(key)}]"


def brief(value: object) -> str:
    """Return a JSON value as messages show it: the size of containers, the start of long texts."""
    if isinstance(value, dict):
        keys = listed_keys(value)
        return f"an object with {len(value)} keys ({keys})" if value else "an empty object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, str) and len(value) > MOST_LETTERS:
        return f"one of {len(value):,} letters, more than {MOST_LETTERS:,}"
    return "null" if value is None else shortened(repr(value))


def listed_keys(keys: Iterable[str]) -> str:
    """Return the keys of an object, sorted, as messages show them."""
    first = sorted(keys)[:_SHOWN]
    plain = (key if key.isascii() and key.isprintable() else ascii(key) for key in first)
    more = len(list(keys)) - len(first)
    return ", ".join(map(shortened, plain)) + (f", and {more} more" if more else "") or "none"


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a JSON value is a finite number (a bool is not)."""
    if type(value) is int:
        return abs(value) < _LARGEST_INT
    return type(value) is float and math.isfinite(value)
