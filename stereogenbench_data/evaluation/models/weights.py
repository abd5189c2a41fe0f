"""Files of learned weights: the user fetches them once, and only tensors are read from them."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch

from stereogenbench_data.errors import EvaluationError, ExtraError


@dataclass(frozen=True, slots=True)
class Weights:
    """A file of learned weights.

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

    def path(self, folder: Path | None) -> Path:
        """Return where the file belongs: in a folder, or None for torch.hub's checkpoints."""
        return (folder or Path(torch.hub.get_dir()) / "checkpoints") / self.file

    def how_to_fetch(self, folder: Path | None) -> str:
        """Return where to fetch the file, under which terms, and where to put it."""
        return f"fetch {self.source} (licence: {self.licence}) and put it at {self.path(folder)}"


def weights_path(weights: Weights, *, folder: Path | None) -> Path:
    """Return where the file of weights is.

    Raises:
        ExtraError: If it is not there, saying where to fetch it and where to put it.
    """
    path = weights.path(folder)
    if not path.is_file():
        raise ExtraError(
            f"the weights of {weights.what} are not at {path}: {weights.how_to_fetch(folder)}, or "
            f"name the folder that it is in (--weights). It needs the extra {weights.extra!r}: "
            f"`pip install 'stereogenbench-data[{weights.extra}]'`."
        )
    return path


def load_weights(
    network: torch.nn.Module, weights: Weights, *, folder: Path | None
) -> dict[str, str]:
    """Give a network its weights, make it ready for use and freeze it.

    Returns:
        The name of the file and its sha256, for the settings.

    Raises:
        ExtraError: If the file is not there.
        EvaluationError: If it is damaged, or does not hold this network's weights.
    """
    path = weights_path(weights, folder=folder)
    load_into(network, read_weights(path, what=weights.what), path=path)
    return {"weights": path.name, "weights_sha256": fingerprint(path)}


def in_batches(
    network: Callable[..., torch.Tensor], *arrays: np.ndarray, device: str, rows: int
) -> Any:
    """Return what a network makes of arrays, a few rows at a time, as float64."""
    made = []
    with torch.inference_mode():
        for start in range(0, len(arrays[0]), rows):
            some = (torch.from_numpy(each[start : start + rows].copy()) for each in arrays)
            made.append(network(*(each.to(device).float() for each in some)).cpu().numpy())
    return np.concatenate(made).astype(np.float64)


def fingerprint(path: Path) -> str:
    """Return the sha256 of a file, as 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_weights(path: Path, *, what: str) -> Mapping[str, Any]:
    """Return the tensors of a file of weights, on the CPU; anything else in it is refused.

    Raises:
        EvaluationError: If it holds more than tensors and plain values, or is damaged.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (UnpicklingError, RuntimeError, EOFError, KeyError, ValueError) as error:
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        raise EvaluationError(
            f"{path}: these weights of {what} cannot be read as tensors only ({reason}). Fetch the "
            "file again; if you trust it, load it once by its authors' code and store its tensors "
            "with torch.save."
        ) from error
    if not isinstance(content, Mapping):
        raise EvaluationError(
            f"{path}: the weights of {what} are a {type(content).__name__}, not a table of tensors."
        )
    return content


def load_into(network: torch.nn.Module, tensors: Mapping[str, Any], *, path: Path) -> None:
    """Give a network tensors that were read from a file, make it ready for use and freeze it.

    Raises:
        EvaluationError: If the tensors are not this network's.
    """
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines()[1:3]]
        raise EvaluationError(
            f"{path}: these are not the weights of {type(network).__name__}: {' '.join(lines)}"
        ) from error
    network.eval().requires_grad_(requires_grad=False)
