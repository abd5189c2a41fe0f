"""A digest of a table's content that does not depend on how the table is stored."""

import hashlib
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stereogenbench_data.index.arrow_arrays import (
    as_numpy,
    stored_numbers,
    stored_texts,
)


def table_digest(table: pa.Table) -> str:
    """Return a sha256 over the names and values of all columns, as 64 hexadecimal digits."""
    digest = hashlib.sha256()
    for name in sorted(table.column_names):
        digest.update(name.encode() + b"\0")
        column = table.column(name).combine_chunks()
        for chunk in column.chunks if isinstance(column, pa.ChunkedArray) else [column]:
            _feed(digest, chunk)
    return digest.hexdigest()


def _feed(digest: "hashlib._Hash", values: Any) -> None:
    kind = values.type
    digest.update(np.array([len(values)], dtype="<i8").tobytes())
    known = as_numpy(values.is_valid()) if values.null_count else np.ones(len(values), dtype=bool)
    digest.update(np.packbits(known).tobytes())
    if pa.types.is_struct(kind):
        for field in values.flatten():
            _feed(digest, field)
    elif pa.types.is_list(kind):
        _feed_numbers(digest, pc.list_value_length(values))
        _feed(digest, values.flatten())
    elif pa.types.is_fixed_size_list(kind):
        _feed(digest, values.flatten())
    elif pa.types.is_string(kind):
        lengths, texts = stored_texts(values)
        _feed_array(digest, lengths)
        digest.update(texts)
    else:
        _feed_numbers(digest, values)


def _feed_numbers(digest: "hashlib._Hash", values: Any) -> None:
    numbers = stored_numbers(values)
    if values.null_count:
        numbers = np.where(as_numpy(values.is_valid()), numbers, numbers.dtype.type(0))
    _feed_array(digest, numbers)


def _feed_array(digest: "hashlib._Hash", numbers: np.ndarray) -> None:
    digest.update(numbers.astype(numbers.dtype.newbyteorder("<")).tobytes())
