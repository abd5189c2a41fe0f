"""Accelerate: a training loop for any number of processes.

accelerate launch examples/accelerate_loop.py [SHARDS]

The loader shares batches among the ranks itself: prepare the network and the optimiser, not the
loader, and move each batch to the device.
"""

import sys
from pathlib import Path

import torch
from accelerate import Accelerator
from accelerate.utils import send_to_device
from torch import nn

from stereogenbench_data import StereoPairs

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")


def main() -> None:
    accelerator = Accelerator()
    pairs = StereoPairs(SHARDS, split="train", pairs="adjacent", frames=("every", 20))
    loader = pairs.loader(
        batch_size=4, seed=0, rank=accelerator.process_index, world_size=accelerator.num_processes
    )
    network = nn.Conv2d(6, 1, 5, padding=2)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    network, optimiser = accelerator.prepare(network, optimiser)
    for epoch in range(loader.epoch, 2):
        loader.set_epoch(epoch)
        for batch in loader:
            batch = send_to_device(batch, accelerator.device)
            views = torch.cat([batch["left"], batch["right"]], dim=1).float() / 255
            error = (network(views) - batch["disparity"]).abs()[batch["valid"]].mean()
            optimiser.zero_grad()
            accelerator.backward(error)
            optimiser.step()
        accelerator.print(f"epoch {epoch}: error {error.item():.2f} px")
    accelerator.end_training()


if __name__ == "__main__":
    main()
