"""The classes behind `huggingface.iterable`; importing them imports Hugging Face ``datasets``."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from datasets import IterableDataset
from datasets.iterable_dataset import ExamplesIterable
from torch.utils.data import get_worker_info

from stereogenbench_data.bridges.arrays import to_arrays
from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.samples.fields import Sample


class SampleIterable(IterableDataset):  # type: ignore[misc]  # datasets ships no types
    """The samples of a `StereoPairs`, one scene after another; each scene is a shard.

    Attributes:
        pairs: The dataset that makes the samples. Datasets that are derived from this one (by
            ``shuffle``, ``map`` or ``split_dataset_by_node``) draw random frames and transforms for
            the epoch that they are set to; in their epoch 0 for that of ``pairs``.
    """

    pairs: StereoPairs

    @classmethod
    def of(cls, pairs: StereoPairs) -> "SampleIterable":
        """Return the samples of a dataset."""
        scenes = list(range(len(pairs.plan.scene_rows)))
        made = IterableDataset.from_generator(
            _samples, gen_kwargs={"pairs": pairs, "scenes": scenes}
        )
        plain = made._ex_iterable
        told = _ScenesOfEpoch(plain.generate_examples_fn, plain.kwargs)
        samples = cls(told, info=made.info, split=made.split)
        samples.pairs = pairs
        return samples

    def set_epoch(self, epoch: int) -> None:
        """Order the scenes anew if they are shuffled, and draw for this epoch."""
        super().set_epoch(epoch)
        self.pairs.set_epoch(epoch)


class _ScenesOfEpoch(ExamplesIterable):  # type: ignore[misc]  # datasets ships no types
    """The scenes, which ``datasets`` tells the epoch of whatever was derived from them.

    When it begins to iterate it calls ``shift_rngs`` with the epoch, unless that is 0; and in a
    worker a second time, with the worker's number, on the share of the worker. That share is a
    plain `ExamplesIterable`, which is not told.
    """

    def shift_rngs(self, value: int) -> "_ScenesOfEpoch":
        """Return the same scenes, drawn for an epoch."""
        return _ScenesOfEpoch(self.generate_examples_fn, self.kwargs | {"epoch": value})

    def shuffle_data_sources(self, generator: np.random.Generator) -> "_ScenesOfEpoch":
        """Return the scenes in another order."""
        plain = super().shuffle_data_sources(generator)
        return _ScenesOfEpoch(plain.generate_examples_fn, plain.kwargs)

    def shard_data_sources(
        self,
        num_shards: int,
        index: int,
        contiguous: bool = True,  # noqa: FBT001, FBT002 - as datasets calls it
    ) -> ExamplesIterable:
        """Return a share of the scenes."""
        plain = super().shard_data_sources(num_shards, index, contiguous)
        if get_worker_info() is not None:
            return plain
        return _ScenesOfEpoch(plain.generate_examples_fn, plain.kwargs)


def _samples(pairs: StereoPairs, scenes: list[int], epoch: int | None = None) -> Iterator[Sample]:
    drawn = pairs if epoch is None else pairs._copy()
    if epoch is not None:
        drawn.set_epoch(epoch)
    first: Any = pairs.plan.first_sample
    try:
        for scene in scenes:
            for number in range(int(first[scene]), int(first[scene + 1])):
                yield to_arrays(drawn[number])
    finally:
        if drawn is not pairs:
            drawn.close()
