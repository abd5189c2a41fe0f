"""Accelerate: a training loop for any number of processes, which goes on where it was stopped.

accelerate launch examples/accelerate_loop.py [SHARDS]

Prepare the loader like the rest. It gives each rank its share of the batches, moves them to the
accelerator's device, and adds its position to the saved state: load_state continues in mid-epoch,
without skip_first_batches. A checkpoint gets its name when it is whole.
"""

import sys
from pathlib import Path

import torch
from accelerate import Accelerator
from torch import nn

from stereogenbench_data import StereoPairs

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")
CHECKPOINTS = Path("checkpoints")


def main() -> None:
    accelerator = Accelerator()
    pairs = StereoPairs(SHARDS, split="train", pairs="adjacent", frames=("every", 20))
    loader = pairs.loader(batch_size=4, num_workers=1, seed=0)
    network = nn.Conv2d(6, 1, 5, padding=2)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    network, optimizer, loader = accelerator.prepare(network, optimizer, loader)
    saved = sorted(CHECKPOINTS.glob("epoch_*[0-9]"))
    if saved:
        accelerator.load_state(saved[-1])
    for epoch in range(loader.epoch, 2):
        for step, batch in enumerate(loader, start=1):
            views = torch.cat([batch["left"], batch["right"]], dim=1).float() / 255
            loss = (network(views) - batch["disparity"]).abs()[batch["valid"]].mean()
            accelerator.backward(loss)
            optimizer.step()
            optimizer.zero_grad()
            if step % 5 == 0:
                taken = loader.stats().batches_taken
                checkpoint = CHECKPOINTS / f"epoch_{epoch:03d}_batch_{taken:06d}"
                accelerator.save_state(checkpoint.with_suffix(".tmp"))
                accelerator.wait_for_everyone()
                if accelerator.is_main_process:
                    checkpoint.with_suffix(".tmp").rename(checkpoint)
        accelerator.print(f"epoch {epoch}: error {loss.item():.2f} px")
    accelerator.end_training()


if __name__ == "__main__":
    main()
