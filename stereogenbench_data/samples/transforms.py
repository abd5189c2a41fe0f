"""Transforms that move pictures, stored depth and cameras together.

Each maps `Views` to `Views` with the random numbers of one sample, so the same seed gives the same
sample in every process. Pictures are averaged when they shrink; stored depth takes
the nearest pixel centre, never a mixture of two depths. A pixel that was averaged with padding is
no more measured than the padding. Every frame and camera of a sample is treated alike, unless a
docstring says otherwise.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch

from stereogenbench_data.errors import FieldError
from stereogenbench_data.media.depth import resized_nearest
from stereogenbench_data.samples.derive import StoredDepth, Views
from stereogenbench_data.samples.fields import Transform

Generator = np.random.Generator


@dataclass(frozen=True, slots=True, init=False)
class Compose:
    """Transforms one after the other.

    Raises:
        FieldError: If an `Eraser` stands before a `HorizontalFlip`: the erased patch would land in
            the first view, whose disparity would still count as valid.
    """

    transforms: Sequence[Transform]

    def __init__(self, transforms: Sequence[Transform], *others: Any) -> None:
        """Take a list; refuse non-transforms, and an order that would give wrong samples."""
        object.__setattr__(self, "transforms", transforms)
        if others or not isinstance(transforms, Sequence) or isinstance(transforms, str):
            given = ", ".join(map(repr, (transforms, *others)))
            raise FieldError(f"Compose takes one list: write Compose([{given}]).")
        odd = [step for step in self.transforms if not isinstance(step, Transform)]
        if odd or any(isinstance(step, type) for step in self.transforms):
            raise FieldError(f"Compose takes transforms, got {(odd or self.transforms)[0]!r}.")
        erased = False
        for transform in self.steps():
            if erased and transform.swaps_views:
                raise FieldError(
                    f"Eraser stands before {transform!r}, which would carry its patches into the "
                    f"first view: put Eraser last."
                )
            erased = erased or isinstance(transform, Eraser)

    def steps(self) -> Iterator[Transform]:
        """Walk through the transforms, also through those of a Compose within."""
        for transform in self.transforms:
            if isinstance(transform, Compose):
                yield from transform.steps()
            else:
                yield transform

    @property
    def swaps_views(self) -> bool:
        """Whether any of them does."""
        return any(transform.swaps_views for transform in self.transforms)

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Apply each in turn."""
        for transform in self.transforms:
            views = transform(views, generator)
        return views


@dataclass(frozen=True, slots=True, init=False)
class _Sized:
    """What makes views of a size in pixels: (height, width), one side of a square, or both."""

    height: int
    width: int
    swaps_views: ClassVar[bool] = False

    def __init__(self, height: int | Sequence[int], width: int | None = None) -> None:
        """Require at least one pixel."""
        sides: Any = (height, height if width is None else width)
        if width is None and isinstance(height, Sequence):
            sides = height
        if isinstance(sides, str) or len(sides) != 2:
            raise FieldError(f"a size is (height, width) in pixels, got {height!r}.")
        _require_size(*sides)
        object.__setattr__(self, "height", int(sides[0]))
        object.__setattr__(self, "width", int(sides[1]))


@dataclass(frozen=True, slots=True, init=False)
class Resize(_Sized):
    """Stretch to a size in pixels; fx, cx and fy, cy scale by the realised factors."""

    def __init__(self, height: int | Sequence[int], width: int | None = None) -> None:
        """Require both sides: with one alone, torchvision would keep the aspect ratio."""
        if width is None and not isinstance(height, Sequence):
            raise FieldError(f"Resize needs height and width: write Resize({height}, {height}).")
        _Sized.__init__(self, height, width)

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return resized views."""
        return _resized(views, height=self.height, width=self.width)


@dataclass(frozen=True, slots=True, init=False)
class Letterbox(_Sized):
    """Scale to fit a size in pixels without stretching, centred; the rest is black, unmeasured.

    So is, after a later resize, every pixel that has part of that black in it.
    """

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return scaled and padded views."""
        old = views.intrinsics
        scale = min(self.height / old.height_px, self.width / old.width_px)
        height = max(1, min(self.height, round(old.height_px * scale)))
        width = max(1, min(self.width, round(old.width_px * scale)))
        return _windowed(
            _resized(views, height=height, width=width),
            top=(height - self.height) // 2,
            left=(width - self.width) // 2,
            size=(self.height, self.width),
        )


