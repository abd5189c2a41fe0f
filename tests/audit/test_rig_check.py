"""A rig's figures against changes made by hand, and intrinsics found wherever they are recorded."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereogenbench_data.audit.geometry.rig_check import motion_px, recorded_px, rig_figures
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.schema.records import Rig
from stereogenbench_data.schema.release import CAMERA_PAIRS

PLACES_CM = np.array([0.0, 10.0, 25.0, 31.0, 60.0, 72.5])
RIG = Rig(
    focal_mm=50.0,
    sensor_width_mm=25.0,
    sensor_height_mm=20.0,
    image_width_px=100,
    image_height_px=80,
    principal_point_px=None,
    baselines_cm=tuple(float(PLACES_CM[b] - PLACES_CM[a]) for a, b in CAMERA_PAIRS),
    primary_pair=(0, 1),
)


def poses(frames=3, *, turned=None):
    """Six cameras on Unreal's y axis that look along x."""
    centres = np.zeros((frames, 6, 3))
    centres[:, :, 1] = PLACES_CM
    rotations = np.tile(np.eye(3), (frames, 6, 1, 1))
    if turned is not None:
        rotations[1, 3] = turned.as_matrix()
    return CameraPoses(centres, 0.01, rotations)


def test_baselines_that_are_off_are_reported_and_nothing_else():
    baselines = list(RIG.baselines_cm)
    baselines[0] += 0.3
    baselines[CAMERA_PAIRS.index((0, 5))] -= 0.6

    found = rig_figures(dataclasses.replace(RIG, baselines_cm=tuple(baselines)), poses(), [])

    assert found["intrinsics_px"] == 0.0
    assert found["baseline_cm"] == pytest.approx(0.6)
    assert max(found["rotation_px"], found["lateral_px"]) < 1e-9


def test_baselines_that_are_rounded_agree_within_their_rounding():
    centres = poses().centres + np.array([0, 1, 0]) * np.arange(6)[:, None] * 0.00123
    rounded = dataclasses.replace(
        RIG,
        baselines_cm=tuple(
            float(np.round(centres[0, b, 1] - centres[0, a, 1], 2)) for a, b in CAMERA_PAIRS
        ),
    )
    posed = dataclasses.replace(poses(), centres=centres)
    off = dataclasses.replace(rounded, baselines_cm=(*rounded.baselines_cm[:-1], 12.52))

    assert rig_figures(rounded, posed, [])["baseline_cm"] == 0.0
    assert rig_figures(off, posed, [])["baseline_cm"] == pytest.approx(0.0188, abs=1e-3)


def test_a_turned_camera_is_reported_in_pixels():
    found = rig_figures(RIG, poses(turned=Rotation.from_euler("z", 1.0, degrees=True)), [])

    # A corner is hypot(50, 40) px from the centre, about which the picture turns.
    moved_px = 2 * math.sin(math.radians(0.5)) * math.hypot(50, 40)
    assert found["rotation_px"] == pytest.approx(moved_px)
    assert found["lateral_px"] < 1e-9


def test_a_camera_above_the_line_is_a_lateral_residual():
    raised = poses()
    raised.centres[2, 4, 2] += 1.0

    found = rig_figures(RIG, raised, [])

    # 1 cm seen from 1 m: fx * 0.01.
    assert found["lateral_px"] == pytest.approx(2.0, rel=1e-3)
    assert found["rotation_px"] < 1e-9


def test_intrinsics_in_pixels_are_compared_where_they_are_declared():
    document = {
        "camera_intrinsics": {"focal_length_mm": 50.0, "fx": 201.0},
        "K": [[250.0, 0, 49.5], [0, 200.0, 40.0], [0, 0, 1]],
        "scene": {"fx": 900.0, "cx_px": 7.0},
    }

    found = sorted(recorded_px(document))

    assert found == [("cx_px", 49.5), ("cy_px", 40.0), ("fx_px", 201.0), ("fy_px", 200.0)]
    assert rig_figures(RIG, poses(), found)["intrinsics_px"] == 1.0


def test_motion_is_the_turn_and_the_way_in_pixels():
    moving = poses()
    moving.centres[1, 0, 0] += 10.0
    turned = poses()
    turned.world_from_cam_rotations[1, 0] = Rotation.from_euler("y", 0.1).as_matrix()
    of = {"intrinsics": rig_intrinsics(RIG)}

    assert motion_px(moving, 0, (0, 1), **of, far_m=2.0) == pytest.approx(200 * 0.1 / 2)
    assert motion_px(moving, 0, (0, 1), **of, far_m=math.nan) == 0.0
    assert motion_px(turned, 0, (0, 1), **of, far_m=2.0) == pytest.approx(200 * 0.1)
    assert motion_px(turned, 1, (0, 1), **of, far_m=2.0) == 0.0
