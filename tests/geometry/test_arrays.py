"""What holds for every map function alike: libraries, devices, dtypes."""

import numpy as np
import pytest
import torch

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import (
    depth_from_disparity,
    disparity_error_px,
    disparity_from_depth,
    disparity_from_units,
    planar_from_ray,
)
from stereogenbench_data.geometry.projection import (
    backward_warp,
    project_rectified,
    project_through_poses,
    splat,
    visible_from_source,
    visible_in_target,
)

SHAPE = (2, 6, 8)
CAMERA = Intrinsics(9.0, 9.0, 4.0, 3.0, 8, 6)
PAIR = {"focal_px": 9.0, "baseline_m": 0.3}
MOTION = np.eye(4)
MOTION[:3, 3] = -0.3, 0.1, 0.05


def maps(units, image):
    """Return every map that the layer makes of stored depth and a picture, by name."""
    measured = units > 0
    depth_m = disparity_from_units(units, **PAIR, unit_m=0.1, form="inverse")
    lands = {
        "rectified": project_rectified(depth_m, disparity_from_depth(depth_m, **PAIR)),
        "through poses": project_through_poses(
            depth_m, intrinsics=CAMERA, target_intrinsics=CAMERA, target_from_source=MOTION
        ),
    }
    made = {
        "disparity of units": disparity_from_units(units, **PAIR, unit_m=0.1),
        "disparity": disparity_from_depth(depth_m, **PAIR),
        "depth": depth_from_disparity(depth_m, **PAIR),
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
    expected = maps(*inputs)

    made = maps(*(torch.from_numpy(values) for values in inputs))

    assert made.keys() == expected.keys()
    for name, values in made.items():
        assert values.numpy().dtype == expected[name].dtype, name
        np.testing.assert_allclose(values.numpy(), expected[name], rtol=3e-7, err_msg=name)


def test_no_map_grows_to_float64(inputs):
    grown = {name: made.dtype for name, made in maps(*inputs).items() if made.dtype == np.float64}

    assert grown == {}


def test_results_stay_on_the_device_of_the_input(inputs):
    """The meta device takes no array of another one, as a GPU does not."""
    made = maps(*(torch.from_numpy(values).to("meta") for values in inputs))

    assert {str(values.device) for values in made.values()} == {"meta"}
