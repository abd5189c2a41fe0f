"""The paper's stereo matcher: FoundationStereo, from the user's checkout of its repository.

Neither its code nor its weights come with this package: both are for non-commercial research.
"""

import importlib
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float32

from stereogenbench_data.errors import EvaluationError, ExtraError
from stereogenbench_data.evaluation.models.interfaces import Picture, Settings, require_pictures
from stereogenbench_data.evaluation.models.weights import (
    Weights,
    fingerprint,
    load_into,
    read_weights,
    weights_path,
)

REPOSITORY: Final = "https://github.com/NVlabs/FoundationStereo"
CHECKPOINT: Final = Weights(
    what="FoundationStereo (23-51-11, ViT-large)",
    file="model_best_bp2.pth",
    source="https://drive.google.com/drive/folders/1VhPebc_mMxWKccrv7pdQLTvXYVcLYpsf",
    licence="NVIDIA, non-commercial research only",
)
_CONFIGURATION: Final = "cfg.yaml"
_DEFAULT_FOLDER: Final = Path("pretrained_models") / "23-51-11"
_ITERATIONS: Final = 32
_SIDE_MULTIPLE: Final = 32


class FoundationStereoMatcher:
    """FoundationStereo's disparity at the pictures' own size; a `StereoMatcher`."""

    def __init__(
        self, *, checkout: Path | None, weights: Path | None = None, device: str = "cpu"
    ) -> None:
        """Load the network; the arguments are those of `ModelOptions`.

        The folder of weights has model_best_bp2.pth and cfg.yaml; it is pretrained_models/23-51-11
        in the checkout unless given.

        Raises:
            ExtraError: If the checkout, what it needs or a file is missing.
            EvaluationError: If the file does not hold this network's weights.
        """
        if checkout is None or not (checkout / "core" / "foundation_stereo.py").is_file():
            lacking = "has no checkout" if checkout is None else f"is not at {checkout}"
            place = Path("CHECKOUT") if checkout is None else checkout
            raise ExtraError(
                f"FoundationStereo {lacking}: clone {REPOSITORY} (licence: {CHECKPOINT.licence}), "
                f"install what it asks for and {CHECKPOINT.how_to_install}, fetch its weights and "
                f"{_CONFIGURATION} from {CHECKPOINT.source} into "
                f"{weights or place / _DEFAULT_FOLDER}, and name the clone (--checkout)."
            )
        folder = checkout / _DEFAULT_FOLDER if weights is None else weights
        path = weights_path(CHECKPOINT, folder=folder)
        network = _network(checkout, configuration=folder / _CONFIGURATION)
        tensors = read_weights(path, what=CHECKPOINT.what)
        load_into(network, tensors.get("model", tensors), path=path)
        self._network: Any = network.to(device)
        self._device = device
        self.name = f"FoundationStereo ({folder.name})"
        self.settings: Settings = {
            "weights": f"{folder.name}/{path.name}",
            "weights_sha256": fingerprint(path),
            "iterations": _ITERATIONS,
            "padding": f"replicated to a multiple of {_SIDE_MULTIPLE}",
            "precision": "autocast" if device.startswith("cuda") else "float32",
        }

    def __call__(self, left: Picture, right: Picture) -> Float32[np.ndarray, "h w"]:
        """Return the left picture's disparity in pixels; nan where the network gives none.

        Raises:
            EvaluationError: If the two are not pictures of one size.
        """
        require_pictures(left, right)
        height, width = left.shape[1:]
        down, across = -height % _SIDE_MULTIPLE, -width % _SIDE_MULTIPLE
        padding = (across // 2, across - across // 2, down // 2, down - down // 2)
        one, two = (
            torch.nn.functional.pad(
                torch.from_numpy(view.copy()).to(self._device).float()[None], padding, "replicate"
            )
            for view in (left, right)
        )
        on_cuda = self._device.startswith("cuda")
        with torch.inference_mode(), torch.autocast("cuda") if on_cuda else nullcontext():
            answer = self._network(one, two, iters=_ITERATIONS, test_mode=True)
        inside = answer.float()[0, 0, padding[2] :, padding[0] :][:height, :width]
        disparity_px: Float32[np.ndarray, "h w"] = inside.cpu().numpy()
        return np.where(np.isfinite(disparity_px), disparity_px, np.float32(np.nan))


def _network(checkout: Path, *, configuration: Path) -> torch.nn.Module:
    """Return FoundationStereo without its weights, imported from its checkout."""
    sys.path.insert(0, str(checkout))
    try:
        try:
            options = importlib.import_module("omegaconf").OmegaConf.load(configuration)
            module = importlib.import_module("core.foundation_stereo")
        except ImportError as error:
            raise ExtraError(
                f"FoundationStereo at {checkout} needs more than is installed ({error}): "
                "install what its repository asks for."
            ) from error
        except FileNotFoundError as error:
            raise ExtraError(
                f"{configuration} is missing: it comes with the weights, "
                f"{CHECKPOINT.source} (licence: {CHECKPOINT.licence})."
            ) from error
        if not Path(str(module.__file__)).resolve().is_relative_to(checkout.resolve()):
            raise EvaluationError(
                f"another module named core is loaded, {module.__file__}: FoundationStereo's, "
                f"of {checkout}, cannot be loaded in the same process."
            )
        options.setdefault("vit_size", "vitl")
        network: torch.nn.Module = module.FoundationStereo(options)
    finally:
        sys.path.remove(str(checkout))
    return network
