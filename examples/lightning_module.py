"""Lightning: a data module, and a run that goes on where it was stopped (extra 'lightning').

python examples/lightning_module.py [SHARDS [DEVICES]]

Checkpoints hold the position within the epoch: give fit a ckpt_path, and no sample comes twice.
"""

import sys
from pathlib import Path

import torch
from lightning import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import nn

from stereogenbench_data import PairsLoader, StereoPairs

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")
DEVICES = sys.argv[2] if len(sys.argv) > 2 else "auto"


class StereoData(LightningDataModule):
    """Training pairs in an order that does not depend on ranks; every eval sample exactly once."""

    def setup(self, stage: str) -> None:
        self.train = StereoPairs(SHARDS, split="train", pairs="all", frames=("every", 40))
        self.eval = StereoPairs(SHARDS, split="eval", frames=("every", 40))

    def train_dataloader(self) -> PairsLoader:
        return self.train.loader(batch_size=8, num_workers=1, seed=0)

    def val_dataloader(self) -> PairsLoader:
        return self.eval.loader(batch_size=8, shuffle=False, drop_last=False)


class Network(LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Conv2d(6, 1, 5, padding=2)

    def error(self, batch: dict) -> torch.Tensor:
        views = torch.cat([batch["left"], batch["right"]], dim=1).float() / 255
        return (self.layers(views) - batch["disparity"]).abs()[batch["valid"]].mean()

    def training_step(self, batch: dict, number: int) -> torch.Tensor:
        return self.error(batch)

    def validation_step(self, batch: dict, number: int) -> None:
        self.log("error_px", self.error(batch), batch_size=len(batch["left"]), sync_dist=True)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(self.parameters(), lr=1e-3)


if __name__ == "__main__":
    saving = ModelCheckpoint("checkpoints", every_n_train_steps=5, save_last=True)
    trainer = Trainer(max_epochs=2, devices=DEVICES, callbacks=[saving], logger=False)
    trainer.fit(Network(), datamodule=StereoData(), ckpt_path="last")
    print(f"error {trainer.callback_metrics['error_px']:.2f} px")
