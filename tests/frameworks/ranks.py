"""Two ranks train with Accelerate, Lightning and Hugging Face's Trainer."""

import json
import os
import sys
import warnings
from importlib import import_module
from pathlib import Path

import torch
from accelerate import Accelerator
from torch.utils.data import DataLoader

from stereogenbench_data import EpochBatches, SelectionError, StereoPairStream
from tests.frameworks import runs
from tests.frameworks.forked import forked_ranks


def accelerate_steps(data, folder):
    """Return the steps of two epochs, of a stop after the 9th, and of a run that goes on there."""
    accelerator = Accelerator(cpu=True)

    def train(*, stop_at=None, resume=False):
        loader = accelerator.prepare(runs.random_frames(data).loader(4, num_workers=1))
        if resume:
            accelerator.load_state(folder / "accelerate")
        steps, ends = [], 0
        for _ in range(loader.epoch, runs.EPOCHS):
            for batch in loader:
                steps.append(batch["__key__"])
                ends += accelerator.gradient_state.end_of_dataloader
                assert batch["left"].device.type == accelerator.device.type
                if len(steps) == stop_at:
                    accelerator.save_state(folder / "accelerate")
                    break
            if len(steps) == stop_at:
                break
        accelerator.free_memory()
        return steps, ends

    whole, ends = train()
    assert ends == runs.EPOCHS
    return whole, train(stop_at=9)[0], train(resume=True)[0]


def refusals(data):
    """Return what is said where Accelerate is given shares to share again."""
    accelerator = Accelerator(cpu=True)
    pairs = runs.random_frames(data)
    stream = StereoPairStream(data, 4, fields=("left",), frames="all")
    said = []
    for loader in (
        DataLoader(pairs, batch_sampler=EpochBatches(pairs, 4), collate_fn=list),
        DataLoader(stream, batch_size=4, collate_fn=stream.collate),
    ):
        try:
            for _ in accelerator.prepare(loader):
                pass
        except SelectionError as error:
            said.append(str(error))
        accelerator.gradient_state.dataloader_references = [None]
    accelerator.free_memory()
    return said


def train(data, folder):
    warnings.simplefilter("ignore")
    found = {"accelerate": accelerate_steps(data, folder), "refused": refusals(data)}
    pairs = runs.random_frames(data)
    for name, options in {"dataset": {}, "loader": {"loader": True}}.items():
        steps = []
        for run in ({}, {"stop_at": 10}, {"resume": True}):
            if options:
                run["loader"] = pairs.loader(4)
            steps.append(runs.hugging_face(pairs, folder / name, **run))
        found[f"hugging face {name}"] = steps
    found["lightning"] = [
        runs.lightning(pairs.loader(4), folder, devices=2, **run)
        for run in ({}, {"stop_at": 7}, {"resume": True})
    ]
    rank = torch.distributed.get_rank()
    (folder / f"rank{rank}.json").write_text(json.dumps(found))


if __name__ == "__main__":
    os.environ["HF_HUB_OFFLINE"] = "1"
    import_module("transformers.trainer")  # once for both
    sys.exit(any(forked_ranks(train, sys.argv[1], Path(sys.argv[2]))))
