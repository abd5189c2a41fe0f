"""What holds for every map function alike: libraries, devices, dtypes."""

import numpy as np
import pytest
import torch

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import (
    disparity_error_px,
    disparity_from_depth,
    disparity_from_shifts,
    planar_from_ray,
)
from stereogenbench_data.geometry.projection import (
    backward_warp,
    homography,
    project_by_homography,
    project_rectified,
    splat,
    visible_from_source,
    visible_in_target,
)

SHAPE = (2, 6, 8)
CAMERA = Intrinsics(9.0, 9.0, 4.0, 3.0, 8, 6)
PAIR = {"focal_px": 9.0, "baseline_m": 0.3}
MOTION = np.eye(4)
MOTION[:3, 3] = -0.3, 0.1, 0.05


def maps(units, image, array):
    """Return every map that the layer makes of stored depth and a picture, by name."""
    measured, stored = units > 0, units * array(np.ones(()))
    depth_m = disparity_from_shifts(stored, array(np.array(27.0)), form="inverse")
    moved = map(array, homography(CAMERA, CAMERA, MOTION))
    lands = {
        "rectified": project_rectified(depth_m, disparity_from_depth(depth_m, **PAIR)),
        "through poses": project_by_homography(depth_m, *moved),
    }
    made = {
        "disparity of units": disparity_from_shifts(stored + 1, array(np.array([[[27.0]]]))),
        "disparity": disparity_from_depth(depth_m, **PAIR),
        "error": disparity_error_px(depth_m, shift_px_m=2.7, half_step_m=0.05),
        "planar": planar_from_ray(depth_m, CAMERA),
    }
    for name, projection in lands.items():
        judged = {"measured": measured, "quantum_m": 0.1}
        made[f"u {name}"] = projection.u_px
        made[f"visible {name}"] = visible_in_target(
            projection, target_depth_m=depth_m, target_measured=measured, **judged
        )
        made[f"visible from source {name}"] = visible_from_source(projection, **judged)
        made[f"splat {name}"], made[f"hole {name}"] = splat(image, projection, measured=measured)
        made[f"warp {name}"], made[f"inside {name}"] = backward_warp(image, projection)
    return made


@pytest.fixture(scope="module")
def inputs():
    rng = np.random.default_rng(7)
    return rng.integers(0, 40, SHAPE), rng.integers(0, 256, (2, 3, 6, 8)).astype(np.uint8)


def test_torch_gives_what_numpy_gives(inputs):
    expected = maps(*inputs, np.asarray)

    made = maps(*map(torch.from_numpy, inputs), torch.from_numpy)

    assert made.keys() == expected.keys()
    for name, values in made.items():
        assert values.numpy().dtype == expected[name].dtype != np.float64, name
        np.testing.assert_allclose(values.numpy(), expected[name], rtol=3e-7, err_msg=name)


def test_results_stay_on_the_device_of_the_input(inputs):
    """The meta device takes no array of another one, as a GPU does not."""

    def there(values):
        return torch.from_numpy(values).to("meta")

    made = maps(*map(there, inputs), there)

    assert {str(values.device) for values in made.values()} == {"meta"}
