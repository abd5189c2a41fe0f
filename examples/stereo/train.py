"""Train a stereo network from training shards; stopped and started again, it goes on.

    python examples/stereo/train.py SHARDS RUN [--pairs all|primary] [--seed N] [--steps N]

RUN receives checkpoint.pt, saved every few minutes, and log.jsonl. How the shards are made, and how
the trained network is scored on real pictures, is in docs/training.md.
"""

import argparse
import json
import time
from collections.abc import Iterator
from itertools import chain, repeat
from pathlib import Path

import torch
from network import StereoNetwork

from stereogenbench_data import (
    ColorJitter,
    Compose,
    DisparityError,
    Eraser,
    HorizontalFlip,
    PairsLoader,
    RandomCrop,
    RandomScale,
    StereoPairs,
)

FIELDS = ("left", "right", "disparity", "valid", "visible")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
BASELINES_CM, CROP, BATCH = (1, 100), (160, 224), 4
STEPS_BETWEEN_LINES, STEPS_BETWEEN_SAVES = 200, 100


def training_pairs(shards: str, *, pairs: str, crop: tuple[int, int], seed: int) -> StereoPairs:
    """Return the training set: as many pairs of each bin of baselines, if all are taken."""
    balanced = {"balance": "bins"} if pairs == "all" else {}
    return StereoPairs(
        shards, split="train", pairs=pairs, baseline_cm=BASELINES_CM, **balanced,
        fields=FIELDS, seed=seed, transform=Compose([
            HorizontalFlip(), RandomScale(at_least=crop), RandomCrop(*crop), ColorJitter(), Eraser()
        ]),
    )  # fmt: skip


def on_device(loader: PairsLoader) -> Iterator[dict[str, torch.Tensor]]:
    """Yield the batches of an epoch where the network is."""
    for batch in loader:
        yield {name: batch[name].to(DEVICE, non_blocking=True) for name in FIELDS}


def held_out_error(network: StereoNetwork, validation: PairsLoader) -> float:
    """Return the mean error in pixels over what both cameras see."""
    network.eval()
    error = DisparityError(max_disparity_px=network.max_disparity)
    for batch in on_device(validation):
        with torch.no_grad():
            found = network(batch["left"], batch["right"])
        error.update(found, batch["disparity"], batch["valid"] & batch["visible"])
    network.train()
    return error.compute()["epe"]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("shards")
    options.add_argument("run", type=Path)
    options.add_argument("--pairs", choices=("all", "primary"), default="all")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--steps", type=int, default=3000)
    options.add_argument("--crop", type=int, nargs=2, default=CROP, help="height, width")
    options.add_argument("--workers", type=int, default=1)
    options.add_argument("--bfloat16", action="store_true", help="faster where there is hardware")
    given = options.parse_args()
    torch.manual_seed(given.seed)
    given.run.mkdir(parents=True, exist_ok=True)

    training = training_pairs(given.shards, pairs=given.pairs, crop=given.crop, seed=given.seed)
    loader = training.loader(BATCH, num_workers=given.workers, seed=given.seed)
    held_out = StereoPairs(
        given.shards,
        split="eval",
        pairs="all",
        balance="bins",
        baseline_cm=BASELINES_CM,
        frames="first",
        fields=FIELDS,
    )
    validation = held_out.loader(BATCH, shuffle=False)
    network = StereoNetwork().to(DEVICE)
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=given.steps)
    parts = {"network": network, "optimiser": optimiser, "schedule": schedule, "loader": loader}
    checkpoint, step = given.run / "checkpoint.pt", 0
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True, map_location="cpu")
        for name, part in parts.items():
            part.load_state_dict(saved[name])
        step = saved["step"]
    print(f"{len(training)} pairs, from step {step} on", flush=True)

    losses, began = [], time.perf_counter()
    for batch in chain.from_iterable(map(on_device, repeat(loader))):  # epoch after epoch
        if step == given.steps:
            break
        with torch.autocast(DEVICE, torch.bfloat16, enabled=given.bfloat16):
            loss = network.loss(*(batch[name] for name in FIELDS))
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
                "samples_per_s": len(losses) * BATCH / (time.perf_counter() - began),
                "waiting_for_data": loader.stats().waiting,
                "held_out_px": held_out_error(network, validation),
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
