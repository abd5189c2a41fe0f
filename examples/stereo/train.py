"""Train a stereo network from training shards; stopped and started again, it goes on.

    python examples/stereo/train.py SHARDS RUN [--pairs all|primary] [--seed N] [--steps N]

RUN receives checkpoint.pt, saved every few minutes, and log.jsonl. How the shards are made, and how
the trained network is scored on real pictures, is in docs/training.md.
"""

import argparse
import json
import time
from itertools import chain, repeat
from pathlib import Path

import torch
from network import StereoNetwork

from stereogenbench_data import (
    ColorJitter,
    Compose,
    Eraser,
    HorizontalFlip,
    PairsLoader,
    RandomCrop,
    StereoPairs,
)

FIELDS = ("left", "right", "disparity", "valid", "visible")
BASELINES_CM, BATCH = (1, 100), 4
STEPS_BETWEEN_LINES, STEPS_BETWEEN_SAVES = 100, 200


def training_pairs(shards: str, *, pairs: str, crop: tuple[int, int], seed: int) -> StereoPairs:
    """Return the training set: as many pairs of each bin of baselines, if all are taken."""
    balanced = {"balance": "bins"} if pairs == "all" else {}
    return StereoPairs(
        shards, split="train", pairs=pairs, baseline_cm=BASELINES_CM, **balanced,
        fields=FIELDS, seed=seed,
        transform=Compose([HorizontalFlip(), RandomCrop(*crop), ColorJitter(), Eraser()]),
    )  # fmt: skip


def held_out_error(network: StereoNetwork, validation: PairsLoader) -> float:
    """Return the mean error in pixels over what both cameras see."""
    network.eval()
    error = count = 0.0
    for batch in validation:
        scored = batch["valid"] & batch["visible"] & (batch["disparity"] < network.max_disparity)
        with torch.no_grad():
            wrong = network(batch["left"], batch["right"]) - batch["disparity"]
        error += float(wrong.abs()[scored].sum())
        count += float(scored.sum())
    network.train()
    return error / count


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("shards")
    options.add_argument("run", type=Path)
    options.add_argument("--pairs", choices=("all", "primary"), default="all")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--steps", type=int, default=3000)
    options.add_argument("--crop", type=int, nargs=2, default=(160, 224), help="height, width")
    options.add_argument("--workers", type=int, default=1)
    given = options.parse_args()
    torch.manual_seed(given.seed)
    given.run.mkdir(parents=True, exist_ok=True)

    training = training_pairs(given.shards, pairs=given.pairs, crop=given.crop, seed=given.seed)
    loader = training.loader(BATCH, num_workers=given.workers, seed=given.seed)
    held_out = StereoPairs(
        given.shards,
        split="eval",
        pairs="all",
        baseline_cm=BASELINES_CM,
        frames="first",
        fields=FIELDS,
    )
    validation = held_out.loader(BATCH, shuffle=False)
    network = StereoNetwork()
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=given.steps)
    parts = {"network": network, "optimiser": optimiser, "schedule": schedule, "loader": loader}
    checkpoint, step = given.run / "checkpoint.pt", 0
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True)
        for name, part in parts.items():
            part.load_state_dict(saved[name])
        step = saved["step"]
    print(f"{len(training)} pairs, from step {step} on", flush=True)

    losses, began = [], time.perf_counter()
    for batch in chain.from_iterable(repeat(loader)):  # epoch after epoch
        if step == given.steps:
            break
        loss = network.loss(batch["left"], batch["right"], batch["disparity"], batch["valid"])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        step += 1
        losses.append(loss.item())
        if step % STEPS_BETWEEN_LINES == 0 or step == given.steps:
            line = {
                "step": step,
                "loss": sum(losses) / len(losses),
                "held_out_px": held_out_error(network, validation),
                "samples_per_s": len(losses) * BATCH / (time.perf_counter() - began),
                "waiting_for_data": loader.stats().waiting,
            }
            with (given.run / "log.jsonl").open("a") as log:
                log.write(json.dumps(line) + "\n")
            print(line, flush=True)
            losses, began = [], time.perf_counter()
        if step % STEPS_BETWEEN_SAVES == 0 or step == given.steps:
            state = {name: part.state_dict() for name, part in parts.items()}
            new = checkpoint.with_suffix(".new")  # a run killed now keeps the old one
            torch.save(state | {"step": step, "pairs": given.pairs}, new)
            new.replace(checkpoint)


if __name__ == "__main__":
    main()
