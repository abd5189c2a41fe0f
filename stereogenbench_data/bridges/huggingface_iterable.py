"""The class behind `huggingface.iterable`; importing it imports Hugging Face ``datasets``."""

from collections.abc import Iterator
from typing import Any

from datasets import IterableDataset

from stereogenbench_data.bridges.arrays import to_arrays
from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.samples.load import Sample


class SampleIterable(IterableDataset):  # type: ignore[misc]  # datasets ships no types
    """The samples of a `StereoPairs`, one scene after another; each scene is a shard.

    Attributes:
        pairs: The dataset that makes the samples. Datasets that are derived from this one (by
            ``shuffle``, ``map`` or ``split_dataset_by_node``) draw random frames and transforms for
            the epoch of ``pairs``: call ``pairs.set_epoch`` beside their own ``set_epoch``.
    """

    pairs: StereoPairs

    @classmethod
    def of(cls, pairs: StereoPairs) -> "SampleIterable":
        """Return the samples of a dataset."""
        scenes = list(range(len(pairs.plan.scene_rows)))
        made = IterableDataset.from_generator(
            _samples, gen_kwargs={"pairs": pairs, "scenes": scenes}
        )
        samples = cls(made._ex_iterable, info=made.info, split=made.split)
        samples.pairs = pairs
        return samples

    def set_epoch(self, epoch: int) -> None:
        """Order the scenes anew if they are shuffled, and draw for this epoch."""
        super().set_epoch(epoch)
        self.pairs.set_epoch(epoch)


def _samples(pairs: StereoPairs, scenes: list[int]) -> Iterator[Sample]:
    first: Any = pairs.plan.first_sample
    for scene in scenes:
        for number in range(int(first[scene]), int(first[scene + 1])):
            yield to_arrays(pairs[number])
