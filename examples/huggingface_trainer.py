"""Hugging Face's Trainer, which goes on where it was stopped (pip install transformers accelerate).

python examples/huggingface_trainer.py [SHARDS]

The loader shares its batches among ranks, keeps each video open while its frames are due, and
continues in mid-epoch. Without get_train_dataloader the Trainer shuffles the dataset itself.
"""

import sys
from pathlib import Path

import torch
from torch import nn
from transformers import Trainer, TrainingArguments
from transformers.trainer_utils import get_last_checkpoint

from stereogenbench_data import PairsLoader, StereoPairs, collate

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")
OUTPUT = Path("output")


class Network(nn.Module):
    """Takes fields of a batch by their names; the others are in kwargs."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Conv2d(6, 1, 5, padding=2)

    def forward(self, left, right, disparity, valid, **kwargs) -> dict[str, torch.Tensor]:
        predicted = self.layers(torch.cat([left, right], dim=1).float() / 255)
        return {"loss": (predicted - disparity).abs()[valid].mean(), "predicted": predicted}


class StereoTrainer(Trainer):
    def get_train_dataloader(self) -> PairsLoader:
        return self.train_dataset.loader(
            self.args.train_batch_size, num_workers=self.args.dataloader_num_workers,
            seed=self.args.seed,
        )  # fmt: skip


def main() -> None:
    arguments = TrainingArguments(
        OUTPUT, num_train_epochs=2, per_device_train_batch_size=4, dataloader_num_workers=1,
        learning_rate=1e-3, save_steps=5, save_total_limit=2, remove_unused_columns=False,
        logging_steps=5, report_to="none",
    )  # fmt: skip
    pairs = StereoPairs(SHARDS, split="train", pairs="adjacent", frames=("every", 20))
    trainer = StereoTrainer(Network(), arguments, train_dataset=pairs, data_collator=collate)
    checkpoint = get_last_checkpoint(OUTPUT) if OUTPUT.is_dir() else None
    trainer.train(resume_from_checkpoint=checkpoint)


if __name__ == "__main__":
    main()
