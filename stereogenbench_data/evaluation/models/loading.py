"""The models that metrics are computed with: what a matcher must have, and how weights are read.

A matcher of your own is a class with the members of `KeypointMatcher` or `StereoMatcher`, named as
"module:Class" or "FILE.py:Class". ``device`` and ``weights`` are given to a constructor that has a
parameter for them. `examples/dedode_matcher.py` and `examples/foundation_stereo_matcher.py` are
the paper's. Pictures are uint8 RGB, channel first.
"""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from pickle import UnpicklingError
from runpy import run_path
from typing import Any, Final, Protocol

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8

from stereogenbench_data.errors import EvaluationError, ExtraError

Picture = UInt8[np.ndarray, "3 h w"]
Settings = Mapping[str, str | int | float | bool | None]


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Keypoints of one picture.

    Attributes:
        xy_px: Column and row; the centre of the top-left pixel is (0.5, 0.5).
        descriptors: One row a keypoint.
    """

    xy_px: Float32[np.ndarray, "n 2"]
    descriptors: Float32[np.ndarray, "n d"]


class Model(Protocol):
    """What every matcher has."""

    @property
    def name(self) -> str:
        """What tables call it, with its version."""

    @property
    def settings(self) -> Settings:
        """Every choice that its answers depend on, so that scores of other choices differ."""


class KeypointMatcher(Model, Protocol):
    """Finds keypoints in one picture, and the same keypoints in another."""

    def detect(self, picture: Picture) -> Keypoints:
        """Return a picture's keypoints: of the same picture, always the same in the same order."""

    def match(self, left: Keypoints, right: Keypoints) -> Int64[np.ndarray, "m 2"]:
        """Return indices of matched keypoints (left, right), each left keypoint at most once."""


class StereoMatcher(Model, Protocol):
    """Estimates the disparity of a rectified pair.

    One that searches a range states it as ``range_px``, the least and the largest disparity that it
    finds: pixels whose true disparity is beyond are not scored (`range_of`).
    """

    def __call__(self, left: Picture, right: Picture) -> Float32[np.ndarray, "h w"]:
        """Return the left picture's disparity in pixels; nan where it has no answer.

        x_right = x_left - disparity: positive in front of the cameras.
        """


Range = tuple[float, float]


def range_of(matcher: StereoMatcher) -> Range:
    """Return the least and the largest disparity, in pixels, that a matcher can find.

    Of a matcher that states no ``range_px``, all.
    """
    least_px, largest_px = getattr(matcher, "range_px", (-math.inf, math.inf))
    return least_px, largest_px


MODELS: Final[dict[str, dict[str, str]]] = {
    "keypoint matcher": {"sift": f"{__package__}.opencv:Sift"},
    "stereo matcher": {"sgbm": f"{__package__}.opencv:Sgbm"},
    "learned metric": {
        "lpips": f"{__package__}.lpips:Lpips",
        "fid": f"{__package__}.inception:InceptionFeatures",
        "fvd": f"{__package__}.i3d:I3dFeatures",
    },
}
"""The class of every model of this package, by kind and name; each is imported when first used."""


def load_model(kind: str, name: str, *, device: str = "cpu", weights: Path | None = None) -> Any:
    """Return a model of a kind.

    Args:
        kind: What the model does.
        name: One of `MODELS`, or "module:Class" or "FILE.py:Class" for a model of your own.
        device: Where a learned model runs, as torch names it.
        weights: The folder of weights files; None for that of torch.hub's checkpoints.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    known = MODELS[kind]
    place, _, class_name = known.get(name, name).rpartition(":")
    if not place:
        raise EvaluationError(
            f"{kind} must be one of {', '.join(known)}, or module:Class or FILE.py:Class of your "
            f"own, got {name!r}."
        )
    try:
        names = run_path(place) if place.endswith(".py") else vars(import_module(place))
        model = names[class_name]
    except (ImportError, OSError, KeyError) as error:
        raise ExtraError(f"{kind} {name}: cannot be imported ({error}).") from error
    taken = signature(model).parameters
    given = {"device": device, "weights": weights}
    return model(**{option: value for option, value in given.items() if option in taken})


def place_of(name: str) -> str:
    """Return a model's name with the path of its file in full, if it is one of a file."""
    file, _, class_name = name.rpartition(":")
    return f"{Path(file).resolve()}:{class_name}" if file.endswith(".py") else name


