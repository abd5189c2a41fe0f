"""The base of the datasets whose samples have the form that another project's loop takes."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, Unpack, cast

from torch.utils.data import ConcatDataset, Dataset, default_collate

from stereogenbench_data.datasets.batch_buffers import Buffers
from stereogenbench_data.datasets.loader import LoaderOptions, PairsLoader
from stereogenbench_data.datasets.mapped import Check, Data, StereoPairs
from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.request import Transform
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.options import options_of, require_options
from stereogenbench_data.selection.plan import Selection
from stereogenbench_data.sources.cache import ShardCache

Item = TypeVar("Item")


class PairsOptions(Selection, total=False):
    """What `StereoPairs` takes, except data and fields."""

    size: tuple[int, int] | str | None
    transform: Transform | None
    depth: DepthEncoding | None
    conventions: str | Path | Conventions | None
    seed: int
    cache: ShardCache | None
    check: Check
    buffers: Buffers
    fetch_ahead_bytes: int


class AdaptedPairs(Dataset[Item], Generic[Item]):
    """The samples of a `StereoPairs`, each as an item of another form.

    It goes into torch's own `DataLoader`, and into sums and products of datasets, as the project's
    own datasets do. `loader` gives the same items with the order, the epochs and the saved position
    of ``StereoPairs.loader``.

    Attributes:
        pairs: The dataset that makes the samples.
        adapt: Makes an item of a sample.
    """

    def __init__(
        self,
        data: Data,
        *,
        fields: Iterable[str],
        adapt: Callable[[Sample], Item],
        frames: Literal["frame", "clip"],
        options: PairsOptions,
    ) -> None:
        """Select the samples; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            fields: What the items are made from.
            adapt: Makes an item of a sample; it can be pickled.
            frames: Whether items are of single frames or of clips.
            options: As for `StereoPairs`.

        Raises:
            SelectionError: If there is no such option; if nothing matches; or if the samples are
                sweeps, or clips where single frames are needed, or the reverse.
            FieldError: If ``fields`` is among the options, or the data are a dataset.
        """
        name = type(self).__name__
        if "fields" in options:
            raise FieldError(f"{name} takes no fields: its items have what the project reads.")
        if isinstance(data, Dataset):
            raise FieldError(
                f"{name} takes what {type(data).__name__} takes, not the dataset itself: give the "
                "data and the options that it was made with."
            )
        # A subclass of the user may take options that it does not declare.
        declares = next(each for each in type(self).__mro__ if options_of(each))
        known = options_of(StereoPairs)
        require_options(declares, [option for option in options if option not in known])
        self.pairs = StereoPairs(data, fields=fields, **options)
        self.adapt = adapt
        plan = self.pairs.plan
        if plan.pairs.targets.shape[1] != 1:
            raise SelectionError(f"{name} takes single pairs, got pairs={options.get('pairs')!r}.")
        if plan.windows.is_clip != (frames == "clip"):
            wanted = "('clips', length)" if frames == "clip" else "'first', 'all' or frame numbers"
            got = options.get("frames", "first")
            raise SelectionError(f"{name} takes {frames}s: give frames={wanted}, got {got!r}.")

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self.pairs)

    def __getitem__(self, number: int) -> Item:
        """Return an item.

        Raises:
            IndexError: If there is no such item.
            StorageError: If a file is missing or altered.
            MediaError: If a video does not decode to what the index says.
        """
        return self.adapt(self.pairs[number])

    def __getitems__(self, numbers: Sequence[int]) -> list[Item]:
        """Return several items in the order asked, each stream read forwards on the way."""
        return [self.adapt(sample) for sample in self.pairs.__getitems__(numbers)]

    def __mul__(self, times: int) -> "ConcatDataset[Item]":
        """Return these items so many times over, to weigh datasets in a sum."""
        return ConcatDataset([self] * times)

    __rmul__ = __mul__

    def loader(
        self, batch_size: int = 1, *, num_workers: int = 0, **options: Unpack[LoaderOptions]
    ) -> PairsLoader:
        """Return a loader of batches of items, as torch's ``default_collate`` makes them.

        Each pass is of the next epoch, with new random frames and transforms, without a call of
        `set_epoch`.

        Args:
            batch_size: Items in a batch of one rank.
            num_workers: How many processes load; 0 loads in this one.
            **options: As for ``StereoPairs.loader``; ``collate_fn`` is given items.

        Raises:
            SelectionError: If there is no such option, it is out of its range, or every batch would
                be dropped; or with drop_last="pad", as items have no field that marks padding.
        """
        if options.get("drop_last") == "pad":
            raise SelectionError(
                f"drop_last='pad' repeats samples, and items of {type(self).__name__} have no "
                "field is_padding to tell which: use drop_last=True or False."
            )
        collate = options.pop("collate_fn", None) or default_collate
        made = partial(_collated, adapt=self.adapt, collate=collate)
        chosen = cast("LoaderOptions", {**options, "collate_fn": made})
        return self.pairs.loader(batch_size, num_workers=num_workers, **chosen)

    @property
    def epoch(self) -> int:
        """The epoch that random frames and transforms are drawn for."""
        return self.pairs.epoch

    def set_epoch(self, epoch: int) -> None:
        """Draw random frames and transforms anew, in this process and in running workers.

        Call it before each epoch where torch's own `DataLoader` is used: it does not.

        Raises:
            SelectionError: If it is negative.
        """
        self.pairs.set_epoch(epoch)

    def close(self) -> None:
        """Close the videos that this process holds open; the dataset can be used again."""
        self.pairs.close()

    def __repr__(self) -> str:
        """Say what it holds."""
        return f"<{type(self).__name__} of {self.pairs!r}>"


def _collated(
    samples: Sequence[Sample],
    *,
    adapt: Callable[[Sample], Any],
    collate: Callable[[list[Any]], Any],
) -> Any:
    sizes = {sample["left"].shape[-2:] for sample in samples}
    if len(sizes) > 1:
        shown = " and ".join(f"{width}x{height}" for height, width in sorted(sizes))
        raise FieldError(f"a batch has pictures of {shown} pixels: give size=(height, width).")
    return collate([adapt(sample) for sample in samples])