@dataclass(frozen=True, slots=True)
class Crop:
    """Cut the same window from every view; it must lie inside the picture."""

    top: int
    left: int
    height: int
    width: int
    swaps_views: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Require at least one pixel."""
        _require_size(self.height, self.width)
        _require_size(self.top + 1, self.left + 1)

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return cropped views."""
        old = views.intrinsics
        if self.top + self.height > old.height_px or self.left + self.width > old.width_px:
            raise FieldError(
                f"{self} reaches beyond a picture of {old.width_px} x {old.height_px} pixels."
            )
        return _windowed(views, top=self.top, left=self.left, size=(self.height, self.width))


@dataclass(frozen=True, slots=True, init=False)
class RandomCrop(_Sized):
    """Cut a window of a size in pixels, anywhere inside the picture."""

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return cropped views."""
        spare = (views.intrinsics.height_px - self.height, views.intrinsics.width_px - self.width)
        if min(spare) < 0:
            raise FieldError(
                f"{self} is larger than a picture of {views.intrinsics.width_px} x "
                f"{views.intrinsics.height_px} pixels; scale it up first."
            )
        top, left = (int(generator.integers(free + 1)) for free in spare)
        return _windowed(views, top=top, left=left, size=(self.height, self.width))


@dataclass(frozen=True, slots=True)
class RandomScale:
    """Scale by 2^U(low, high), and with a probability stretch x and y apart by up to 2^stretch.

    Never below ``at_least`` (height, width), so that a crop of that size still fits. The default
    range is the one that RAFT-Stereo trains with.
    """

    low: float = -0.2
    high: float = 0.5
    stretch: float = 0.2
    stretch_probability: float = 0.8
    at_least: tuple[int, int] = (1, 1)
    swaps_views: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Require ascending ranges, a probability and at least one pixel."""
        _require_numbers(self, "low", "high", least=-8, most=math.inf)
        _require_numbers(self, "stretch", most=math.inf)
        _require_numbers(self, "stretch_probability")
        _require_size(*self.at_least)

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return scaled views."""
        exponents = np.full(2, generator.uniform(self.low, self.high))
        if generator.random() < self.stretch_probability:
            exponents += generator.uniform(-self.stretch, self.stretch, size=2)
        old = (views.intrinsics.height_px, views.intrinsics.width_px)
        height, width = (
            max(least, round(size * 2.0**exponent))
            for size, exponent, least in zip(old, exponents, self.at_least, strict=True)
        )
        return _resized(views, height=height, width=width)


@dataclass(frozen=True, slots=True)
class HorizontalFlip:
    """Mirror pictures, depth and cameras, and swap the two views, with a probability.

    A mirrored pair is a pair again, left of right, only when its views change places; its
    disparity then comes from the depth of what was the right view.
    """

    probability: float = 0.5
    swaps_views: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Require a probability."""
        _require_numbers(self, "probability")

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return the views, or their mirror image."""
        if generator.random() >= self.probability:
            return views
        if len(views.targets) != 1:
            raise FieldError(
                f"HorizontalFlip swaps the two views of a pair; this sample has one view and "
                f"{len(views.targets)} others. Use it with single pairs."
            )

        def mirrored(maps: Any) -> Any:
            return maps[..., ::-1].copy()

        return _mapped(
            views,
            mirrored,
            source=views.targets[0],
            targets=(views.source,),
            intrinsics=views.intrinsics.flipped(),
            world="mirrored" if views.world == "as recorded" else "as recorded",
            padded=None if views.padded is None else mirrored(views.padded),
        )


@dataclass(frozen=True, slots=True)
class ColorJitter:
    """Change brightness, contrast, saturation and hue: alike in all views, or each view by itself.

    Factors are drawn from [1 - x, 1 + x]; hue turns by up to x of a full circle. With
    ``asymmetric_probability`` every view draws its own, as two real cameras differ; the frames of
    a clip always share theirs.
    """

    brightness: float = 0.4
    contrast: float = 0.4
    saturation: float = 0.4
    hue: float = 0.16
    asymmetric_probability: float = 0.2
    swaps_views: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Require factors and a probability of 0 to 1."""
        for name in ("brightness", "contrast", "saturation", "hue", "asymmetric_probability"):
            _require_numbers(self, name)

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return views with other colours."""
        common = self._draw(generator)
        apart = generator.random() < self.asymmetric_probability
        lumas = [_own(_luma(pictures), views) for pictures in views.pictures.values()]
        grey = float(np.mean([luma.mean() for luma in lumas]))
        pictures = {
            camera: _recoloured(pictures, self._draw(generator) if apart else common, grey=grey)
            for camera, pictures in sorted(views.pictures.items())
        }
        return replace(views, pictures=pictures)

    def _draw(self, generator: Generator) -> Any:
        """Return the factors of brightness, contrast and saturation, and the turn of hue."""
        middle = np.array([1.0, 1.0, 1.0, 0.0])
        spread = np.array([self.brightness, self.contrast, self.saturation, self.hue])
        return generator.uniform(middle - spread, middle + spread)


@dataclass(frozen=True, slots=True)
class Eraser:
    """Paint boxes of the target views over with their mean colour: what the source sees is hidden.

    The source view, depth and disparity stay; what is painted over is not visible. Boxes have sides
    of ``low`` to ``high`` pixels.
    """

    probability: float = 0.5
    most_boxes: int = 2
    low: int = 50
    high: int = 100
    swaps_views: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Require a probability, and boxes of at least one pixel."""
        _require_numbers(self, "probability")
        _require_numbers(self, "low", "high", least=1, most=math.inf)
        _require_size(self.most_boxes, 1)

    def __call__(self, views: Views, generator: Generator) -> Views:
        """Return views with boxes erased."""
        if generator.random() >= self.probability:
            return views
        height, width = views.intrinsics.height_px, views.intrinsics.width_px
        hit = np.zeros((height, width), dtype=bool)
        for _ in range(int(generator.integers(1, self.most_boxes + 1))):
            top, left = int(generator.integers(height)), int(generator.integers(width))
            tall, wide = (int(side) for side in generator.integers(self.low, self.high + 1, 2))
            hit[top : top + tall, left : left + wide] = True
        pictures, erased = dict(views.pictures), dict(views.erased)
        for camera in views.targets:
            erased[camera] = hit | erased.get(camera, False)
            if camera in pictures:
                mean = _own(pictures[camera], views).mean(axis=(-2, -1), keepdims=True)
                pictures[camera] = np.where(hit, mean.round().astype(np.uint8), pictures[camera])
        return replace(views, pictures=pictures, erased=erased)


