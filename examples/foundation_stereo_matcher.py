"""The paper's stereo matcher for SD: FoundationStereo, as a plug-in of `stereogenbench eval score`.

    git clone https://github.com/NVlabs/FoundationStereo && pip install omegaconf ...
    PYTHONPATH=FoundationStereo stereogenbench eval score shards/ predictions/ --tier G1 \
        --stereo-matcher foundation_stereo_matcher.py:FoundationStereo \
        --weights FoundationStereo/pretrained_models/23-51-11

Its code and weights (model_best_bp2.pth and cfg.yaml, linked in its README) are for non-commercial
research. A plug-in has the members of its kind in
`stereogenbench_data.evaluation.models.loading`.
"""

import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch
from core.foundation_stereo import FoundationStereo as Network
from omegaconf import OmegaConf

from stereogenbench_data.evaluation.models.loading import load_file

ITERATIONS, MULTIPLE = 32, 32


class FoundationStereo:
    """Disparity at the pictures' own size; nan where the network gives none."""

    def __init__(self, *, weights: Path, device: str = "cpu") -> None:
        options, path = OmegaConf.load(weights / "cfg.yaml"), weights / "model_best_bp2.pth"
        options.setdefault("vit_size", "vitl")
        network = Network(options)
        sha256 = load_file(network, path, select=lambda file: file.get("model", file))
        self.network, self.device = network.to(device), device
        self.on_cuda = device.startswith("cuda")
        self.range_px = (0, options.get("max_disp", math.inf))  # of its search
        self.name = f"FoundationStereo ({weights.name})"
        self.settings = {
            "weights": path.name, "weights_sha256": sha256, "iterations": ITERATIONS,
            "padding": f"replicated to a multiple of {MULTIPLE}",
            "precision": "autocast" if self.on_cuda else "float32",
        }  # fmt: skip

    def __call__(self, left, right):
        height, width = left.shape[1:]
        down, across = -height % MULTIPLE, -width % MULTIPLE
        padding = (across // 2, across - across // 2, down // 2, down - down // 2)
        views = (torch.from_numpy(np.stack([view])).to(self.device) for view in (left, right))
        one, two = (torch.nn.functional.pad(each.float(), padding, "replicate") for each in views)
        with torch.inference_mode(), torch.autocast("cuda") if self.on_cuda else nullcontext():
            answer = self.network(one, two, iters=ITERATIONS, test_mode=True)
        inside = answer.float()[0, 0, padding[2] :, padding[0] :][:height, :width].cpu().numpy()
        return np.where(np.isfinite(inside), inside, np.float32(np.nan))
