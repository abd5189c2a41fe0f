"""What stands before the cameras: a slanted ground, a backdrop, boxes, balls, poles, a walker.

Stage axes are Unreal's (x forward, y right, z up), metres, the subject's walk around the origin
and the cameras at negative x. Sizes follow the picture's width at the depth where a thing stands,
so that a view is full at any focal length.
"""

import colorsys
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.synthesis.shapes import Material, Shape, limb

Array = Any

_GROUNDS: Final = ("soil", "mosaic", "bricks", "boards")
_WALLS: Final = ("bricks", "plaster", "boards", "mosaic")
_THINGS: Final = ("boards", "weave", "mosaic", "plaster", "soil", "bricks")
_CLOTHES: Final = ("weave", "plaster", "mosaic")
_UP: Final = np.array([0.0, 0.0, 1.0])
_STRIDE_S: Final = 1.1


@dataclass(frozen=True, slots=True)
class Lens:
    """How wide the picture is, as far as a stage must know.

    Attributes:
        distance_m: From the cameras to the subject.
        width_per_m: Width of the picture at one metre, in metres.
        span_m: From the first camera to the last.
        pixel_per_m: Width of a pixel at one metre, in metres.
    """

    distance_m: float
    width_per_m: float
    span_m: float
    pixel_per_m: float

    def width_m(self, x_m: float) -> float:
        """Return how wide the picture is at a place on the stage."""
        return (x_m + self.distance_m) * self.width_per_m


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """A drawn stage.

    Attributes:
        slope: (2,) rise of the ground a metre, along x and y.
        ground: The ground's material; the sky has its own.
        fixed: What does not move.
        clothes: Three materials of the walker: skin, upper and lower clothes.
        walk_m_s: How fast the walker goes, to the right where positive.
        sun: (3,) unit direction to the sun.
        reach_m: How far from the origin shadows are drawn.
    """

    slope: Float64[np.ndarray, "2"]
    ground: Material
    fixed: tuple[Shape, ...]
    clothes: tuple[Material, Material, Material]
    walk_m_s: float
    sun: Float64[np.ndarray, "3"]
    reach_m: float

    def ground_m(self, x_m: float, y_m: float) -> float:
        """Return the ground's height at a place."""
        return float(self.slope @ (x_m, y_m))

    def walker(self, moment_s: float) -> list[Shape]:
        """Return the walker's limbs at a moment."""
        y_m = self.walk_m_s * moment_s
        hips = np.array([0.0, y_m, self.ground_m(0.0, y_m) + 0.93])
        swing = 2 * np.pi * moment_s / _STRIDE_S
        return _limbs(hips, swing=swing, heading=np.sign(self.walk_m_s), clothes=self.clothes)


def draw_stage(rng: np.random.Generator, *, lens: Lens, walk_m_s: float) -> Stage:
    """Draw a stage for a lens: everything but the cameras."""
    slope = rng.uniform(-0.07, 0.07, 2)
    towards = rng.uniform(np.radians(-75), np.radians(75))
    height = rng.uniform(np.radians(32), np.radians(58))
    sun = np.array(
        [-np.cos(height) * np.cos(towards), np.cos(height) * np.sin(towards), np.sin(height)]
    )
    fixed = [
        *_backdrop(rng, lens=lens),
        *_things(rng, lens=lens),
        *_poles(rng, lens=lens),
    ]
    return Stage(
        slope=slope,
        ground=_material(rng, textures=_GROUNDS, tile_m=(2.0, 4.0)),
        fixed=tuple(_placed(shape, slope=slope) for shape in fixed),
        clothes=(
            Material("plaster", 0.5, (1.5, 1.05, 0.8)),
            _material(rng, textures=_CLOTHES, tile_m=(0.3, 0.8)),
            _material(rng, textures=_CLOTHES, tile_m=(0.3, 0.8)),
        ),
        walk_m_s=walk_m_s,
        sun=sun,
        reach_m=3 * lens.distance_m + 4,
    )


def _material(
    rng: np.random.Generator, *, textures: tuple[str, ...], tile_m: tuple[float, float]
) -> Material:
    hue, saturation, value = rng.uniform((0, 0.03, 1.15), (1, 0.4, 1.5))
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    texture = textures[int(rng.integers(len(textures)))]
    return Material(texture, float(rng.uniform(*tile_m)), (red, green, blue))


def _placed(shape: Shape, *, slope: Float64[np.ndarray, "2"]) -> Shape:
    """Raise a shape that was made for a level ground at height 0 to the slanted one."""
    lifted = shape.centre + _UP * (slope @ shape.centre[:2])
    return Shape(shape.kind, lifted, shape.axes, shape.half_m, shape.material)


def _turned(*, yaw: float, tilt: float = 0.0) -> Array:
    """Return a solid's axes, turned around the vertical and then tilted."""
    c, s = np.cos(yaw), np.sin(yaw)
    upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    c, s = np.cos(tilt), np.sin(tilt)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ upright


