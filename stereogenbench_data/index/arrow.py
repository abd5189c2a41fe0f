"""Arrow's columns as numpy arrays, and a digest of a table's content.

Arrow's own conversions import pandas if it is installed, which takes longer than opening the index
of a whole release; these do not.
"""

import hashlib
from typing import Any

import numpy as np
import pyarrow as pa

from stereogenbench_data.index import compute as pc
from stereogenbench_data.index.rows import ADDED


def as_numpy(values: Any) -> np.ndarray:
    """Return a column of numbers, booleans, strings, or lists of a fixed length.

    Args:
        values: A `pyarrow.Array`, or a `pyarrow.ChunkedArray`.

    Returns:
        Numbers of the column's own dtype, float64 with nan if some are null; bool; strings as
        objects, None where null; (n, length) for lists of a fixed length. It may be a read-only
        view of Arrow's memory.
    """
    values = one_array(values)
    kind = values.type
    if pa.types.is_fixed_size_list(kind):
        return as_numpy(values.flatten()).reshape(-1, kind.list_size)
    if pa.types.is_boolean(kind):
        return as_numpy(values.cast(pa.uint8())).astype(bool)
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        texts, which = as_categories(values)
        choices: np.ndarray = np.array([*texts, None], dtype=object)
        return choices.take(which)
    numbers = _stored_numbers(values)
    if not values.null_count:
        return numbers
    return np.where(as_numpy(values.is_valid()), numbers.astype(np.float64), np.nan)


def as_categories(values: Any) -> tuple[list[str], np.ndarray]:
    """Return the different values of a column of strings, or of lists of a fixed length of them.

    Args:
        values: A `pyarrow.Array`, or a `pyarrow.ChunkedArray`.

    Returns:
        The values, and for each row, or (n, length), the place of its value among them as int32;
        -1 where it is null.
    """
    values = one_array(values)
    if pa.types.is_fixed_size_list(values.type):
        texts, which = as_categories(values.flatten())
        return texts, which.reshape(-1, values.type.list_size)
    encoded = values.dictionary_encode()
    which = _stored_numbers(encoded.indices)
    if encoded.null_count:
        which = np.where(as_numpy(encoded.is_valid()), which, np.int32(-1))
    return encoded.dictionary.to_pylist(), which


def one_array(values: Any) -> Any:
    """Return a column as one `pyarrow.Array`."""
    if not isinstance(values, pa.ChunkedArray):
        return values
    if values.num_chunks == 1:
        return values.chunk(0)  # Arrow would copy it
    if values.num_chunks == 0:
        return pa.nulls(0, values.type)  # Arrow would import pandas
    return pa.concat_arrays(values.chunks)


def _stored_numbers(values: Any) -> np.ndarray:
    """Return the numbers of a column as a read-only view, with any value where one is null."""
    known = [None, values.buffers()[1]]
    return np.from_dlpack(
        pa.Array.from_buffers(values.type, len(values), known, offset=values.offset)
    )


def table_digest(table: pa.Table) -> str:
    """Return a sha256 of all names and values, however they are stored: 64 hex digits.

    Columns that came later and say nothing are left out: tables of earlier versions lack them.
    """
    digest = hashlib.sha256()
    for name in sorted(table.column_names):
        if name in ADDED and table.column(name).null_count == table.num_rows:
            continue
        digest.update(name.encode() + b"\0")
        _feed(digest, one_array(table.column(name)))
    return digest.hexdigest()


def _feed(digest: "hashlib._Hash", values: Any) -> None:
    kind, count = values.type, len(values)
    digest.update(np.array([count], dtype="<i8").tobytes())
    known = as_numpy(values.is_valid()) if values.null_count else np.ones(count, dtype=bool)
    digest.update(np.packbits(known).tobytes())
    if pa.types.is_struct(kind):
        for field in values.flatten():
            _feed(digest, field)
    elif pa.types.is_list(kind):
        _feed_numbers(digest, pc.list_value_length(values))
        _feed(digest, values.flatten())
    elif pa.types.is_fixed_size_list(kind):
        _feed(digest, values.flatten())
    elif not pa.types.is_string(kind):
        _feed_numbers(digest, values)
    elif count:  # lengths in bytes, 0 for null, then all bytes
        _, offsets, content = values.buffers()
        ends = np.frombuffer(offsets, dtype=np.int32, count=count + 1, offset=4 * values.offset)
        _feed_numbers(digest, np.diff(ends))
        digest.update(content.slice(int(ends[0]), int(ends[-1] - ends[0])) if content else b"")


def _feed_numbers(digest: "hashlib._Hash", values: Any) -> None:
    numbers = values if isinstance(values, np.ndarray) else _stored_numbers(values)
    if not isinstance(values, np.ndarray) and values.null_count:
        numbers = np.where(as_numpy(values.is_valid()), numbers, numbers.dtype.type(0))
    stored = numbers.astype(numbers.dtype.newbyteorder("<"), order="C", copy=False)
    digest.update(stored.data)
