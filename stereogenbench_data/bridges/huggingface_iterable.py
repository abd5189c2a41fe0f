"""The classes behind `huggingface.iterable`; this module imports Hugging Face ``datasets``."""

from collections.abc import Iterator
from typing import Any, Self

import numpy as np
from datasets import DatasetInfo, Features, IterableDataset
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
    def of(cls, pairs: StereoPairs, features: Features | None) -> "SampleIterable":
        """Return the samples of a map-style dataset, with these features or without any."""
        scenes = list(range(len(pairs.plan.scene_rows)))
        made = IterableDataset.from_generator(
            _samples, gen_kwargs={"pairs": pairs, "scenes": scenes}
        )
        plain = made._ex_iterable
        scenes_of_epoch = _ScenesOfEpoch.of(plain, features)
        samples = cls(scenes_of_epoch, info=DatasetInfo(features=features), split=made.split)
        samples.pairs = pairs
        return samples

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the order of shuffled scenes, and of random frames and transforms."""
        super().set_epoch(epoch)
        self.pairs.set_epoch(epoch)


class _Scenes(ExamplesIterable):  # type: ignore[misc]  # datasets ships no types
    """Scenes whose samples are as their features say.

    ``datasets`` passes on what has types as it is. Otherwise it would encode each sample, and turn
    arrays of one axis into lists.

    Attributes:
        features: The features; None where samples differ in size.
    """

    features: Features | None = None

    @classmethod
    def of(cls, scenes: ExamplesIterable, features: Features | None, **options: Any) -> Self:
        """Return the same scenes with features."""
        typed = cls(scenes.generate_examples_fn, scenes.kwargs | options)
        typed.features = features
        return typed

    @property
    def is_typed(self) -> bool:
        """Whether samples have features."""
        return self.features is not None


class _ScenesOfEpoch(_Scenes):
    """The scenes; ``datasets`` passes them the epoch of any dataset derived from them.

    At the start of an iteration, ``datasets`` calls ``shift_rngs`` with the epoch, unless it is 0.
    A worker calls it a second time with the worker's number, on its share of the scenes. That
    share is `_Scenes`, so the second call does not change the epoch.
    """

    def shift_rngs(self, value: int) -> "_ScenesOfEpoch":
        """Return the same scenes for an epoch."""
        return _ScenesOfEpoch.of(self, self.features, epoch=value)

    def shuffle_data_sources(self, generator: np.random.Generator) -> "_ScenesOfEpoch":
        """Return the scenes in another order."""
        return _ScenesOfEpoch.of(super().shuffle_data_sources(generator), self.features)

    def shard_data_sources(
        self,
        num_shards: int,
        index: int,
        contiguous: bool = True,  # noqa: FBT001, FBT002 - as datasets calls it
    ) -> _Scenes:
        """Return a share of the scenes."""
        kind = _ScenesOfEpoch if get_worker_info() is None else _Scenes
        return kind.of(super().shard_data_sources(num_shards, index, contiguous), self.features)


def _samples(pairs: StereoPairs, scenes: list[int], epoch: int | None = None) -> Iterator[Sample]:
    drawn = pairs if epoch is None else pairs.with_own_videos(epoch=epoch)
    first: Any = pairs.plan.first_sample
    try:
        for scene in scenes:
            for number in range(int(first[scene]), int(first[scene + 1])):
                yield to_arrays(drawn[number])
    finally:
        if drawn is not pairs:
            drawn.close()
