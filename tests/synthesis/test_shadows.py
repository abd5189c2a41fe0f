from dataclasses import replace

import numpy as np

from stereogenbench_data.synthesis.maps import open_map
from stereogenbench_data.synthesis.planning import propose
from stereogenbench_data.synthesis.render import cast_shadow, static_light
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.scene import Material, Shape


def test_a_box_shades_the_ground_on_the_side_away_from_the_sun():
    stone = Material("plaster", 1.0, (1.0, 1.0, 1.0))
    sun = np.array([-0.6, 0.48, 0.64])
    empty = open_map(propose(SynthRequest(), index=0, number=0))
    slope = np.array([0.05, -0.02])
    scene = replace(empty, slope=slope, static_shapes=(), sun=sun, shadow_range_m=16.0)
    box = Shape("box", np.array([0.0, 0.0, 1.0]), np.eye(3), np.full(3, 1.0), stone)
    light = static_light(scene)

    cast_shadow(light, shape=box, scene=scene)

    away_m = 1.6 * -scene.sun[:2] / np.linalg.norm(scene.sun[:2])
    behind, before = (
        light[row, column]
        for column, row in (
            ((place_m / scene.shadow_range_m + 1) / 2 * len(light)).astype(int)
            for place_m in (away_m, -away_m)
        )
    )
    assert behind < 0.5
    assert before == 1.0
