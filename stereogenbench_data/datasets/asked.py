"""What a user asks for, checked before anything is read."""

from collections.abc import Iterable, Sequence
from typing import Any, Final, Literal, cast, get_args

import numpy as np

from stereogenbench_data.datasets.batch_buffers import Buffers
from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.samples.fields import PAIR_FIELDS, VIEW_FIELDS, require_fields
from stereogenbench_data.samples.request import Request, Transform
from stereogenbench_data.samples.size import require_size
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT

Check = Literal["read", "opened", "metadata"]
"""Which videos are compared with their checksums: see `StereoPairs`."""

_CAMERAS: Final = frozenset(range(CAMERA_COUNT))


def requested(
    kind: Literal["pairs", "views"],
    layout: Literal["single", "stacked"],
    *,
    fields: Iterable[str],
    size: Any,
    depth: Any,
    transform: Any,
) -> Request:
    """Return what is asked of every sample, once each part of it is known to make sense."""
    return Request(
        kind=kind,
        fields=require_fields(fields, known=PAIR_FIELDS if kind == "pairs" else VIEW_FIELDS),
        layout=layout,
        size=None if size is None else require_size(size),
        depth=require_depth(depth),
        transform=require_transform(transform),
    )


def require_transform(transform: Any) -> Transform | None:
    """Return a transform, or None.

    Raises:
        FieldError: If it cannot be called, or does not say whether it swaps the views.
    """
    says = isinstance(getattr(transform, "swaps_views", None), bool)
    if transform is None or (says and callable(transform) and not isinstance(transform, type)):
        return transform
    raise FieldError(
        f"a transform is called with (views, generator) and has an attribute swaps_views, True or "
        f"False; got {transform!r}."
    )


def require_check(check: Any) -> Check:
    """Return which videos are compared with their checksums.

    Raises:
        SelectionError: If it is something else.
    """
    return cast("Check", _one_of("check", check, get_args(Check)))


def require_buffers(buffers: Any) -> Buffers:
    """Return whether the memory of batches is reused.

    Raises:
        SelectionError: If it is something else.
    """
    return cast("Buffers", _one_of("buffers", buffers, get_args(Buffers)))


def _one_of(name: str, value: Any, known: tuple[str, ...]) -> str:
    for each in known:
        if value == each:
            return each
    raise SelectionError(f"{name} must be one of {', '.join(map(repr, known))}, got {value!r}.")


def require_depth(depth: Any) -> DepthEncoding | None:
    """Return a depth contract, or None.

    Raises:
        FieldError: If it is something else.
    """
    if depth is not None and not isinstance(depth, DepthEncoding):
        raise FieldError(f"depth must be a DepthEncoding(...), got {depth!r}.")
    return depth


def require_seed(seed: Any) -> int:
    """Return a seed.

    Raises:
        SelectionError: If it is not a whole number from 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise SelectionError(f"seed must be a whole number from 0, got {seed!r}.")
    return int(seed)


def require_cameras(cameras: Any) -> tuple[int, ...]:
    """Return camera numbers, in the order given.

    Raises:
        SelectionError: If one is not of 0 to 5 or is given twice, or there is none.
    """
    if isinstance(cameras, str) and cameras == "all":
        return tuple(range(CAMERA_COUNT))
    found: tuple[Any, ...] = (cameras,)
    if isinstance(cameras, Sequence | np.ndarray):
        found = tuple(np.asarray(cameras, dtype=object).tolist())
    whole = all(isinstance(camera, int | np.integer) for camera in found)
    if not (whole and found and len(set(found)) == len(found) and set(found) <= _CAMERAS):
        raise SelectionError(
            f"cameras must be 'all', 'each' or different numbers of 0 to {CAMERA_COUNT - 1}, "
            f"got {cameras!r}."
        )
    return tuple(int(camera) for camera in found)
