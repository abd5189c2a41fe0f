"""Runs an example as two ranks, notes the samples that they take, and kills each after 9 batches.

python -m tests.examples.watched FOLDER EXAMPLE

Then it runs the example once more, to its end. The batches of training samples that a loader
gives become FOLDER/killed.RANK and FOLDER/done.RANK, a list of the names of each one's
samples, and FOLDER/ends.json says how the ranks of both runs ended.
"""

import json
import os
import runpy
import signal
import sys
from pathlib import Path

from torch.nn import parallel

from stereogenbench_data.datasets import loader
from tests.frameworks.forked import forked_ranks

IMPORTED_FOR_BOTH = (loader, parallel)


def names_of(batch):
    facts = zip(batch["scene"], batch["pair"].tolist(), batch["frame_index"].tolist(), strict=True)
    return [f"{scene} {pair} {frame}" for scene, pair, frame in facts]


def watch(notes, example, batches):
    take = loader.LoaderPass.__next__
    taken = []

    def noted(self):
        batch = take(self)
        taken.append(names_of(batch))
        Path(f"{notes}.{os.environ['RANK']}").write_text(json.dumps(taken))
        if len(taken) == batches:
            os.kill(os.getpid(), signal.SIGKILL)
        return batch

    loader.LoaderPass.__next__ = noted
    sys.argv[:] = [example]
    runpy.run_path(example, run_name="__main__")


if __name__ == "__main__":
    folder, example = sys.argv[1:]
    os.chdir(folder)
    ends = [
        forked_ranks(watch, name, example, count) for name, count in (("killed", 9), ("done", 0))
    ]
    Path("ends.json").write_text(json.dumps(ends))
