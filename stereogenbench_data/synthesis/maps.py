"""The built-in maps, in boxes and ellipsoids, and how filters ask them.

`SynthStage` is made for each proposal anew: a backdrop, crates, balls and poles whose sizes follow
the picture, so that it is full at any focal length. The others are places of fixed size, the same
in every scene: the smaller a place, the more proposals it refuses. A map of the release is a stage
in a folder of that name.
"""

import colorsys
import zlib
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.schema.release import TRAIN_MAPS, UNSEEN_MAPS
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.renderer import Bounds, unknown_map
from stereogenbench_data.synthesis.scene import Figure, Kind, Material, RayWorld, Shape

STAGE: Final = "SynthStage"
CHARACTERS: Final = tuple(f"SK_Synth{number:02d}" for number in range(1, 20))
ANIMATIONS: Final = ("AN_Walk", "AN_Stroll", "AN_March")

_OF_RELEASE: Final = TRAIN_MAPS | UNSEEN_MAPS

_GAITS: Final = {"AN_Walk": (0.65, 1.1), "AN_Stroll": (0.35, 1.5), "AN_March": (0.0, 1.2)}
"""Metres a second and seconds a stride."""

_GROUNDS: Final = ("soil", "mosaic", "bricks", "boards")
_WALLS: Final = ("bricks", "plaster", "boards", "mosaic")
_THINGS: Final = ("boards", "weave", "mosaic", "plaster", "soil", "bricks")
_CLOTHES: Final = ("weave", "plaster", "mosaic")
_UP: Final = np.array([0.0, 0.0, 1.0])
_SKIN: Final = Material("plaster", 0.5, (1.5, 1.05, 0.8))
_SUBJECT_M: Final = 1.75
_SUBJECT_PART: Final = 0.62
_BUILDINGS: Final = 26
_NEAR: Final = 12
_FAR: Final = 24

Array = Any


def open_map(proposal: Proposal) -> RayWorld:
    """Return the map of a proposal with its figure.

    Raises:
        SynthesisError: If the map is neither built in nor one of the release.
    """
    name = proposal.map_name
    if name in PLACES:
        return _fixed_place(proposal)
    if name == STAGE or name in _OF_RELEASE:
        return _stage(proposal)
    raise unknown_map(
        "ray-casting", name, (*MAPS, *sorted(_OF_RELEASE)),
        choose=f"{', '.join(MAPS)}, all, or a map of the release for a stage of that name",
    )  # fmt: skip


def _figure(proposal: Proposal) -> Figure:
    rng = np.random.default_rng(zlib.crc32(proposal.character.encode()))
    walk_m_s, stride_s = _GAITS[proposal.animation]
    clothes = (
        _SKIN,
        _material(rng, textures=_CLOTHES, tile_m=(0.3, 0.8)),
        _material(rng, textures=_CLOTHES, tile_m=(0.3, 0.8)),
    )
    return Figure(clothes, walk_m_s, stride_s, scale=float(rng.uniform(0.92, 1.06)))


def _material(
    rng: np.random.Generator, *, textures: tuple[str, ...], tile_m: tuple[float, float]
) -> Material:
    hue, saturation, value = rng.uniform((0, 0.03, 1.15), (1, 0.4, 1.5))
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    texture = textures[int(rng.integers(len(textures)))]
    return Material(texture, float(rng.uniform(*tile_m)), (red, green, blue))