def _require_size(height: Any, width: Any) -> None:
    whole = all(isinstance(side, int | np.integer) for side in (height, width))
    if not whole or min(height, width) < 1:
        raise FieldError(
            f"a size must be whole numbers of pixels from 1, got {width!r} x {height!r}."
        )


def _require_numbers(transform: Any, *names: str, least: float = 0, most: float = 1) -> None:
    """Require that attributes are numbers, each at least the one before, within two bounds."""
    values = [getattr(transform, name) for name in names]
    numbers = all(isinstance(value, int | float) for value in values)
    if not numbers or not all(a <= b for a, b in pairwise([least, *values, most])):
        order = ", ascending" if len(names) > 1 else ""
        raise FieldError(
            f"{', '.join(names)} of {type(transform).__name__} must be {least:g} to {most:g}"
            f"{order}, got {', '.join(map(repr, values))}."
        )


def _own(maps: Any, views: Views) -> Any:
    """Return the pixels of (..., h, w) maps outside padding, (..., n, 1); all if there are none."""
    if views.padded is None or views.padded.all():
        return maps
    return maps[..., ~views.padded, None]


def _mapped(
    views: Views,
    pictures: Callable[[Any], Any],
    *,
    maps: Callable[[Any], Any] | None = None,
    marks: Callable[[Any], Any] | None = None,
    **changes: Any,
) -> Views:
    """Return views with all pictures, stored depth maps and marks of erased pixels mapped alike.

    ``maps`` and ``marks`` map depth and marks otherwise than pictures.
    """
    maps, marks = maps or pictures, marks or pictures
    return replace(
        views,
        pictures={camera: pictures(found) for camera, found in views.pictures.items()},
        depths={
            camera: StoredDepth(maps(depth.units), maps(depth.measured))
            for camera, depth in views.depths.items()
        },
        erased={camera: marks(erased) for camera, erased in views.erased.items()},
        **changes,
    )


