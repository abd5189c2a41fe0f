"""Runs an example under torchrun, notes the samples that it takes, and kills it after some batches.

python watched.py NOTES BATCHES EXAMPLE

The batches of training samples that a torch DataLoader gives become NOTES.RANK, a list of the names
of each one's samples. After so many batches the process kills itself; 0 is never.
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
    notes, batches, example = sys.argv[1:]
    sys.argv[:] = [example]
    take = dataloader._BaseDataLoaderIter.__next__
    taken = []

    def noted(self):
        batch = take(self)
        taken.append(names_of(batch))
        Path(f"{notes}.{os.environ['RANK']}").write_text(json.dumps(taken))
        if len(taken) == int(batches):
            os.kill(os.getpid(), signal.SIGKILL)
        return batch

    dataloader._BaseDataLoaderIter.__next__ = noted
    runpy.run_path(example, run_name="__main__")


if __name__ == "__main__":
    main()
