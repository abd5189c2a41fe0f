"""A scene that was rendered elsewhere: depth, poses and pictures agree to the pixel.

The figures that are compared with were measured apart from this package: bilinear warp, tolerance
2 % plus two depth quanta, the worst of all 81 frames.
"""

import numpy as np
import pytest

from stereogenbench_data import DepthEncoding, SceneViews, StereoPairs

KEPT_AND_PSNR_DB = {(0, 1): (0.70, 31.8), (1, 3): (0.63, 30.8), (0, 5): (0.32, 29.5)}
FIELDS = ("left", "right", "disparity", "visible", "visible_from_left", "pair")


def warped_psnr_db(sample, *, where="visible", factor=1.0):
    """Sample the right view at x - factor * d, linear along the row, and compare where visible."""
    left, right = (sample[name].numpy().astype(np.float64) for name in ("left", "right"))
    disparity, visible = sample["disparity"][0].numpy() * factor, sample[where][0].numpy()
    rows, columns = np.indices(disparity.shape)
    place = np.clip(columns - disparity, 0, columns.shape[1] - 1)
    near = np.minimum(place.astype(int), columns.shape[1] - 2)
    share = place - near
    warped = right[:, rows, near] * (1 - share) + right[:, rows, near + 1] * share
    return 10 * np.log10(255**2 / np.mean((warped - left)[:, visible] ** 2))


@pytest.fixture
def measured(shared_scenes):
    """For each pair, over all frames: kept share; dB as it is, 3 % off, mirrored, by left alone."""
    found = {pair: [] for pair in KEPT_AND_PSNR_DB}
    for sample in StereoPairs(shared_scenes, pairs=list(found), frames="all", fields=FIELDS):
        found[tuple(sample["pair"].tolist())].append(
            (
                float(sample["visible"].float().mean()),
                warped_psnr_db(sample),
                warped_psnr_db(sample, factor=1.03),
                warped_psnr_db(sample, factor=-1.0),
                warped_psnr_db(sample, where="visible_from_left"),
            )
        )
    return {pair: np.array(rows) for pair, rows in found.items()}


def test_all_frames_warp_as_well_as_measured_elsewhere_and_what_is_wrong_shows(measured):
    for pair, (kept, psnr_db) in KEPT_AND_PSNR_DB.items():
        worst = measured[pair].min(axis=0)
        assert len(measured[pair]) == 81
        assert worst[0] == pytest.approx(kept, abs=0.02)
        assert worst[1] == pytest.approx(psnr_db, abs=0.3)
    for pair, lost_db in {(0, 1): 1.0, (1, 3): 3.0, (0, 5): 9.0}.items():
        _, right_db, scaled_db, mirrored_db, _ = measured[pair].T
        assert np.mean(right_db - scaled_db) > 0.8 * lost_db
        assert (right_db - mirrored_db > 12).all()
    # The left depth alone does not know what stands outside of its view.
    assert measured[0, 5][:, 4].min() < 16
    assert measured[0, 5][:, 1].min() > 29


def test_ray_depth_taken_for_planar_depth_shows_too(shared_scenes):
    options = {"pairs": [(0, 5)], "fields": FIELDS}
    planar = StereoPairs(shared_scenes, **options)[0]
    ray = StereoPairs(shared_scenes, depth=DepthEncoding(0.001, kind="ray"), **options)[0]

    assert warped_psnr_db(planar) - warped_psnr_db(ray) > 1


@pytest.mark.parametrize("frame", [1, 8, 40])
def test_depth_reprojected_through_the_poses_agrees_with_another_frame(shared_scenes, frame):
    fields = ("depth", "valid", "intrinsics", "world_from_cam")
    here, there = (
        {name: value.numpy() for name, value in views.items()}
        for views in SceneViews(shared_scenes, cameras=(0,), frames=[0, frame], fields=fields)
    )
    rows, columns = np.nonzero(here["valid"][0, 0])
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    points = np.linalg.inv(here["intrinsics"]) @ pixels * here["depth"][0, 0, rows, columns]

    def median_difference(there_from_here):
        moved = there_from_here[:3, :3] @ points + there_from_here[:3, 3:]
        u, v, _ = there["intrinsics"] @ moved / moved[2]
        inside = (u > 0) & (u < 320) & (v > 0) & (v < 320)
        seen = there["depth"][0, 0, v[inside].astype(int), u[inside].astype(int)]
        return np.median(np.abs(seen / moved[2, inside] - 1))

    world_from_here, world_from_there = here["world_from_cam"][0], there["world_from_cam"][0]

    # what is hidden or moves is less than half of the picture; the rest agrees to a pixel's slope
    assert median_difference(np.linalg.inv(world_from_there) @ world_from_here) < 0.0015
    assert median_difference(np.eye(4)) > 0.02
