"""The classes behind `huggingface.iterable`; this module imports Hugging Face ``datasets``."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from datasets import IterableDataset
from datasets.iterable_dataset import ExamplesIterable
from torch.utils.data import get_worker_info

from stereogenbench_data.bridges.in_memory import to_arrays
from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.samples.fields import Sample


class SampleIterable(IterableDataset):  # type: ignore[misc]  # datasets ships no types
    """The samples of a `StereoPairs`, one scene after another; each scene is a shard.

    Attributes:
        pairs: The dataset that makes the samples. Datasets derived from this one (by ``shuffle``,
            ``map`` or ``split_dataset_by_node``) draw random frames and transforms for their own
            epoch; if that is 0, for the epoch of ``pairs``.
    """

    pairs: StereoPairs

    @classmethod
    def of(cls, pairs: StereoPairs) -> "SampleIterable":
        """Return the samples of a map-style dataset."""
        scenes = list(range(len(pairs.plan.scene_rows)))
        made = IterableDataset.from_generator(
            _samples, gen_kwargs={"pairs": pairs, "scenes": scenes}
        )
        plain = made._ex_iterable
        scenes_of_epoch = _ScenesOfEpoch(plain.generate_examples_fn, plain.kwargs)
        samples = cls(scenes_of_epoch, info=made.info, split=made.split)
        samples.pairs = pairs
        return samples

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the order of shuffled scenes, and of random frames and transforms."""
        super().set_epoch(epoch)
        self.pairs.set_epoch(epoch)


class _ScenesOfEpoch(ExamplesIterable):  # type: ignore[misc]  # datasets ships no types
    """The scenes; ``datasets`` passes them the epoch of any dataset derived from them.

    At the start of an iteration, ``datasets`` calls ``shift_rngs`` with the epoch, unless it is 0.
    A worker calls it a second time with the worker's number, on its share of the scenes. That
    share is a plain `ExamplesIterable`, so the second call does not change the epoch.
    """

    def shift_rngs(self, value: int) -> "_ScenesOfEpoch":
        """Return the same scenes for an epoch."""
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
