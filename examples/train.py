"""Train a small network on the sample shards in plain PyTorch, and show that it learned.

`make demo` runs it. Validation is on freshly drawn scenes of the eval split, at more than twice
the size of the training pictures. The curve and three predictions go to demo/training.png.
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
MAPS = ("SynthPark", "SynthStage", "SynthYard")
FIELDS = ("left", "right", "disparity", "valid", "visible", "baseline_m", "scene")
MAX_DISPARITY, BATCH, STEPS_BETWEEN_VALIDATIONS = 32, 8, 50


def held_out_errors(network: SmallStereo, validation: PairsLoader) -> torch.Tensor:
    """Return the error in pixels of each pixel that both cameras see."""
    errors = []
    for batch in validation:
        truth = batch["disparity"]
        scored = batch["valid"] & batch["visible"] & (truth < MAX_DISPARITY)
        with torch.no_grad():
            errors.append((network(batch["left"], batch["right"]) - truth).abs()[scored])
    return torch.cat(errors)


def draw(curve: dict[int, float], network: SmallStereo, held_out: StereoPairs) -> Figure:
    """Return the curve, and left view, truth, prediction and error of one pair of each scene."""
    figure = Figure(figsize=(11, 11.5), layout="constrained")
    top, below = figure.subfigures(2, 1, height_ratios=[1, 3])
    axes = top.subplots()
    axes.plot(list(curve), list(curve.values()), marker="o")
    axes.set(xlabel="training step", ylabel="held-out error, px", ylim=(0, None))
    by_baseline = sorted(held_out, key=lambda sample: float(sample["baseline_m"]))
    of_each_scene = {sample["scene"]: sample for sample in by_baseline}.values()  # the widest
    for row, sample in zip(below.subplots(len(of_each_scene), 4), of_each_scene, strict=True):
        truth, largest = sample["disparity"][0], float(sample["disparity"][sample["valid"]].max())
        with torch.no_grad():
            predicted = network(sample["left"][None], sample["right"][None])[0, 0]
        row[0].imshow(sample["left"].permute(1, 2, 0))
        row[1].imshow(truth, vmin=0, vmax=largest, cmap="turbo")
        row[2].imshow(predicted, vmin=0, vmax=largest, cmap="turbo")
        row[3].imshow((predicted - truth).abs(), vmin=0, vmax=3, cmap="magma")
        titles = ("left view", f"truth, 0 to {largest:.0f} px", "prediction", "error, 0 to 3 px")
        for tile, title in zip(row, titles, strict=True):
            tile.set_title(title, fontsize=9)
            tile.set_axis_off()
    return figure


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--steps", type=int, default=200)
    given = options.parse_args()
    torch.manual_seed(given.seed)
    request = SynthRequest(
        family="IPD_Gaussian", split="eval", map_name=MAPS, scenes=3, size_px=160, frames=2, seed=7
    )
    synthesise(DEMO / "scenes", request)
    held_out = StereoPairs(
        DEMO / "scenes", pairs="all", baseline_cm=(10, 40), frames=[0], fields=FIELDS
    )
    validation = held_out.loader(BATCH, shuffle=False)
    pairs = StereoPairs(
        SHARDS, split="train", pairs="all", baseline_cm=(8, 60), frames=("every", 4),
        fields=FIELDS, transform=Compose([HorizontalFlip(), RandomCrop(64, 64)]),
    )  # fmt: skip
    workers = max(1, min(2, torch.get_num_threads() // 2))  # the training needs cores, too
    loader = pairs.loader(BATCH, num_workers=workers, seed=given.seed)
    print(f"training on {len(pairs)} pairs, validating on {len(held_out)} of three other scenes")

    network = SmallStereo(MAX_DISPARITY)
    optimiser = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 8e-3, total_steps=given.steps)
    before = held_out_errors(network, validation)
    curve, step, began = {0: float(before.mean())}, 0, time.perf_counter()
    while step < given.steps:
        for batch in loader:  # an epoch; each begins where the one before ended
            truth = batch["disparity"]
            scored = batch["valid"] & (truth < MAX_DISPARITY)
            loss = smooth_l1_loss(network(batch["left"], batch["right"])[scored], truth[scored])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            step += 1
            if step % STEPS_BETWEEN_VALIDATIONS == 0 or step == given.steps:
                after = held_out_errors(network, validation)
                curve[step] = float(after.mean())
                print(f"step {step}: held-out error {curve[step]:.2f} px", flush=True)
            if step == given.steps:
                break
    seconds, stats = time.perf_counter() - began, loader.stats()
    picture = DEMO / "training.png"
    draw(curve, network, held_out).savefig(picture, dpi=110)
    off = [f"{errors.gt(1).float().mean():.1%}" for errors in (before, after)]
    print(f"curve and predictions: {picture}. Next: README.md, then docs/training.md")
    print(
        f"{given.steps * BATCH / seconds:.0f} samples a second, validation included; "
        f"{stats.waiting:.0%} of the last epoch waiting for data"
    )
    packets = stats.packets_decoded / stats.frames_used
    print(f"{packets:.2f} packets decoded for each frame shown; workers: {stats.time}")
    print(f"pixels off by more than 1 px: {off[0]} before, {off[1]} after")
    print(f"held-out error {curve[0]:.2f} px before, {curve[step]:.2f} px after")


if __name__ == "__main__":
    main()
