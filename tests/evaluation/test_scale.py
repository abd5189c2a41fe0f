"""SD: hand-worked lines, and SGBM on photographs with measured disparity."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.stats import linregress

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.metrics.scale import fit_scale, scale_settings
from stereogenbench_data.evaluation.models.loading import range_of
from stereogenbench_data.evaluation.models.opencv import Sgbm
from tests.evaluation.conftest import photograph

METHODS = ("filtered", "least_squares")
SIZE = (20, 30)
EVERYWHERE = np.ones(SIZE, dtype=bool)


@pytest.fixture
def truth():
    return np.random.default_rng(0).uniform(3, 40, SIZE).astype(np.float32)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("factor", "slope", "drift"), [(2, 0.5, 0.5), (-1, -1, 2)])
def test_a_disparity_that_is_scaled_drifts_by_its_inverse(truth, method, factor, slope, drift):
    fit = fit_scale(factor * truth, truth, scored=EVERYWHERE, method=method)

    assert fit.slope == pytest.approx(slope, abs=1e-6)
    assert fit.drift == pytest.approx(drift, abs=1e-6)
    assert fit.offset_px == pytest.approx(0, abs=1e-5)
    assert fit.outliers == 0
    assert fit.valid == fit.answered == 1
    assert fit.r2 == pytest.approx(1)


@pytest.mark.parametrize("seed", range(2))
def test_both_fits_are_those_of_scipy_with_and_without_what_lies_off_the_line(seed):
    rng = np.random.default_rng(seed)
    true = rng.uniform(3, 40, SIZE)
    estimated = (true + 4) / 0.8 + rng.uniform(-0.3, 0.3, SIZE)
    off = rng.choice(true.size, 60, replace=False)
    estimated.reshape(-1)[off] += rng.choice([-1, 1], 60) * rng.uniform(20, 90, 60)
    whole = linregress(estimated.ravel(), true.ravel())
    inliers = linregress(np.delete(estimated, off), np.delete(true, off))

    filtered = fit_scale(estimated, true, scored=EVERYWHERE, method="filtered")
    plain = fit_scale(estimated, true, scored=EVERYWHERE, method="least_squares")

    assert plain.slope == pytest.approx(whole.slope, rel=1e-9)
    assert plain.offset_px == pytest.approx(whole.intercept, rel=1e-9)
    assert plain.r2 == pytest.approx(whole.rvalue**2, rel=1e-9)
    assert plain.residual_px == pytest.approx(
        (true - plain.slope * estimated - plain.offset_px).std(), abs=1e-5
    )
    assert filtered.outliers == 60 / 600
    assert filtered.valid == pytest.approx(540 / 600)
    assert filtered.answered == 1
    assert filtered.slope == pytest.approx(inliers.slope, rel=1e-9)
    assert filtered.offset_px == pytest.approx(inliers.intercept, rel=1e-9)
    assert filtered.drift < 0.21
    assert plain.drift > 2 * filtered.drift


def test_only_what_is_scored_and_answered_counts(truth):
    estimated = 2 * truth
    estimated[:5] = np.nan
    scored = EVERYWHERE.copy()
    scored[:, :10] = False
    estimated[:, :10] = 999

    fit = fit_scale(estimated, truth, scored=scored)

    assert fit.drift == pytest.approx(0.5, abs=1e-6)
    assert fit.valid == pytest.approx(300 / 600)
    assert fit.answered == pytest.approx(300 / 400)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("beyond", [0.2, 0.5])
def test_pixels_whose_true_disparity_the_matcher_cannot_find_are_counted_and_not_scored(
    truth, method, beyond
):
    estimated = truth / 2
    far = truth > np.quantile(truth, 1 - beyond)
    estimated[far] = np.random.default_rng(1).uniform(0, 9, np.count_nonzero(far))
    limit_px = float(truth[~far].max())

    fit = fit_scale(estimated, truth, scored=EVERYWHERE, range_px=(-16, limit_px), method=method)
    lower = fit_scale(-estimated, -truth, scored=EVERYWHERE, range_px=(-limit_px, 0), method=method)
    polluted = fit_scale(estimated, truth, scored=EVERYWHERE, method="least_squares")

    assert fit.slope == lower.slope == pytest.approx(2)
    assert fit.beyond == lower.beyond == pytest.approx(beyond)
    assert fit.answered == 1
    assert fit.valid == pytest.approx(1 - beyond)
    assert polluted.beyond == 0
    assert abs(polluted.slope - 2) > 0.5


@pytest.mark.parametrize("method", METHODS)
def test_where_the_matcher_cannot_find_most_pixels_there_is_no_number_and_their_share_is_told(
    truth, method
):
    limit_px = float(np.quantile(truth, 0.49))

    fit = fit_scale(truth, truth, scored=EVERYWHERE, range_px=(0, limit_px), method=method)

    assert math.isnan(fit.drift)
    assert fit.valid == 0
    assert fit.beyond == pytest.approx(0.51, abs=0.002)


def test_a_matcher_of_ones_own_states_its_range_or_finds_all(sgbm):
    states_it = SimpleNamespace(name="a", settings={}, range_px=(0, 64))
    states_none = SimpleNamespace(name="b", settings={})

    assert range_of(sgbm) == (-16, 175)
    assert range_of(states_it) == (0, 64)
    assert range_of(states_none) == (-math.inf, math.inf)
    told = [scale_settings(each) for each in (states_it, states_none)]
    assert [(each["least_px"], each["largest_px"]) for each in told] == [(0, 64), (None, None)]


@pytest.mark.parametrize("method", METHODS)
def test_without_a_line_there_is_no_number(truth, method):
    constant = fit_scale(np.full(SIZE, 3.5), truth, scored=EVERYWHERE, method=method)
    silent = fit_scale(np.full(SIZE, np.nan), truth, scored=EVERYWHERE, method=method)
    unseen = fit_scale(truth, truth, scored=~EVERYWHERE, method=method)

    for fit in (constant, silent, unseen):
        assert math.isnan(fit.drift)
        assert fit.valid == 0


def test_a_few_answers_of_a_large_picture_are_no_scale():
    truth = np.random.default_rng(5).uniform(1, 50, (200, 200))
    estimated = np.full((200, 200), np.nan)
    estimated[0, :200] = truth[0, :200]

    fit = fit_scale(estimated, truth, scored=np.ones((200, 200), dtype=bool))

    assert math.isnan(fit.drift)
    assert fit.answered == pytest.approx(0.005)


@pytest.fixture(scope="module")
def cloth(ground_truth):
    folder = ground_truth / "cloth3"
    left, right = (photograph(folder / f"view{number}.png") for number in (1, 5))
    with Image.open(folder / "disp1.png") as picture:
        return left, right, np.asarray(picture).astype(np.float32) / 2


@pytest.fixture(scope="module")
def sgbm():
    return Sgbm()


def test_sgbm_on_a_photographed_pair_has_the_true_scale(cloth, sgbm):
    left, right, disparity = cloth

    searched = np.arange(left.shape[2]) >= 176

    fit = fit_scale(sgbm(left, right), disparity, scored=(disparity > 0) & searched)

    assert fit.drift < 0.005
    assert fit.residual_px < 0.5
    assert fit.answered > 0.7


def test_sgbm_gives_a_known_shift_and_nothing_where_its_search_leaves_the_picture(sgbm):
    wide = np.random.default_rng(0).integers(0, 256, (3, 60, 364)).astype(np.uint8)

    disparity = sgbm(wide[..., :344], wide[..., 20:])

    assert disparity.dtype == np.float32
    assert disparity.shape == (60, 344)
    assert np.isnan(disparity[:, :176]).all()
    assert np.isnan(disparity[:, -16:]).all()
    assert np.median(disparity[10:-10, 204:314]) == 20
    assert np.isfinite(disparity[10:-10, 204:314]).all()


def test_pictures_narrower_than_the_search_are_refused():
    view = np.zeros((3, 96, 128), dtype=np.uint8)

    with pytest.raises(EvaluationError, match="searches 192 disparities, and the pictures are 128"):
        Sgbm()(view, view)
