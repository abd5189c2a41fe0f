"""DistributedDataParallel with saving and resuming, run by torchrun.

torchrun --nproc-per-node 2 examples/distributed.py [SHARDS]

Every rank takes its own batches of one global order. Training resumes after the batch at which the
state was saved, also with another number of ranks or workers. On GPUs each rank takes its own.
"""

import os
import sys
from pathlib import Path

import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

from stereogenbench_data import StereoPairs, to_device

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")
STATE = Path("state.pt")


def main() -> None:
    if "LOCAL_RANK" not in os.environ:
        raise SystemExit(f"torchrun sets the ranks: torchrun --nproc-per-node 2 {sys.argv[0]}")
    device = torch.device("cpu")
    if torch.cuda.is_available():
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    rank = distributed.get_rank()
    pairs = StereoPairs(SHARDS, split="train", pairs="adjacent", frames=("every", 20))
    loader = pairs.loader(batch_size=4, num_workers=1, seed=0, pin_memory=device.type == "cuda")
    network = DistributedDataParallel(nn.Conv2d(6, 1, 5, padding=2).to(device))
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    if STATE.exists():
        state = torch.load(STATE, weights_only=True, map_location=device)
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        loader.load_state_dict(state["loader"])
    for epoch in range(loader.epoch, 2):
        for number, batch in enumerate(to_device(loader, device)):
            views = torch.cat([batch["left"], batch["right"]], dim=1).float() / 255
            error = (network(views) - batch["disparity"]).abs()[batch["valid"]].mean()
            optimiser.zero_grad()
            error.backward()
            optimiser.step()
            if rank == 0 and number % 5 == 0:
                state = {"network": network.state_dict(), "optimiser": optimiser.state_dict()}
                torch.save(state | {"loader": loader.state_dict()}, STATE.with_suffix(".tmp"))
                STATE.with_suffix(".tmp").replace(STATE)
        print(f"rank {rank}: epoch {epoch}, error {error.item():.2f} px", flush=True)
    distributed.destroy_process_group()


if __name__ == "__main__":
    main()
