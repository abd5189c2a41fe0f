"""Runs an example as it is, notes the samples that it takes, and kills it after some batches.

python watched.py NOTES BATCHES EXAMPLE [ARGUMENTS]

Each batch of training samples that a torch DataLoader gives becomes a line of NOTES.RANK, its
samples' names. After so many batches the process kills itself; 0 is never.
"""

import json
import os
import runpy
import signal
import sys
from pathlib import Path

from torch.utils.data import dataloader


def names_of(batch):
    facts = zip(batch["scene"], batch["pair"].tolist(), batch["frame_index"].tolist(), strict=True)
    return [f"{scene} {pair} {frame}" for scene, pair, frame in facts]


def main():
    notes, batches, example = sys.argv[1:4]
    sys.argv[:] = sys.argv[3:]
    take = dataloader._BaseDataLoaderIter.__next__
    taken = 0

    def noted(self):
        nonlocal taken
        batch = take(self)
        names = names_of(batch)
        if names[0].startswith("train/"):
            taken += 1
            with Path(f"{notes}.{os.environ.get('RANK', '0')}").open("a") as file:
                file.write(json.dumps(names) + "\n")
        if taken == int(batches):
            os.kill(os.getpid(), signal.SIGKILL)
        return batch

    dataloader._BaseDataLoaderIter.__next__ = noted
    runpy.run_path(example, run_name="__main__")


if __name__ == "__main__":
    main()
