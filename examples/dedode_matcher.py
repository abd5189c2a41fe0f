"""The paper's keypoint matcher for E_match: DeDoDe, as a plug-in of `stereogenbench eval score`.

    pip install kornia
    stereogenbench eval score shards/ predictions/ --tier G1 --weights WEIGHTS \
        --keypoint-matcher dedode_matcher.py:DeDoDe

WEIGHTS holds the two files of https://github.com/Parskatt/DeDoDe/releases (licence: MIT):
dedode_detector_L.pth and dedode_descriptor_B.pth. A plug-in has the members of its kind in
`stereogenbench_data.evaluation.models.loading`.
"""

from pathlib import Path

import kornia
import numpy as np
import torch

from stereogenbench_data.evaluation.metrics.keypoint_matches import KEYPOINTS, RATIO, mutual_matches
from stereogenbench_data.evaluation.models.loading import Keypoints, load_file


class DeDoDe:
    """Keypoints of the L-upright detector, described by the B-upright descriptor."""

    def __init__(self, *, weights: Path, device: str = "cpu") -> None:
        network = kornia.feature.DeDoDe(
            detector_model="L", descriptor_model="B", amp_dtype=torch.float32
        )
        self.name = f"DeDoDe (kornia {kornia.__version__})"
        self.settings = {
            "detector": "L-upright", "descriptor": "B-upright", "keypoints": KEYPOINTS,
            "ratio": RATIO, "descriptors": "as the network gives them, not normalised",
            "matching": "mutual nearest neighbours, ratio in both directions",
        }  # fmt: skip
        for part, name in (("detector", "detector_L"), ("descriptor", "descriptor_B")):
            path = weights / f"dedode_{name}.pth"
            self.settings[f"{part}_sha256"] = load_file(getattr(network, part), path)
        self.network, self.device = network.to(device), device

    def detect(self, picture) -> Keypoints:
        image = torch.from_numpy(picture.copy()).to(self.device).float()[None] / 255
        with torch.inference_mode():
            xy_px, _, descriptors = self.network(image, n=KEYPOINTS)
        return Keypoints(xy_px[0].cpu().numpy().astype(np.float32), descriptors[0].cpu().numpy())

    def match(self, left: Keypoints, right: Keypoints):
        return mutual_matches(left, right)
