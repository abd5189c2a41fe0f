"""Plain PyTorch: train a small network on the sample shards, and show that it learned (`make demo`).

Validation is on freshly drawn scenes of the eval split, on maps that training has and one that it
has not, at more than twice the size. Writes demo/training.png.
"""

import argparse
import time
from pathlib import Path

import torch
from matplotlib.figure import Figure
from small_stereo import SmallStereo
from torch.nn.functional import smooth_l1_loss

from stereogenbench_data import Compose, HorizontalFlip, PairsLoader, RandomCrop, StereoPairs
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

DEMO, SHARDS = Path("demo"), Path(__file__).parents[1] / "shards"
FIELDS = ("left", "right", "disparity", "valid", "visible", "scene")
MAX_DISPARITY, BATCH = 32, 8


def held_out_errors(network: SmallStereo, loader: PairsLoader) -> torch.Tensor:
    """Return the errors, in pixels, of all pixels that both cameras see."""
    with torch.no_grad():
        errors = []
        for batch in loader:
            truth = batch["disparity"]
            scored = batch["valid"] & batch["visible"] & (truth < MAX_DISPARITY)
            errors.append((network(batch["left"], batch["right"]) - truth).abs()[scored])
    return torch.cat(errors)


def draw(curve: list[tuple[int, float]], network: SmallStereo, held_out: StereoPairs) -> Figure:
    """Return the curve, and left view, truth, prediction and error of one pair of each scene."""
    figure = Figure(figsize=(11, 11.5), layout="constrained")
    top, below = figure.subfigures(2, 1, height_ratios=[1, 3])
    axes = top.subplots()
    axes.plot(*zip(*curve, strict=True), marker="o")
    axes.set(xlabel="training step", ylabel="held-out error, px", ylim=(0, None))
    firsts = {sample["scene"]: sample for sample in reversed(list(held_out))}.values()
    for row, sample in zip(below.subplots(len(firsts), 4), firsts, strict=True):
        truth, valid = sample["disparity"][0], sample["valid"][0]
        with torch.no_grad():
            guess = network(*(torch.as_tensor(sample[view])[None] for view in ("left", "right")))
        guess, longest = guess[0, 0].numpy(), float(truth[valid].max())
        row[0].imshow(sample["left"].transpose(1, 2, 0))
        row[1].imshow(truth, vmin=0, vmax=longest, cmap="turbo")
        row[2].imshow(guess, vmin=0, vmax=longest, cmap="turbo")
        row[3].imshow(abs(guess - truth), vmin=0, vmax=3, cmap="magma")
        titles = ("left view", f"truth, 0 to {longest:.0f} px", "prediction", "error, 0 to 3 px")
        for tile, title in zip(row, titles, strict=True):
            tile.set_title(title, fontsize=9)
            tile.set_axis_off()
    return figure


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--steps", type=int, default=300)
    given = options.parse_args()
    torch.manual_seed(given.seed)
    request = SynthRequest(
        family="IPD_Gaussian", split="eval", maps=("all",), scenes=3, size_px=160, frames=2, seed=7
    )
    synthesise(DEMO / "scenes", request)
    held_out = StereoPairs(DEMO / "scenes", pairs="all", frames="all", fields=FIELDS)
    pairs = StereoPairs(
        SHARDS, split="train", pairs="all", baseline_cm=(8, 60), frames=("every", 4),
        fields=FIELDS, transform=Compose([HorizontalFlip(), RandomCrop(64, 64)]),
    )  # fmt: skip
    loader = pairs.loader(BATCH, num_workers=2, seed=given.seed)
    validation = held_out.loader(BATCH, order="sequential", tail="uneven")

    network = SmallStereo(MAX_DISPARITY)
    optimiser = torch.optim.Adam(network.parameters(), lr=8e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 8e-3, total_steps=given.steps)
    before = held_out_errors(network, validation)
    curve = [(0, float(before.mean()))]
    print(f"{len(pairs)} training pairs, {len(held_out)} held-out pairs of {held_out.scenes}")


if __name__ == "__main__":
    main()