def _resized(views: Views, *, height: int, width: int) -> Views:
    size = (height, width)
    padded = None if views.padded is None else _resized_marks(views.padded, size=size)

    def nearest(maps: Any) -> Any:
        resized = resized_nearest(maps, size=size)
        return resized if padded is None or maps.dtype != bool else resized & ~padded

    return _mapped(
        views,
        partial(_resized_pictures, size=size),
        maps=nearest,
        marks=partial(_resized_marks, size=size),
        intrinsics=views.intrinsics.resized(width_px=width, height_px=height),
        padded=padded,
    )


def _resized_marks(marks: Any, *, size: tuple[int, int]) -> Any:
    """Return which pixels of resized pictures have part of a marked pixel (h, w) in them."""
    return _resized_pictures(marks[None, None].astype(np.float32), size=size)[0, 0] > 0


def _resized_pictures(pictures: Any, *, size: tuple[int, int]) -> Any:
    """Return (t, c, h, w) pictures averaged to a size, in their own dtype."""
    height, width = size
    if width > 1:
        return _averaged(pictures, size)
    # torch 2.13 averages wrongly along a single column, and with uint8 writes beyond the result:
    # floats are averaged to the column, and that as a row.
    column = _averaged(pictures.astype(np.float32), (pictures.shape[-2], 1))
    resized = _averaged(column.swapaxes(-1, -2), (1, height)).swapaxes(-1, -2)
    return (np.rint(resized) if pictures.dtype == np.uint8 else resized).astype(pictures.dtype)


def _averaged(pictures: Any, size: tuple[int, int]) -> Any:
    tensor = torch.from_numpy(np.ascontiguousarray(pictures))
    return torch.nn.functional.interpolate(
        tensor, size=size, mode="bilinear", antialias=True
    ).numpy()


def _windowed(views: Views, *, top: int, left: int, size: tuple[int, int]) -> Views:
    height, width = size
    old, padded = views.intrinsics, views.padded
    if min(top, left) < 0 or top + height > old.height_px or left + width > old.width_px:
        padded = np.zeros((old.height_px, old.width_px), dtype=bool) if padded is None else padded
    window = partial(_window, top=top, left=left, size=size)
    return _mapped(
        views,
        window,
        intrinsics=old.cropped(left_px=left, top_px=top, width_px=width, height_px=height),
        padded=None if padded is None else ~window(~padded),
    )


def _window(maps: Any, *, top: int, left: int, size: tuple[int, int]) -> Any:
    """Return a window of maps; beyond their border it is 0, or False."""
    height, width = size
    window = np.zeros((*maps.shape[:-2], height, width), dtype=maps.dtype)
    rows = slice(max(0, top), min(maps.shape[-2], top + height))
    columns = slice(max(0, left), min(maps.shape[-1], left + width))
    window[..., rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = (
        maps[..., rows, columns]
    )
    return window


def _luma(pictures: Any) -> Any:
    """Return the BT.601 luma of (t, 3, h, w) pictures, (t, 1, h, w) float32."""
    weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.einsum("c,tchw->thw", weights, pictures, dtype=np.float32)[:, None]


def _recoloured(pictures: Any, factors: Any, *, grey: float) -> Any:
    """Return (t, 3, h, w) uint8 pictures of another brightness, contrast, saturation and hue.

    Contrast stretches about ``grey``, the mean luma, which all views share.
    """
    brightness, contrast, saturation, hue = factors.astype(np.float32)
    middle = np.float32(grey) * brightness
    colours = middle + (pictures * brightness - middle) * contrast
    luma = _luma(colours)
    turned = np.einsum("ij,tjhw->tihw", hue_rotation(float(hue)), colours - luma)
    return np.clip(np.rint(luma + turned * saturation), 0, 255).astype(np.uint8)


def hue_rotation(turns: float) -> Any:
    """Return the matrix that turns colours about the grey axis by a part of a full circle.

    Source: Rodrigues' formula for the axis (1, 1, 1).
    """
    cosine, sine = np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)
    axis = np.full(3, 1 / np.sqrt(3))
    cross = np.cross(np.eye(3), axis)
    matrix = cosine * np.eye(3) + sine * cross + (1 - cosine) * np.outer(axis, axis)
    return matrix.astype(np.float32)
