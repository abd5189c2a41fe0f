"""From the bytes of a metadata file to a JSON object, or to an error that says why not."""

import json
from typing import Any, Final, NoReturn

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.problems import brief, child_path

MAX_TEXT_BYTES: Final = 32 * 2**20
"""The largest metadata file that is read. The release's largest has a third of a megabyte."""


def require_text_size(size_bytes: int, *, where: str) -> None:
    """Refuse a metadata file that no release would hold, before it is read.

    Raises:
        SchemaError: If the size is above `MAX_TEXT_BYTES`.
    """
    if size_bytes > MAX_TEXT_BYTES:
        raise SchemaError(
            f"{where}: a metadata file may have {MAX_TEXT_BYTES:,} bytes, this one has "
            f"{size_bytes:,}. It was not read: put the release's own file in its place."
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

    NaN and Infinity, which are not JSON but which Python writes, are let through, so that the
    check of each value can name their place.

    Raises:
        SchemaError: If the text is too large, empty, cut short, not UTF-8, not JSON, nested too
            deep, names a key twice, or is not an object at its top level.
    """
    decoded = parse_text(text, where=where)
    if not decoded.strip():
        raise SchemaError(f"{where}: the file is empty. Copy it from the release again.")
    repeated: list[tuple[dict[str, Any], str]] = []

    def keep_pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        kept = dict(pairs)
        if len(kept) != len(pairs):
            keys = [key for key, _ in pairs]
            repeated.append((kept, next(key for key in keys if keys.count(key) > 1)))
        return kept

    try:
        document = json.loads(decoded, object_pairs_hook=keep_pairs)
    except RecursionError as error:
        raise SchemaError(
            f"{where}: lists or objects are nested hundreds of levels deep; the release's files "
            f"have six. Copy the file from the release again."
        ) from error
    except ValueError as error:
        _raise_not_json(error, length=len(decoded.rstrip()), where=where)
    if not isinstance(document, dict):
        raise SchemaError(
            f"{where}: $ must be an object, found {brief(document)}. "
            f"Is it another file under this name?"
        )
    if repeated:
        path = child_path(_path_of(document, repeated[0][0]), repeated[0][1])
        raise SchemaError(
            f"{where}: {path} is written {'twice' if len(repeated) == 1 else 'more than once'}, "
            f"so that one value would hide the other. Keep the right one."
        )
    return document


def _raise_not_json(error: ValueError, *, length: int, where: str) -> NoReturn:
    if not isinstance(error, json.JSONDecodeError):
        raise SchemaError(f"{where}: not JSON that can be read: {error}.") from error
    cut = error.pos >= length or error.msg.startswith("Unterminated")
    guess = "It looks cut short: c" if cut else "C"
    raise SchemaError(
        f"{where}: not JSON: {error.msg} at line {error.lineno}, column {error.colno} "
        f"(character {error.pos} of {length}). {guess}opy the file from the release again."
    ) from error


def _path_of(document: object, wanted: object) -> str:
    """Return the JSON path of an element that is known to be in the document, by identity."""
    waiting = [("$", document)]
    while waiting:
        path, value = waiting.pop()
        if value is wanted:
            return path
        if isinstance(value, dict):
            waiting += [(child_path(path, key), child) for key, child in value.items()]
        elif isinstance(value, list):
            waiting += [(child_path(path, place), child) for place, child in enumerate(value)]
    return "$..."
