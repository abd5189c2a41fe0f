"""From Arrow's columns to numpy arrays, without Arrow's own way, which imports pandas if it can.

That import takes longer than opening the index of a whole release.
"""

from typing import Any

import numpy as np
import pyarrow as pa


def as_numpy(values: Any) -> np.ndarray:
    """Return one column without its chunks: numbers, truth values, texts, or lists of fixed length.

    Args:
        values: A `pyarrow.Array`.

    Returns:
        Numbers of the column's own dtype, float64 with nan where some are null; bool; texts as
        objects, None where null; (n, length) for lists of a fixed length. It may be a view of
        Arrow's memory, and is then read-only.
    """
    kind = values.type
    if pa.types.is_fixed_size_list(kind):
        return as_numpy(values.flatten()).reshape(-1, kind.list_size)
    if pa.types.is_boolean(kind):
        return as_numpy(values.cast(pa.uint8())).astype(bool)
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return np.array(values.to_pylist(), dtype=object)
    numbers = stored_numbers(values)
    if not values.null_count:
        return numbers
    return np.where(as_numpy(values.is_valid()), numbers.astype(np.float64), np.nan)


def stored_numbers(values: Any) -> np.ndarray:
    """Return the numbers of a column as a read-only view; anything may stand where one is null."""
    dtype = np.dtype(values.type.to_pandas_dtype())
    if len(values) == 0:
        return np.empty(0, dtype=dtype)
    start = values.offset * dtype.itemsize
    return np.frombuffer(values.buffers()[1], dtype=dtype, count=len(values), offset=start)


def stored_texts(values: Any) -> tuple[np.ndarray, bytes]:
    """Return a column's texts: their lengths in bytes, (n,) int32, 0 for null, and all in a row."""
    if len(values) == 0:
        return np.empty(0, dtype=np.int32), b""
    _, offsets, content = values.buffers()
    ends = np.frombuffer(offsets, dtype=np.int32, count=len(values) + 1, offset=4 * values.offset)
    lengths = np.diff(ends)
    if values.null_count and lengths[~as_numpy(values.is_valid())].any():
        encoded = [(text or "").encode() for text in values.to_pylist()]
        return np.array([len(text) for text in encoded], dtype=np.int32), b"".join(encoded)
    if content is None:
        return lengths, b""
    return lengths, content.slice(int(ends[0]), int(ends[-1] - ends[0])).to_pybytes()
