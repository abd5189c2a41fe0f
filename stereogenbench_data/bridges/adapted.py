"""The base of the datasets whose samples have the form that another project's loop takes."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, Generic, Literal, TypeVar, Unpack

from torch.utils.data import Dataset, default_collate

from stereogenbench_data.datasets.loader import LOADER_DEFAULTS, LoaderOptions, PairsLoader
from stereogenbench_data.datasets.mapped import PAIRS_DEFAULTS, Data, PairsOptions, StereoPairs
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.selection.signatures import list_options

Item = TypeVar("Item")


class AdaptedPairs(Dataset[Item], ABC, Generic[Item]):
    """The samples of a `StereoPairs`, each as an item of another form.

    It goes into torch's own `DataLoader`, as the project's own datasets do; call ``set_epoch`` of
    `pairs` before each epoch there. `loader` gives the same items with the order, the epochs and
    the saved position of ``StereoPairs.loader``.

    Attributes:
        fields: What the items are made from.
        frames: Whether items are of single frames or of clips.
        pairs: The dataset that makes the samples.
    """

    fields: ClassVar[tuple[str, ...]]
    frames: ClassVar[Literal["frame", "clip"]] = "frame"

    @list_options(PAIRS_DEFAULTS)
    def __init__(self, data: Data, **options: Unpack[PairsOptions]) -> None:
        """Select the samples; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            **options: As for `StereoPairs`, except fields.

        Raises:
            SelectionError: If nothing matches; or if the samples are sweeps, or clips where single
                frames are needed, or the reverse.
            StereoGenBenchError: As `StereoPairs` does.
        """
        self.pairs = StereoPairs(data, fields=self.fields, **options)
        plan, name = self.pairs.plan, type(self).__name__
        if plan.pairs.targets.shape[1] != 1:
            raise SelectionError(f"{name} takes single pairs, got pairs={options.get('pairs')!r}.")
        if plan.windows.is_clip != (self.frames == "clip"):
            wanted = "('clips', length)" if self.frames == "clip" else "'all' or frame numbers"
            got = options.get("frames", "first")
            raise SelectionError(f"{name} takes {self.frames}s: frames={wanted}, got {got!r}.")

    @abstractmethod
    def item(self, sample: Sample) -> Item:
        """Return the item of a sample."""

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self.pairs)

    def __getitem__(self, number: int) -> Item:
        """Return an item; it raises what `StereoPairs` does."""
        return self.item(self.pairs[number])

    def __getitems__(self, numbers: Sequence[int]) -> list[Item]:
        """Return several items in the order asked, each stream read forwards on the way."""
        return [self.item(sample) for sample in self.pairs.__getitems__(numbers)]

    @list_options(LOADER_DEFAULTS)
    def loader(
        self, batch_size: int = 1, *, num_workers: int = 0, **options: Unpack[LoaderOptions]
    ) -> PairsLoader:
        """Return a loader of batches of items, as torch's ``default_collate`` makes them.

        Args:
            batch_size: Items in a batch of one rank.
            num_workers: How many processes load; 0 loads in this one.
            **options: As for ``StereoPairs.loader``; ``collate_fn`` is given items.

        Raises:
            SelectionError: As ``StereoPairs.loader`` does; or with drop_last="pad", as items have
                no field that marks padding.
        """
        if options.get("drop_last") == "pad":
            raise SelectionError(
                f"drop_last='pad' repeats samples, and items of {type(self).__name__} have no "
                "field is_padding to tell which: use drop_last=True or False."
            )
        collate = options.pop("collate_fn", None) or default_collate
        options["collate_fn"] = partial(_collated, item=self.item, collate=collate)
        return self.pairs.loader(batch_size, num_workers=num_workers, **options)


def _collated(samples: Sequence[Sample], *, item: Any, collate: Any) -> Any:
    return collate([item(sample) for sample in samples])
