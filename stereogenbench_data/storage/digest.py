"""A digest of a table's content that does not depend on how the table is stored."""

import hashlib
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc


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
    digest.update(np.packbits(values.is_valid().to_numpy(zero_copy_only=False)).tobytes())
    if pa.types.is_struct(kind):
        for field in values.flatten():
            _feed(digest, field)
    elif pa.types.is_list(kind):
        _feed_numbers(digest, pc.list_value_length(values))
        _feed(digest, values.flatten())
    elif pa.types.is_fixed_size_list(kind):
        _feed(digest, values.flatten())
    elif pa.types.is_string(kind):
        texts = values.fill_null("").cast(pa.binary())
        _feed_numbers(digest, pc.binary_length(texts))
        whole = pa.ListArray.from_arrays([0, len(texts)], texts)
        digest.update(pc.binary_join(whole, b"")[0].as_py())
    else:
        _feed_numbers(digest, values.fill_null(0))


def _feed_numbers(digest: "hashlib._Hash", values: Any) -> None:
    numbers = values.to_numpy(zero_copy_only=False)
    digest.update(numbers.astype(numbers.dtype.newbyteorder("<")).tobytes())