def _sun(rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    """Return a direction to the sun, behind cameras that look along x."""
    towards = rng.uniform(np.radians(-75), np.radians(75))
    height = rng.uniform(np.radians(32), np.radians(58))
    return np.array(
        [-np.cos(height) * np.cos(towards), np.cos(height) * np.sin(towards), np.sin(height)]
    )


def _rotated_axes(*, yaw: float, tilt: float = 0.0) -> Array:
    """Return the axes of a solid that is turned around the vertical and then tilted."""
    c, s = np.cos(yaw), np.sin(yaw)
    upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    c, s = np.cos(tilt), np.sin(tilt)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ upright


def _solid(
    kind: Kind, centre: Array, half_m: Array, material: Material, axes: Array | None = None
) -> Shape:
    """Return a shape, along the axes of the map unless others are given."""
    axes = np.eye(3) if axes is None else axes
    return Shape(kind, np.array(centre), axes, np.array(half_m), material)


def _bounds(low: tuple[float, ...], high: tuple[float, ...]) -> Bounds:
    return np.array([low, high], np.float64)


# The stage.


@dataclass(frozen=True, slots=True)
class _Framing:
    """What cameras around a stage see of it.

    Attributes:
        distance_m: Distance from the cameras to the middle of the stage.
        width_per_m: Width of the picture at one metre, in metres.
        pixel_per_m: Width of a pixel at one metre, in metres.
    """

    distance_m: float
    width_per_m: float
    pixel_per_m: float

    def width_m(self, beyond_m: float) -> float:
        """Return the width of the picture at a distance beyond the middle of the stage."""
        return (beyond_m + self.distance_m) * self.width_per_m


def _around(rng: np.random.Generator, radius_m: float) -> tuple[float, float]:
    """Return a place on a circle around the middle of the stage."""
    turn = rng.uniform(-np.pi, np.pi)
    return abs(radius_m) * np.cos(turn), abs(radius_m) * np.sin(turn)


def _stage(proposal: Proposal) -> RayWorld:
    rng = proposal.rng("map")
    width_m, height_m = proposal.rig.picture_at_1m
    framing = _Framing(
        distance_m=max(
            _SUBJECT_M / _SUBJECT_PART / height_m, 1.2 * (proposal.span_m + 0.6) / width_m, 1.5
        ),
        width_per_m=width_m,
        pixel_per_m=width_m / proposal.request.size_px,
    )
    slope = rng.uniform(-0.07, 0.07, 2)
    sun = _sun(rng)
    shapes = [
        *_backdrop(rng, framing=framing),
        *_objects(rng, framing=framing),
        *_poles(rng, framing=framing),
    ]
    reach_m, aside_m = 4 * framing.distance_m, 0.12 * framing.distance_m
    return RayWorld(
        slope=slope,
        ground=_material(rng, textures=_GROUNDS, tile_m=(2.0, 4.0)),
        # The shapes stand on a level ground; here they are raised to the slanted one.
        static_shapes=tuple(
            replace(shape, centre=shape.centre + _UP * (slope @ shape.centre[:2]))
            for shape in shapes
        ),
        shell=0,
        sun=sun,
        shadow_range_m=3 * framing.distance_m + 4,
        bounds_m=_bounds((-reach_m, -reach_m, -reach_m), (reach_m, reach_m, reach_m)),
        spawn_bounds_m=_bounds((-aside_m, -aside_m, -aside_m), (aside_m, aside_m, reach_m)),
        figure=_figure(proposal),
    )


def _backdrop(rng: np.random.Generator, *, framing: _Framing) -> list[Shape]:
    """Return buildings and walls around the stage, with gaps that show the sky."""
    shapes = []
    for radius_m in framing.distance_m * rng.uniform(1.7, 3.5, _BUILDINGS) + 2:
        view_m = framing.width_m(radius_m)
        half_m = view_m * rng.uniform((0.05, 0.08, 0.08), (0.1, 0.22, 0.3))
        x_m, y_m = _around(rng, radius_m)
        axes = _rotated_axes(yaw=np.arctan2(y_m, x_m) + rng.uniform(-0.5, 0.5))
        wall = _material(rng, textures=_WALLS, tile_m=(2.0, 4.0))
        shapes.append(_solid("box", [x_m, y_m, half_m[2] * 0.98], half_m, wall, axes))
    return shapes


def _objects(rng: np.random.Generator, *, framing: _Framing) -> list[Shape]:
    """Return crates and balls between the cameras and the subject, and behind the cameras."""
    shapes = []
    parts = np.concatenate([rng.uniform(-0.55, -0.15, _NEAR), rng.uniform(0.2, 1.6, _FAR)])
    for beyond_m in parts * framing.distance_m:
        half_m = framing.width_m(beyond_m) * rng.uniform(0.025, 0.075) * rng.uniform(0.7, 1.4, 3)
        x_m, y_m = _around(rng, np.sign(beyond_m) * max(abs(beyond_m), 0.6 + 2 * half_m.max()))
        is_box = rng.random() < 0.55
        tilt = rng.uniform(-0.6, 0.6) if rng.random() < 0.4 else 0.0
        height_m = half_m[2] * rng.uniform(0.75, 0.98)
        axes = _rotated_axes(yaw=rng.uniform(0, np.pi), tilt=tilt)
        material = _material(rng, textures=_THINGS, tile_m=(0.6, 2.0))
        kind: Kind = "box" if is_box else "ellipsoid"
        shapes.append(_solid(kind, [x_m, y_m, height_m], half_m, material, axes))
    return shapes


def _poles(rng: np.random.Generator, *, framing: _Framing) -> list[Shape]:
    """Return thin upright posts, a few pixels wide, some of them nearer than the subject."""
    shapes = []
    for part in (*rng.uniform(-0.6, -0.25, 6), *rng.uniform(0.4, 1.6, 12)):
        beyond_m = part * framing.distance_m
        view_m = framing.width_m(beyond_m)
        relative = rng.uniform(0.002, 0.006) * framing.width_per_m
        width_m = view_m / framing.width_per_m * max(relative, 2.2 * framing.pixel_per_m)
        height_m = view_m * rng.uniform(0.3, 0.8) + 0.5
        x_m, y_m = _around(rng, beyond_m)
        axes = _rotated_axes(yaw=rng.uniform(0, np.pi), tilt=rng.uniform(-0.12, 0.12))
        half_m = (width_m / 2, width_m / 2, height_m / 2)
        material = _material(rng, textures=_WALLS, tile_m=(0.3, 0.8))
        shapes.append(_solid("box", [x_m, y_m, 0.48 * height_m], half_m, material, axes))
    return shapes


# Places of fixed size.


@dataclass(frozen=True, slots=True)
class _Place:
    """A rectangular place around the origin.

    Attributes:
        size_m: Length along x and width along y inside the walls.
        wall_m: Height of the walls; 0 for none.
        height_m: Up to where cameras may be: the ceiling, where there is one.
        roof: "closed" has a ceiling.
        crates: How many boxes and balls stand about.
        posts: How many upright posts or trunks.
        post_m: Their thickness and height.
        crowns: Radius of the balls on top of the posts; 0 for none.
    """

    size_m: tuple[float, float]
    wall_m: float
    height_m: float
    roof: str = "closed"
    crates: int = 8
    posts: int = 0
    post_m: tuple[float, float] = (0.3, 3.0)
    crowns: float = 0.0


PLACES: Final[dict[str, _Place]] = {
    "SynthCorridor": _Place((30.0, 3.4), wall_m=3.0, height_m=3.0, crates=5),
    "SynthRoom": _Place((9.0, 7.0), wall_m=3.2, height_m=3.2, crates=7),
    "SynthYard": _Place(
        (15.0, 13.0), wall_m=3.5, height_m=6.0, roof="open", crates=10, posts=4, post_m=(0.16, 3.2)
    ),
    "SynthHall": _Place(
        (26.0, 16.0), wall_m=6.0, height_m=6.0, crates=14, posts=8, post_m=(0.6, 6.0)
    ),
    "SynthPark": _Place(
        (40.0, 36.0), wall_m=5.0, height_m=12.0, roof="open", crates=16, posts=16,
        post_m=(0.4, 3.2), crowns=1.8,
    ),
}  # fmt: skip
"""The maps of fixed size, from narrow to wide."""

MAPS: Final = (STAGE, *PLACES)


def _fixed_place(proposal: Proposal) -> RayWorld:
    place = PLACES[proposal.map_name]
    rng = np.random.default_rng(zlib.crc32(proposal.map_name.encode()))
    half = np.array(place.size_m) / 2
    shell = _shell(rng, place=place)
    things = [*_crates(rng, place=place), *_posts(rng, place=place)]
    inner = half - 0.3
    return RayWorld(
        slope=np.zeros(2),
        ground=_material(rng, textures=_GROUNDS, tile_m=(2.0, 4.0)),
        static_shapes=(*shell, *things),
        shell=len(shell),
        sun=_sun(rng),
        shadow_range_m=float(half.max()) + 1,
        bounds_m=_bounds((-half[0], -half[1], 0.0), (half[0], half[1], place.height_m)),
        spawn_bounds_m=_bounds((-inner[0], -inner[1], 0.0), (inner[0], inner[1], 2.5)),
        figure=_figure(proposal),
    )


def _shell(rng: np.random.Generator, *, place: _Place) -> list[Shape]:
    """Return four walls, and a ceiling where the place is closed."""
    thick = 0.2
    (long_m, wide_m), high_m = place.size_m, place.wall_m
    long, wide = long_m / 2 + thick, wide_m / 2 + thick
    walls = [
        *(((sign * long, 0.0), (thick, wide_m / 2 + 2 * thick)) for sign in (-1, 1)),
        *(((0.0, sign * wide), (long_m / 2, thick)) for sign in (-1, 1)),
    ]
    places = [((x, y, high_m / 2), (*half, high_m / 2)) for (x, y), half in walls]
    if place.roof == "closed":
        over = (long_m / 2 + 2 * thick, wide_m / 2 + 2 * thick, thick)
        places.append(((0.0, 0.0, high_m + thick), over))
    return [
        _solid("box", centre, half_m, _material(rng, textures=_WALLS, tile_m=(2.0, 4.0)))
        for centre, half_m in places
    ]


def _crates(rng: np.random.Generator, *, place: _Place) -> list[Shape]:
    """Return boxes and balls, most of them towards the walls."""
    shapes = []
    half = np.array(place.size_m) / 2
    for _ in range(place.crates):
        half_m = rng.uniform(0.18, 0.55, 3) * min(1.6, 0.7 + half.min() / 12)
        # The largest of three draws in -1..1 along one axis, so that the middle stays free.
        across = rng.uniform(-1, 1, (3, 2))
        place_xy = across[np.abs(across).max(axis=1).argmax()] * (half - half_m[:2].max() - 0.1)
        is_box = rng.random() < 0.65
        axes = _rotated_axes(yaw=rng.uniform(0, np.pi))
        material = _material(rng, textures=_THINGS, tile_m=(0.6, 2.0))
        kind: Kind = "box" if is_box else "ellipsoid"
        height_m = half_m[2] * (1.0 if is_box else 0.97)
        shapes.append(_solid(kind, [*place_xy, height_m], half_m, material, axes))
    return shapes


def _posts(rng: np.random.Generator, *, place: _Place) -> list[Shape]:
    """Return upright posts on a grid that is a little disturbed, with or without crowns."""
    if not place.posts:
        return []
    shapes = []
    thick, high = place.post_m
    columns = place.posts // 2
    half = np.array(place.size_m) / 2
    wood = _material(rng, textures=_WALLS, tile_m=(0.8, 1.6))
    leaves = _material(rng, textures=_GROUNDS, tile_m=(1.0, 2.0))
    for number in range(place.posts):
        column, row = divmod(number, 2)
        grid = np.array([(column + 0.5) / columns * 2 - 1, row - 0.5])
        x, y = (grid + rng.uniform(-0.1, 0.1, 2)) * half
        axes = _rotated_axes(yaw=rng.uniform(0, np.pi))
        shapes.append(_solid("box", [x, y, high / 2], [thick / 2, thick / 2, high / 2], wood, axes))
        if place.crowns:
            size = place.crowns * rng.uniform(0.7, 1.2, 3)
            shapes.append(_solid("ellipsoid", [x, y, high + 0.5 * size[2]], size, leaves))
    return shapes
