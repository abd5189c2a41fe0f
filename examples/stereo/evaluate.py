"""Score trained networks and OpenCV's matcher on scenes of the eval split, by their disparity.

    python examples/stereo/evaluate.py DATA RUN [RUN ...]

DATA is what `StereoPairs` takes. OpenCV's matcher leaves pixels without an answer; a network
answers all. What the columns mean is in docs/evaluation.md.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from network import StereoNetwork

from stereogenbench_data import DisparityProtocol, disparity_tables, evaluate_disparity
from stereogenbench_data.evaluation.report import markdown

MOST_PX = 96


def by_opencv(batch: dict[str, Any]) -> torch.Tensor:
    """Return semi-global matching's disparity, nan where it has no answer."""
    matcher = cv2.StereoSGBM_create(
        0, MOST_PX, 5, P1=8 * 3 * 25, P2=32 * 3 * 25, disp12MaxDiff=1, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    maps = []
    for views in zip(batch["left"], batch["right"], strict=True):
        # Without columns before the first one, it leaves as many as it searches unanswered.
        left, right = (
            cv2.copyMakeBorder(
                view.permute(1, 2, 0).numpy(), 0, 0, MOST_PX, 0, cv2.BORDER_REPLICATE
            )
            for view in views
        )
        found = matcher.compute(left, right)[:, MOST_PX:].astype(np.float32) / 16
        maps.append(np.where(found >= 0, found, np.nan))
    return torch.from_numpy(np.stack(maps))


def by_network(network: StereoNetwork, batch: dict[str, Any]) -> torch.Tensor:
    """Return a trained network's disparity."""
    with torch.no_grad():
        return network(batch["left"], batch["right"]).float()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("data")
    options.add_argument("runs", nargs="*", type=Path)
    given = options.parse_args()
    methods = {"OpenCV SGBM": by_opencv}
    for run in given.runs:
        saved = torch.load(run / "checkpoint.pt", weights_only=True)
        network = StereoNetwork().eval()
        network.load_state_dict(saved["network"])
        methods[run.name] = partial(by_network, network)
    protocol = DisparityProtocol(max_disparity_px=MOST_PX, batch_frames=4)
    scores = [
        evaluate_disparity(
            given.data, method, name=name, protocol=protocol, split="eval", pairs="all",
            baseline_cm=(1, 100), frames="first",
        )
        for name, method in methods.items()
    ]  # fmt: skip
    for table in disparity_tables(scores, by=()):
        print(markdown(table))


if __name__ == "__main__":
    main()
