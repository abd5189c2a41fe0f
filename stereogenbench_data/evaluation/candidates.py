"""Where right views come from: a folder of predictions, or a method that is called."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from stereogenbench_data.evaluation.predictions import (
    Frames,
    Pair,
    PredictionFault,
    Wanted,
    find_prediction,
    open_prediction,
    require_picture,
    stamp_prediction,
)
from stereogenbench_data.evaluation.tiers import Tier
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Sample

Method = Callable[[dict[str, Any]], Any]
"""Takes a batch of a tier's inputs, frames of one pair in order, and returns the right views:
uint8, or floats of 0 to 1, (n, 3, h, w)."""


class Views(Protocol):
    """The right views of one scene while it is scored."""

    def read(self, wanted: Wanted, samples: Sequence[Sample]) -> Sequence[Any]:
        """Return the right view of each sample, frames of one pair in order: uint8 (3, h, w).

        Each is of the evaluated size, or of that of the scene's own pictures.
        """
        ...

    def close(self) -> None:
        """Close what is open."""
        ...


class Candidate(Protocol):
    """A source of right views."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Fields of a sample that it needs."""
        ...

    def stamp(self, wanted: Wanted) -> str:
        """Return a text that changes when the right views of a pair do.

        Raises:
            PredictionFault: If there are none, or several that could be meant.
        """
        ...

    def open(self, index: SceneIndex) -> Views:
        """Begin with a scene; the index holds it, and scenes that are read beside it."""
        ...


@dataclass(frozen=True, slots=True)
class PredictionFolder:
    """Right views that a method wrote, in the layout of `predictions`.

    Attributes:
        name: What tables call the method.
        root: The folder.
        inputs: Nothing of a sample.
    """

    name: str
    root: Path
    inputs: tuple[str, ...] = ()

    def stamp(self, wanted: Wanted) -> str:
        """Return a text that changes when the files do.

        Raises:
            PredictionFault: If there are none, or several that could be meant.
        """
        return stamp_prediction(find_prediction(self.root, wanted))

    def open(self, index: SceneIndex) -> "_FolderViews":
        """Begin to read a scene's predictions."""
        return _FolderViews(self.root)


class _FolderViews:
    def __init__(self, root: Path) -> None:
        self._root = root
        self._open: dict[Pair, Frames] = {}

    def read(self, wanted: Wanted, samples: Sequence[Sample]) -> list[Any]:
        if wanted.pair not in self._open:
            self._open[wanted.pair] = open_prediction(find_prediction(self._root, wanted), wanted)
        frames = self._open[wanted.pair]
        return [frames.read(int(sample["frame_index"])) for sample in samples]

    def close(self) -> None:
        for frames in self._open.values():
            frames.close()
        self._open.clear()


@dataclass(frozen=True, slots=True)
class CalledMethod:
    """A method that is called with batches of its tier's inputs.

    Attributes:
        name: What tables call the method.
        method: The callable.
        tier: What it is given.
    """

    name: str
    method: Method
    tier: Tier

    @property
    def inputs(self) -> tuple[str, ...]:
        """Fields of a sample that it needs."""
        return self.tier.inputs

    def stamp(self, wanted: Wanted) -> str:
        """Return the name: what a callable computes cannot be told from outside."""
        return f"called {self.name}"

    def open(self, index: SceneIndex) -> "CalledMethod":
        """Begin with a scene."""
        return self

    def read(self, wanted: Wanted, samples: Sequence[Sample]) -> Sequence[Any]:
        """Return what the method makes of a batch, as uint8 pictures."""
        given = self.method(batch_of([self.tier.inputs_of(sample) for sample in samples]))
        pictures = _as_pictures(given, count=len(samples), wanted=wanted, where=self.name)
        for picture in pictures:
            require_picture(picture, wanted, where=self.name)
        return pictures

    def close(self) -> None:
        """Nothing is kept open."""


def batch_of(inputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return inputs as one dict of tensors with a batch axis in front."""
    import torch

    return {
        name: torch.from_numpy(np.stack([np.asarray(each[name]) for each in inputs]))
        for name in inputs[0]
    }


def _as_pictures(given: Any, *, count: int, wanted: Wanted, where: str) -> Sequence[Any]:
    """Return a method's answer as an array of uint8 where it holds floats of 0 to 1."""
    if hasattr(given, "detach"):
        tensor = given.detach().cpu()
        given = (tensor.float() if tensor.is_floating_point() else tensor).numpy()
    try:
        array = np.asarray(given)
    except (RuntimeError, TypeError, ValueError) as error:
        raise PredictionFault(
            f"{wanted.scene}: {where} returned a {type(given).__name__} that is no one array "
            f"({error}); expected ({count}, 3, {wanted.size[0]}, {wanted.size[1]})."
        ) from error
    if array.ndim != 4 or len(array) != count or array.size == 0:
        raise PredictionFault(
            f"{wanted.scene}: {where} was given {count} frames and returned {array.dtype} "
            f"{tuple(array.shape)}; expected ({count}, 3, {wanted.size[0]}, {wanted.size[1]})."
        )
    if array.dtype.kind != "f":
        return list(array)
    if not (np.isfinite(array).all() and array.min() >= 0 and array.max() <= 1):
        raise PredictionFault(
            f"{wanted.scene}: {where} returned floats of {array.min():g} to {array.max():g}; "
            f"expected 0 to 1, or uint8."
        )
    return list((array * 255).round().astype(np.uint8))
