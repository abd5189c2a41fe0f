"""The paper's keypoint matcher: DeDoDe with L-upright detector and B-upright descriptor.

The network is kornia's; its weights are read from files, nothing is fetched.
"""

import importlib
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Int64

from stereogenbench_data.errors import ExtraError, missing_extra
from stereogenbench_data.evaluation.metrics.matching import KEYPOINTS, RATIO, mutual_matches
from stereogenbench_data.evaluation.models.interfaces import (
    Keypoints,
    NamedModel,
    Picture,
    Settings,
    require_pictures,
)
from stereogenbench_data.evaluation.models.weights import Weights, load_weights

_RELEASE: Final = "https://github.com/Parskatt/DeDoDe/releases/download/dedode_pretrained_models/"
DETECTOR: Final = Weights(
    what="DeDoDe's detector L-upright",
    file="dedode_detector_L.pth",
    source=f"{_RELEASE}dedode_detector_L.pth",
    licence="MIT",
    extra="dedode",
)
DESCRIPTOR: Final = Weights(
    what="DeDoDe's descriptor B-upright",
    file="dedode_descriptor_B.pth",
    source=f"{_RELEASE}dedode_descriptor_B.pth",
    licence="MIT",
    extra="dedode",
)


class DeDoDeMatcher(NamedModel):
    """DeDoDe keypoints, matched as mutual nearest neighbours; a `KeypointMatcher`."""

    def __init__(self, *, weights: Path | None = None, device: str = "cpu") -> None:
        """Load the networks; the arguments are those of `ModelOptions`.

        Raises:
            ExtraError: If kornia or a file is missing.
            EvaluationError: If a file does not hold this network's weights.
        """
        try:
            kornia = importlib.import_module("kornia")
        except ImportError as error:
            raise ExtraError(
                f"{missing_extra('DeDoDe', DETECTOR.extra, error)} Its weights: "
                f"{DETECTOR.how_to_fetch(weights)}; {DESCRIPTOR.how_to_fetch(weights)}; or name "
                f"the folder that they are in (--weights)."
            ) from error
        network: Any = kornia.feature.DeDoDe(
            detector_model="L", descriptor_model="B", amp_dtype=torch.float32
        )
        detector = load_weights(network.detector, DETECTOR, folder=weights)
        descriptor = load_weights(network.descriptor, DESCRIPTOR, folder=weights)
        self._network = network.to(device)
        self._device = device
        self.name = f"DeDoDe (kornia {kornia.__version__})"
        self.settings: Settings = {
            "detector": "L-upright",
            "detector_sha256": detector["weights_sha256"],
            "descriptor": "B-upright",
            "descriptor_sha256": descriptor["weights_sha256"],
            "keypoints": KEYPOINTS,
            "ratio": RATIO,
            "matching": "mutual nearest neighbours, ratio in both directions",
            "descriptors": "as the network gives them, not normalised",
            "precision": "float32",
        }

    def detect(self, picture: Picture) -> Keypoints:
        """Return the keypoints with the highest detector confidence.

        Raises:
            EvaluationError: If it is not a picture.
        """
        require_pictures(picture)
        image = torch.from_numpy(picture.copy()).to(self._device).float()[None] / 255
        with torch.inference_mode():
            xy_px, _, descriptors = self._network(image, n=KEYPOINTS)
        return Keypoints(
            xy_px=xy_px[0].cpu().numpy().astype(np.float32),
            descriptors=descriptors[0].float().cpu().numpy(),
        )

    def match(self, left: Keypoints, right: Keypoints) -> Int64[np.ndarray, "m 2"]:
        """Return mutual nearest neighbours."""
        return mutual_matches(left, right)
