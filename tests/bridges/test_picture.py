"""The colours of contact sheets."""

import numpy as np

from stereogenbench_data.bridges.picture import COLOUR_STOPS, ColourScale


def test_colours_run_from_the_low_end_to_the_high_one_and_grey_is_not_measured():
    picture = ColourScale(0.0, 10.0).paint(
        np.array([[0.0, 10.0, 20.0, 5.0]]), measured=np.array([[True, True, True, False]])
    )

    assert picture[0, 0].tolist() == COLOUR_STOPS[0].tolist()
    assert picture[0, 1].tolist() == picture[0, 2].tolist() == COLOUR_STOPS[-1].tolist()
    assert picture[0, 3].tolist() == [96, 96, 96]
