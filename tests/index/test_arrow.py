"""Arrow's columns as numpy arrays."""

import pyarrow as pa
import pytest

from stereogenbench_data.index.arrow import as_categories, as_numpy

TEXTS = ["ffv1", None, "h264", "ffv1", None, "ffv1"]


@pytest.mark.parametrize("chunks", [[TEXTS], [TEXTS[:2], TEXTS[2:]]], ids=["one", "two"])
def test_texts_keep_their_values_and_what_is_unknown(chunks):
    column = pa.chunked_array(chunks, type=pa.string())
    values, which = as_categories(column)

    assert sorted(values) == ["ffv1", "h264"]
    assert [None if place < 0 else values[place] for place in which.tolist()] == TEXTS
    assert as_numpy(column).tolist() == TEXTS
    assert as_numpy(column[2:5]).tolist() == TEXTS[2:5]


def test_texts_in_lists_of_a_fixed_length_keep_their_shape():
    column = pa.array([TEXTS[:3], TEXTS[3:]], type=pa.list_(pa.string(), 3))

    assert as_numpy(column).tolist() == [TEXTS[:3], TEXTS[3:]]
    assert as_categories(column)[1].shape == (2, 3)
