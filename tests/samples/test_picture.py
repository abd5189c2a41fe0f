"""Contact sheets."""

import numpy as np
import pytest
from PIL import Image

from stereogenbench_data import FieldError, StereoPairs
from stereogenbench_data.samples.picture import COLOUR_STOPS, coloured, contact_sheet, write_png


def test_colours_run_from_zero_to_the_largest_and_grey_is_not_measured():
    picture = coloured(
        np.array([[0.0, 10.0, 20.0, 5.0]]),
        measured=np.array([[True, True, True, False]]),
        largest=10.0,
    )

    assert picture[0, 0].tolist() == COLOUR_STOPS[0].tolist()
    assert picture[0, 1].tolist() == picture[0, 2].tolist() == COLOUR_STOPS[-1].tolist()
    assert picture[0, 3].tolist() == [96, 96, 96]


def test_a_sheet_has_a_row_for_each_sample_and_a_tile_for_each_picture(indexed_release, tmp_path):
    pairs = StereoPairs(indexed_release, fields=("left", "right", "disparity", "visible", "scene"))
    sheet = contact_sheet([pairs[0], pairs[1], pairs[2]])
    write_png(tmp_path / "sheet.png", sheet)

    # tiles of 64 px are enlarged threefold, to make room for their captions
    assert sheet.shape == (3 * (192 + 20 + 4), 4 * (192 + 4), 3)
    left = pairs[0]["left"].numpy().transpose(1, 2, 0)
    assert np.array_equal(sheet[20:212, :192], np.kron(left, np.ones((3, 3, 1), dtype=np.uint8)))
    with Image.open(tmp_path / "sheet.png") as written:
        assert np.array_equal(np.asarray(written), sheet)


def test_a_clip_is_not_a_row_of_tiles(indexed_release):
    clip = StereoPairs(indexed_release, frames=("clips", 2))[0]

    with pytest.raises(FieldError, match="show one pair of one frame"):
        contact_sheet([clip])


def test_nothing_to_show_says_what_could_be(indexed_release):
    with pytest.raises(FieldError, match="needs one of the fields left, right, disparity"):
        contact_sheet([StereoPairs(indexed_release, fields=["scene"])[0]])