@dataclass(frozen=True, slots=True)
class Weights:
    """A file of learned weights, which the user fetches once.

    Attributes:
        what: What they are of, for messages.
        file: The name of the file.
        source: Where to fetch it.
        licence: Under which terms it comes.
        extra: The extra of this package with what the network needs.
    """

    what: str
    file: str
    source: str
    licence: str
    extra: str = "evaluation"


Tensors = Mapping[str, Any]


def load_weights(
    network: torch.nn.Module,
    weights: Weights,
    *,
    folder: Path | None,
    select: Callable[[Tensors], Tensors] = dict,
) -> dict[str, str]:
    """Give a network the weights of a file in a folder, or None for torch.hub's checkpoints.

    Returns:
        The name of the file and its sha256, for the settings.

    Raises:
        ExtraError: If the file is missing, saying where to fetch it and where to put it.
        EvaluationError: As `load_file`.
    """
    path = (folder or Path(torch.hub.get_dir()) / "checkpoints") / weights.file
    if not path.is_file():
        raise ExtraError(
            f"the weights of {weights.what} are missing: fetch {weights.source} (licence: "
            f"{weights.licence}) and put it at {path}, or name the folder that it is in "
            f"(--weights). It needs the extra {weights.extra!r}: "
            f"`pip install 'stereogenbench-data[{weights.extra}]'`."
        )
    return {"weights": path.name, "weights_sha256": load_file(network, path, select=select)}


def load_file(
    network: torch.nn.Module, path: Path, *, select: Callable[[Tensors], Tensors] = dict
) -> str:
    """Give a network the tensors of a file, make it ready for use, freeze it.

    Only tensors and plain values are read, on the CPU; a file that holds anything else is refused.

    Args:
        network: What they are for.
        path: The file.
        select: Returns the network's tensors of what is in the file.

    Returns:
        The sha256 of the file, as 64 hexadecimal digits.

    Raises:
        EvaluationError: If the file is damaged, holds anything else, or is of another network.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (UnpicklingError, RuntimeError, EOFError, KeyError, ValueError) as error:
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        raise EvaluationError(
            f"{path}: these weights cannot be read as tensors only ({reason}). Fetch the file "
            "again; if you trust it, load it once by its authors' code and store its tensors "
            "with torch.save."
        ) from error
    if not isinstance(content, Mapping):
        raise EvaluationError(
            f"{path}: the weights are a {type(content).__name__}, not a table of tensors."
        )
    try:
        network.load_state_dict(select(content))
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines()[1:3]]
        raise EvaluationError(
            f"{path}: these are not the weights of this network: {' '.join(lines)}"
        ) from error
    network.eval().requires_grad_(requires_grad=False)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Network:
    """A network that is given pictures or clips, a few at a time, and answers in float64.

    Attributes:
        settings: Every choice that its answers depend on.
    """

    def __init__(
        self, network: torch.nn.Module, *, settings: Settings, device: str, rows: int
    ) -> None:
        """Take a network that has its weights, and how many rows it is given at a time."""
        self.settings: Settings = {**settings, "precision": "float32"}
        self._network, self._device, self._rows = network.to(device), device, rows

    def __call__(self, *arrays: np.ndarray) -> Float64[np.ndarray, "n *answer"]:
        """Return what the network makes of arrays that have a row for each picture or clip."""
        made = []
        with torch.inference_mode():
            for start in range(0, len(arrays[0]), self._rows):
                some = (
                    torch.from_numpy(each[start : start + self._rows].copy()) for each in arrays
                )
                answer = self._network(*(each.to(self._device).float() for each in some))
                made.append(answer.cpu().numpy())
        return np.asarray(np.concatenate(made), dtype=np.float64)
