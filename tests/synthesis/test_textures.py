import numpy as np
import pytest

from stereogenbench_data.synthesis.render import cast_shadow, static_light
from stereogenbench_data.synthesis.scene import Material, SceneModel, Shape
from stereogenbench_data.synthesis.textures import TEXTURES, sample_atlas, texture_row


def sampled(name, *, footprint_tiles, shift=(0.0, 0.0), side=96):
    u, v = np.meshgrid(*[np.linspace(0, 1, side, endpoint=False)] * 2)
    return sample_atlas(
        (u.ravel() + shift[0]).astype(np.float32),
        (v.ravel() + shift[1]).astype(np.float32),
        row=texture_row(name),
        log_footprint=np.full(side * side, np.log2(footprint_tiles), np.float32),
    )


@pytest.mark.parametrize("name", TEXTURES)
def test_the_larger_a_pixel_the_less_detail_and_the_same_mean(name):
    drawn = [sampled(name, footprint_tiles=tiles) for tiles in (0.002, 0.03, 0.3, 5.0)]

    for colours in drawn:
        np.testing.assert_allclose(colours.mean(axis=1), drawn[0].mean(axis=1), atol=0.02)
    spread = [colours.std(axis=1).max() for colours in drawn]
    assert spread[0] > 0.05
    assert spread == sorted(spread, reverse=True)
    assert spread[-1] < 0.01


def test_a_box_shades_the_ground_on_the_side_away_from_the_sun():
    stone = Material("plaster", 1.0, (1.0, 1.0, 1.0))
    sun = np.array([-0.6, 0.48, 0.64])
    scene = SceneModel(np.array([0.05, -0.02]), stone, (), 0, sun, shadow_range_m=16.0)
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
