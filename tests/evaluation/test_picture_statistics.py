"""The stand-ins for learned features: by hand, and never under learned features' names."""

import numpy as np
import pytest

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics, frechet_distance
from stereogenbench_data.evaluation.models.interfaces import ImageFeatures, VideoFeatures
from stereogenbench_data.evaluation.models.picture_statistics import (
    ColourStatistics,
    MotionStatistics,
)


def test_tiles_and_differences_are_those_worked_by_hand():
    """Columns go up by 10, rows by 3, in red alone; 8 x 8 pixels, tiles of 2 x 2."""
    rows, columns = np.mgrid[:8, :8]
    picture = np.zeros((1, 3, 8, 8), dtype=np.uint8)
    picture[0, 0] = 10 * columns + 3 * rows

    (features,) = ColourStatistics()(picture)

    red = [10 * (2 * c + 0.5) + 3 * (2 * r + 0.5) for r in range(4) for c in range(4)]
    np.testing.assert_allclose(features[:48], red + 32 * [0])
    along_rows = [(10 * step, 0, 0) for step in (1, 2, 4)]
    along_columns = [(3 * step, 0, 0) for step in (1, 2, 4)]
    np.testing.assert_allclose(features[48:], np.ravel(along_rows + along_columns))


def test_sizes_that_tiles_do_not_divide_are_averaged_over_what_each_tile_has():
    picture = np.full((1, 3, 9, 11), 77, dtype=np.uint8)

    np.testing.assert_allclose(ColourStatistics()(picture)[0, :48], 77)


def test_motion_is_the_mean_change_from_frame_to_frame():
    clip = np.zeros((1, 3, 3, 8, 8), dtype=np.uint8)
    clip[0, 1] = 30
    clip[0, 2] = 40

    (features,) = MotionStatistics()(clip)

    np.testing.assert_allclose(features[:48], 70 / 3)
    np.testing.assert_allclose(features[48:66], 0)
    np.testing.assert_allclose(features[66:], (30 + 10) / 2)


def test_the_more_pictures_are_changed_the_farther_they_are():
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 200, (80, 3, 16, 16)).astype(np.uint8)
    features = ColourStatistics()

    def apart(others):
        sides = (FeatureStatistics.of(features(side)) for side in (others, pictures))
        return frechet_distance(*sides).value

    assert apart(pictures) < 1e-6 < apart(pictures + np.uint8(5)) < apart(pictures + np.uint8(50))


@pytest.mark.parametrize(
    ("features", "protocol"),
    [(ColourStatistics(), ImageFeatures), (MotionStatistics(), VideoFeatures)],
)
def test_stand_ins_say_that_they_are(features, protocol):
    assert isinstance(features, protocol)
    assert "stand-in" in features.name
    assert not {"FID", "FVD"} & set(features.name.split())


def test_what_is_too_small_too_short_or_no_picture_is_named():
    with pytest.raises(EvaluationError, match="at least 8 px, got 20x7"):
        ColourStatistics()(np.zeros((1, 3, 7, 20), dtype=np.uint8))
    with pytest.raises(EvaluationError, match=r"\(n, 3, h, w\), got uint8 of shape \(3, 8, 8\)"):
        ColourStatistics()(np.zeros((3, 8, 8), dtype=np.uint8))
    with pytest.raises(EvaluationError, match="at least 2 frames, got 1"):
        MotionStatistics()(np.zeros((1, 1, 3, 8, 8), dtype=np.uint8))
    with pytest.raises(EvaluationError, match=r"\(n, t, 3, h, w\), got uint8 of shape \(1, 3"):
        MotionStatistics()(np.zeros((1, 3, 8, 8), dtype=np.uint8))
