"""What training frameworks need of a loader that divides its batches among ranks itself.

Accelerate and Lightning give each rank its share of a torch `DataLoader`. Our loaders have already
done that; dividing them again would silently lose samples. Lightning leaves loaders alone whose
sampler is torch's `DistributedSampler`, Accelerate those that say they are prepared. Batches and
streams that are divided twice all the same are refused (`EpochBatches`).
"""

import sys
from collections.abc import Iterator
from typing import Any, Final

import torch
from torch.utils.data import DistributedSampler, SequentialSampler

from stereogenbench_data.datasets.batches import EpochBatches


class ShareSampler(DistributedSampler[Any]):
    """The samples of one rank, as a sampler that tells frameworks that they are divided already."""

    def __init__(self, batches: EpochBatches) -> None:
        """Stand for the samples of these batches."""
        # torch asks a sampler's dataset for its length alone.
        samples: Any = range(batches.samples_of_epoch)
        super().__init__(samples, num_replicas=batches.world_size, rank=batches.rank)
        self.batches = batches

    def __iter__(self) -> Iterator[int]:
        """Yield the numbers of the samples of this rank's batches."""
        for batch in self.batches:
            yield from batch

    def __len__(self) -> int:
        """The number of samples in this rank's full batches."""
        return len(self.batches) * self.batches.batch_size

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the batches: Lightning does before each epoch."""
        self.batches.set_epoch(epoch)


class OrderedShareSampler(ShareSampler, SequentialSampler):
    """The samples of one rank in order: Lightning's ``overfit_batches`` leaves them as they are."""


def share_sampler(batches: EpochBatches) -> ShareSampler:
    """Return the sampler that stands for these batches."""
    return ShareSampler(batches) if batches.rule.shuffle else OrderedShareSampler(batches)


class AcceleratedLoader:
    """The part of a loader that Accelerate talks to.

    Attributes:
        use_stateful_dataloader: That Accelerate's ``save_state`` keeps the loader's ``state_dict``.
        end_of_dataloader: Whether the batch given last is the last of its pass.
        remainder: How many samples of all ranks' last batches are not padding; 0 where none is
            padding.
    """

    batches: EpochBatches
    use_stateful_dataloader: Final = True
    end_of_dataloader = False
    remainder = 0
    _device: torch.device | None = None
    _gradient_state: Any = None

    @property
    def total_batch_size(self) -> int:
        """How many samples the batches of all ranks hold together."""
        return self.batches.batch_size * self.batches.world_size

    @property
    def total_dataset_length(self) -> int:
        """How many samples an epoch has."""
        return self.batches.samples_of_epoch

    @property
    def _is_accelerate_prepared(self) -> bool:
        """Whether Accelerate need not divide the batches; ``accelerator.prepare`` reads it.

        Raises:
            SelectionError: If the batches are shared out otherwise than Accelerate's processes are.
        """
        states = sys.modules.get("accelerate.state")
        if states is None:
            return False
        state = states.PartialState()
        self.batches.require_group(state.process_index, state.num_processes)
        self._device = state.device
        self._gradient_state = states.GradientState()
        return True

    @_is_accelerate_prepared.setter
    def _is_accelerate_prepared(self, value: bool) -> None:
        """Do nothing: Accelerate sets what it has just read."""

    def _enter_loop(self) -> None:
        """Tell Accelerate that a loop over this loader begins."""
        if self._gradient_state is not None:
            self.remainder = 0
            if not self.batches.drop_last:
                self.remainder = self.total_dataset_length % self.total_batch_size
            self._gradient_state._add_dataloader(self)

    def _leave_loop(self) -> None:
        """Tell Accelerate that the loop is over."""
        if self._gradient_state is not None:
            self._gradient_state._remove_dataloader(self)

    def on_device(self, batch: Any) -> Any:
        """Return a batch on the device of Accelerate's process; as it is without Accelerate."""
        if self._device is None:
            return batch
        from accelerate.utils import send_to_device

        pinned = isinstance(batch, dict) and any(
            isinstance(value, torch.Tensor) and value.is_pinned() for value in batch.values()
        )
        return send_to_device(batch, self._device, non_blocking=pinned)


def accelerates_epoch(dataset: object) -> int | None:
    """Return the epoch of the pass that Accelerate begins over a map-style dataset, None if none.

    Accelerate counts its passes, and calls ``set_epoch`` of a dataset in some of its loops only:
    neither where it shares batches among processes nor where it goes on in mid-epoch.
    """
    states = sys.modules.get("accelerate.state")
    active = None if states is None else states.GradientState().active_dataloader
    if active is None or getattr(active, "dataset", None) is not dataset:
        return None
    iteration = getattr(active, "iteration", None)
    return iteration if isinstance(iteration, int) else None
