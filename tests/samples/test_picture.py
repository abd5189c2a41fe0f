"""Contact sheets."""

import numpy as np
from PIL import Image

from stereogenbench_data import StereoPairs
from stereogenbench_data.samples.picture import (
    COLOUR_STOPS,
    ColourScale,
    draw_sheet,
    pair_tiles,
    write_png,
)


def test_colours_run_from_the_low_end_to_the_high_one_and_grey_is_not_measured():
    picture = ColourScale(0.0, 10.0).paint(
        np.array([[0.0, 10.0, 20.0, 5.0]]), measured=np.array([[True, True, True, False]])
    )

    assert picture[0, 0].tolist() == COLOUR_STOPS[0].tolist()
    assert picture[0, 1].tolist() == picture[0, 2].tolist() == COLOUR_STOPS[-1].tolist()
    assert picture[0, 3].tolist() == [96, 96, 96]


def test_a_sheet_has_a_tile_for_each_picture_of_a_pair(indexed_release, tmp_path):
    fields = ("left", "right", "disparity", "valid", "baseline_m")
    pair = StereoPairs(indexed_release, fields=fields)[0]
    sheet = draw_sheet([], [pair_tiles(pair, fx_px=70.0)], width_px=192)
    write_png(tmp_path / "sheet.png", sheet)

    left = pair["left"].numpy().transpose(1, 2, 0)
    assert sheet.shape[1] == 13 + 3 * (192 + 13)
    assert np.array_equal(sheet[35:227, 13:205], np.kron(left, np.ones((3, 3, 1), dtype=np.uint8)))
    with Image.open(tmp_path / "sheet.png") as written:
        assert np.array_equal(np.asarray(written), sheet)
