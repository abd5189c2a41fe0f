"""Accelerate: a training loop for any number of processes.

accelerate launch examples/accelerate_loop.py [SHARDS]

Prepare the loader like the rest. It gives each rank its share of the batches, moves them to the
accelerator's device, and adds its position to the saved state.
"""

import sys
from pathlib import Path

import torch
from accelerate import Accelerator
from torch import nn

from stereogenbench_data import StereoPairs

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")


def main() -> None:
    accelerator = Accelerator()
    pairs = StereoPairs(SHARDS, split="train", pairs="adjacent", frames=("every", 20))
    loader = pairs.loader(batch_size=4, seed=0)
    network = nn.Conv2d(6, 1, 5, padding=2)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    network, optimiser, loader = accelerator.prepare(network, optimiser, loader)
    for epoch in range(loader.epoch, 2):
        for batch in loader:
            views = torch.cat([batch["left"], batch["right"]], dim=1).float() / 255
            error = (network(views) - batch["disparity"]).abs()[batch["valid"]].mean()
            optimiser.zero_grad()
            accelerator.backward(error)
            optimiser.step()
        accelerator.print(f"epoch {epoch}: error {error.item():.2f} px")
    accelerator.end_training()


if __name__ == "__main__":
    main()
