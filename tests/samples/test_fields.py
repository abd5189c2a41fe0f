"""The table of fields: every row says all that is needed to make its field."""

import pytest

from stereogenbench_data import PAIR_FIELDS, VIEW_FIELDS, FieldError
from stereogenbench_data.samples.fields import parse_request
from stereogenbench_data.samples.transforms import HorizontalFlip

ROWS = [*PAIR_FIELDS.items(), *VIEW_FIELDS.items()]


@pytest.mark.parametrize(("name", "field"), ROWS, ids=[name for name, _ in ROWS])
def test_a_row_names_its_field_and_says_how_it_is_made(name, field):
    assert field.name == name
    assert (field.make is None) != (field.write is None)
    assert field.meaning
    assert (field.dtype == "str") == (field.shape == "")
    assert name in repr(field)
    assert "lambda" not in repr(field)


def test_a_picture_field_needs_its_own_video_alone():
    for table in (PAIR_FIELDS, VIEW_FIELDS):
        for field in table.values():
            if field.picture_of is not None:
                assert field.dtype == "uint8"
                assert f"{field.picture_of}_rgb" in field.streams
                assert not any(stream.endswith("depth") for stream in field.streams)


def test_views_cannot_be_flipped():
    with pytest.raises(FieldError, match=r"SceneViews .*got HorizontalFlip"):
        parse_request(
            "views", "stacked", fields=("image",), options={"transform": HorizontalFlip()}
        )