def _backdrop(rng: np.random.Generator, *, lens: Lens) -> list[Shape]:
    """Buildings and walls behind the subject, with gaps where the sky is seen."""
    shapes = []
    for x_m in lens.distance_m * rng.uniform(1.5, 3.5, 9) + 2:
        view_m = lens.width_m(x_m)
        half_m = view_m * rng.uniform((0.05, 0.08, 0.08), (0.1, 0.22, 0.3))
        y_m = rng.uniform(-0.6, 0.6) * (view_m + lens.span_m)
        shapes.append(
            Shape(
                "box",
                np.array([x_m, y_m, half_m[2] * 0.98]),
                _turned(yaw=rng.uniform(-0.5, 0.5)),
                half_m,
                _material(rng, textures=_WALLS, tile_m=(2.0, 4.0)),
            )
        )
    return shapes


def _things(rng: np.random.Generator, *, lens: Lens) -> list[Shape]:
    """Crates and balls before and behind the subject, from near to far."""
    shapes = []
    near, far = -0.55 * lens.distance_m, 1.6 * lens.distance_m
    for place in (np.arange(16) + rng.uniform(0, 1, 16)) / 16:
        x_m = near + place * (far - near)
        view_m = lens.width_m(x_m)
        half_m = view_m * rng.uniform(0.025, 0.075) * rng.uniform(0.7, 1.4, 3)
        y_m = rng.uniform(-0.5, 0.5) * (view_m + lens.span_m)
        if abs(x_m) < 0.4 + half_m.max():
            x_m = 0.6 + 2 * half_m.max()
        is_box = rng.random() < 0.55
        tilt = rng.uniform(-0.6, 0.6) if rng.random() < 0.4 else 0.0
        shapes.append(
            Shape(
                "box" if is_box else "ellipsoid",
                np.array([x_m, y_m, half_m[2] * rng.uniform(0.75, 0.98)]),
                _turned(yaw=rng.uniform(0, np.pi), tilt=tilt),
                half_m,
                _material(rng, textures=_THINGS, tile_m=(0.6, 2.0)),
            )
        )
    return shapes


def _poles(rng: np.random.Generator, *, lens: Lens) -> list[Shape]:
    """Thin upright posts, a few pixels wide, half of them nearer than the subject."""
    shapes = []
    for x_part in (*rng.uniform(-0.6, -0.25, 3), *rng.uniform(0.4, 1.6, 4)):
        x_m = x_part * lens.distance_m + (0.8 if x_part > 0 else 0.0)
        depth_m = x_m + lens.distance_m
        relative = rng.uniform(0.002, 0.006) * lens.width_per_m
        width_m = depth_m * max(relative, 2.2 * lens.pixel_per_m)
        height_m = lens.width_m(x_m) * rng.uniform(0.3, 0.8) + 0.5
        y_m = rng.uniform(-0.45, 0.45) * (lens.width_m(x_m) + lens.span_m)
        shapes.append(
            Shape(
                "box",
                np.array([x_m, y_m, 0.48 * height_m]),
                _turned(yaw=rng.uniform(0, np.pi), tilt=rng.uniform(-0.12, 0.12)),
                np.array([width_m / 2, width_m / 2, height_m / 2]),
                _material(rng, textures=_WALLS, tile_m=(0.3, 0.8)),
            )
        )
    return shapes


def _limbs(
    hips: Float64[np.ndarray, "3"],
    *,
    swing: float,
    heading: float,
    clothes: tuple[Material, Material, Material],
) -> list[Shape]:
    """Put a walking figure together, about 1.75 m tall, that walks along y."""
    skin, upper, lower = clothes
    ahead, side = np.array([0.0, heading, 0.0]), np.array([1.0, 0.0, 0.0])
    hips = hips + _UP * 0.025 * np.cos(2 * swing)
    neck = hips + 0.52 * _UP + 0.03 * ahead
    shapes = [
        limb(hips, neck, radius_m=0.17, material=upper),
        limb(hips - 0.04 * _UP, hips + 0.1 * _UP, radius_m=0.16, material=lower),
        limb(neck + 0.1 * _UP, neck + 0.27 * _UP, radius_m=0.1, material=skin),
    ]
    for sign in (-1.0, 1.0):
        phase = sign * np.sin(swing)
        lag = sign * np.sin(swing - 0.9)
        hip = hips + 0.1 * sign * side
        knee = hip + 0.43 * _lean(0.5 * phase, ahead)
        heel = knee + 0.42 * _lean(0.5 * phase - 0.35 - 0.35 * lag, ahead)
        shoulder = neck + 0.2 * sign * side - 0.04 * _UP
        elbow = shoulder + 0.29 * _lean(-0.5 * phase, ahead) + 0.04 * sign * side
        hand = elbow + 0.27 * _lean(0.3 - 0.5 * phase, ahead)
        shapes += [
            limb(hip, knee, radius_m=0.09, material=lower),
            limb(knee, heel, radius_m=0.065, material=lower),
            limb(heel, heel + 0.17 * ahead, radius_m=0.05, material=skin),
            limb(shoulder, elbow, radius_m=0.055, material=upper),
            limb(elbow, hand, radius_m=0.045, material=skin),
        ]
    return shapes


def _lean(angle: float, ahead: Array) -> Array:
    """Return the direction of a limb that hangs down, swung ahead by an angle."""
    return np.sin(angle) * ahead - np.cos(angle) * _UP
