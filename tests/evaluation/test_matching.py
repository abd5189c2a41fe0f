"""E_match: by hand with keypoints that are given, and with SIFT on photographs."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from stereogenbench_data.evaluation.metrics.keypoint_matches import (
    MatchedOnce,
    match_error,
    mutual_matches,
)
from stereogenbench_data.evaluation.models.loading import Keypoints
from stereogenbench_data.evaluation.models.opencv import Sift
from tests.evaluation.conftest import photograph


def view(number: int) -> np.ndarray:
    """Return a picture that stands for the view of this number."""
    return np.full((3, 8, 9), number, dtype=np.uint8)


@dataclass
class Listed:
    """A matcher whose keypoints and matches are listed by view, which descriptors name."""

    rows: dict[int, list[float]]
    pairs: dict[int, list[tuple[int, int]]]

    def detect(self, picture):
        number = int(picture[0, 0, 0])
        xy = np.array([(5.0, row) for row in self.rows[number]], dtype=np.float32).reshape(-1, 2)
        return Keypoints(xy, np.full((len(xy), 1), number, dtype=np.float32))

    def match(self, left, right):
        pairs = self.pairs[int(right.descriptors[0, 0])] if len(right.descriptors) else []
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)


LEFT, TARGET, PREDICTED, NOTHING = range(4)


LISTED = Listed(
    rows={LEFT: [1, 2, 3, 4, 5], TARGET: [1, 2, 3, 9], PREDICTED: [1, 4.0, 5.1, 6], NOTHING: []},
    pairs={
        TARGET: [(0, 0), (1, 1), (2, 2), (3, 3)], PREDICTED: [(0, 0), (1, 1), (2, 2), (4, 3)],
    },
)  # fmt: skip


def error_of(predicted, *, target=TARGET):
    matcher = MatchedOnce(LISTED)
    return match_error(view(predicted), left=view(LEFT), target=view(target), matcher=matcher)


def test_matches_are_counted_as_worked_by_hand():
    """Of the target 4 is 5 rows off; of the prediction 2 is 2 rows off, 3 is 2.1."""
    score = error_of(PREDICTED)

    assert (score["keypoints"], score["target_matches"], score["predicted_matches"]) == (5, 3, 3)
    assert score["common_matches"] == 2
    assert score["e_match"] == pytest.approx(100 * (1 - 2 / 4))


def test_where_only_one_side_matches_the_error_is_whole_and_where_none_does_there_is_none():
    assert error_of(NOTHING)["e_match"] == 100
    assert math.isnan(error_of(NOTHING, target=NOTHING)["e_match"])


def described(*values: float) -> Keypoints:
    return Keypoints(
        xy_px=np.zeros((len(values), 2), dtype=np.float32),
        descriptors=np.array(values, dtype=np.float32)[:, None],
    )


@pytest.mark.parametrize(
    ("left", "right", "pairs"),
    [
        pytest.param((0, 10), (10.1, 0.1), [(0, 1), (1, 0)], id="each has its own"),
        pytest.param((0, 2), (1.0, 90), [], id="two want the same, as near"),
        pytest.param((0, 100), (9, 10), [(0, 0)], id="9 to 10 is just 0.9, 90 to 91 is above"),
        pytest.param((0, 100), (8.9, 10, 100), [(0, 0), (1, 2)], id="8.9 to 10 is below 0.9"),
        pytest.param((0, 100), (9.1, 10, 100), [(1, 2)], id="9.1 to 10 is above 0.9"),
        pytest.param((0, 100), (0, 0, 100), [(1, 2)], id="two equally perfect are ambiguous"),
        pytest.param((0, 100), (5,), [], id="no second to compare with"),
        pytest.param((), (5, 7), [], id="nothing"),
    ],
)
def test_mutual_matches_are_those_worked_by_hand(left, right, pairs):
    assert mutual_matches(described(*left), described(*right)).tolist() == [list(p) for p in pairs]


@pytest.fixture(scope="module")
def cones(ground_truth):
    return tuple(photograph(ground_truth / "cones" / f"{side}.png") for side in ("left", "right"))


@pytest.fixture(scope="module")
def sift():
    return Sift()


def test_sift_on_photographs_orders_target_noise_copy_and_another_scene(cones, sift):
    left, right = cones
    matcher = MatchedOnce(sift)
    noise = np.random.default_rng(0).normal(0, 8, right.shape)

    def score(picture):
        return match_error(picture, left=left, target=right, matcher=matcher)

    target, copied, other = score(right), score(left), score(left[:, ::-1, ::-1])
    noisy = score(np.clip(right + noise, 0, 255).astype(np.uint8))
    assert target["e_match"] == 0
    assert 20 < noisy["e_match"] < 45
    assert copied["predicted_matches"] == copied["keypoints"]
    assert copied["e_match"] == pytest.approx(
        100 * (1 - target["target_matches"] / target["keypoints"])
    )
    assert other["e_match"] > 90


def test_sift_points_to_the_middle_of_a_spot(sift):
    """A bright spot whose centre is that of the pixel in column 40, row 30."""
    rows, columns = np.mgrid[:64, :80]
    spot = 255 * np.exp(-((rows - 30) ** 2 + (columns - 40) ** 2) / (2 * 4**2))
    picture = np.repeat(spot.astype(np.uint8)[None], 3, axis=0)

    found = sift.detect(picture)

    np.testing.assert_allclose(found.xy_px[0], (40.5, 30.5), atol=0.02)


def test_a_flat_picture_has_no_keypoint_and_no_match(sift):
    flat = np.full((3, 40, 50), 128, dtype=np.uint8)
    found = sift.detect(flat)

    assert found.xy_px.shape == (0, 2)
    assert sift.match(found, found).shape == (0, 2)
