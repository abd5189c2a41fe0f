"""Training runs of the frameworks' own trainers over a loader: whole, stopped, and gone on with.

A run returns what each of its steps was given: for each sample its key, which holds its frame.
"""

import os
import warnings
from pathlib import Path

import torch
from lightning import Callback, LightningModule
from lightning import Trainer as LightningTrainer

from stereogenbench_data import StereoPairs, collate

EPOCHS = 2


def random_frames(data):
    """Return a dataset whose frames differ from epoch to epoch: 60 samples."""
    return StereoPairs(data, fields=("left", "__key__"), frames=("random", 3), pairs="adjacent")


class _Scalar(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.factor = torch.nn.Parameter(torch.zeros(1))
        self.steps = []

    def loss(self, batch):
        self.steps.append(batch["__key__"])
        return (self.factor * batch["left"].float().mean()).mean()


class _Module(LightningModule):
    def __init__(self, steps=1):
        super().__init__()
        self.network = _Scalar()
        self.steps = steps

    def training_step(self, batch, number):
        return self.network.loss(batch)

    def configure_optimizers(self):
        """As docs/trainers.md says: with trainer.estimated_stepping_batches no run would go on."""
        optimiser = torch.optim.SGD(self.parameters(), 1e-6)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-6, total_steps=self.steps)
        return [optimiser], [{"scheduler": schedule, "interval": "step"}]


class _Stopped(Exception):
    pass


class _StopAt(Callback):
    def __init__(self, step, checkpoint):
        self.step, self.checkpoint = step, checkpoint

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            trainer.save_checkpoint(self.checkpoint)
            raise _Stopped


def _trainer(**options):
    return LightningTrainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_model_summary=False,
        enable_progress_bar=False, **options,
    )  # fmt: skip


def lightning(loader, folder, *, stop_at=None, resume=False, devices=1, **options):
    """Train with Lightning; stop after a step's checkpoint, or go on from it."""
    module, checkpoint = _Module(EPOCHS * len(loader)), Path(folder) / "lightning.ckpt"
    trainer = _trainer(
        max_epochs=EPOCHS, devices=devices, strategy="ddp" if devices > 1 else "auto",
        callbacks=[_StopAt(stop_at, checkpoint)] if stop_at else [], **options,
    )  # fmt: skip
    try:
        path = {"ckpt_path": checkpoint, "weights_only": False} if resume else {}
        trainer.fit(module, loader, **path)
    except _Stopped:
        pass
    return module.network.steps


def predicted(loader):
    """Return the keys that Lightning's predict goes through."""

    class Keys(_Module):
        def predict_step(self, batch, number):
            return batch["__key__"]

    return [key for keys in _trainer(devices=1).predict(Keys(), loader) for key in keys]


class _Model(_Scalar):
    def forward(self, **batch):
        return {"loss": self.loss(batch)}


def hugging_face(pairs, folder, *, stop_at=None, resume=False, batch_size=4, loader=None):
    """Train with transformers' Trainer, over the dataset itself or over a loader of it."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    from transformers import Trainer, TrainerCallback, TrainingArguments

    class Stopping(TrainerCallback):
        def on_step_end(self, args, state, control, **_):
            control.should_save = control.should_training_stop = state.global_step == stop_at
            return control

    class OwnLoader(Trainer):
        def get_train_dataloader(self):
            return super().get_train_dataloader() if loader is None else loader

    arguments = TrainingArguments(
        str(folder), per_device_train_batch_size=batch_size, num_train_epochs=EPOCHS, use_cpu=True,
        save_strategy="no", report_to=[], disable_tqdm=True, remove_unused_columns=False, seed=1,
        ddp_backend="gloo" if torch.distributed.is_initialized() else None, logging_steps=1000,
    )  # fmt: skip
    model = _Model()
    trainer = OwnLoader(
        model=model, args=arguments, train_dataset=pairs, data_collator=collate,
        callbacks=[Stopping()],
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.train(resume_from_checkpoint=resume or None)
    return model.steps
