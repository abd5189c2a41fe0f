"""A torch `DataLoader` over the batches of an epoch that knows what its loop has consumed."""

from collections.abc import Iterator, Mapping
from typing import Any, Final, Protocol, runtime_checkable

import torch
from torch.utils.data import DataLoader

from stereogenbench_data.datasets.batches import EpochBatches, EpochOptions, Numbered, State
from stereogenbench_data.datasets.parcels import Parcel, Shelf
from stereogenbench_data.datasets.tensors import collate
from stereogenbench_data.errors import SelectionError

_ORDERED: Final = "or torch's own DataLoader over the dataset"
_INSTEAD: Final = {
    "shuffle": "use order='shuffled' or order='sequential'",
    "drop_last": "use tail='drop', tail='wrap' or tail='uneven'",
    "sampler": f"use seed= and order=, {_ORDERED}",
    "batch_sampler": f"use seed= and order=, {_ORDERED} with EpochBatches",
}
"""Options of `DataLoader` that would undo the order, and what to use for them."""


class LoaderOptions(EpochOptions, total=False):
    """`EpochOptions`, and what torch's own `DataLoader` takes."""

    pin_memory: bool
    timeout: float
    worker_init_fn: Any
    multiprocessing_context: Any
    generator: torch.Generator | None
    prefetch_factor: int | None
    persistent_workers: bool
    collate_fn: Any


@runtime_checkable
class Keeping(Numbered, Protocol):
    """A numbered dataset that is told how many scenes are read at a time."""

    def keep_open(self, batches: EpochBatches, *, processes: int) -> None:
        """Keep videos open for the scenes that one of so many processes reads at a time."""
        ...

    def close(self) -> None:
        """Close the videos that are open in this process."""
        ...

    @property
    def shelf(self) -> Shelf | None:
        """Where workers write their batches, None for memory of each batch's own."""
        ...

    @shelf.setter
    def shelf(self, shelf: Shelf | None) -> None: ...


class PairsLoader(DataLoader[Any]):
    """The batches of an epoch, loaded: what ``loader(...)`` of a dataset returns.

    It is a torch `DataLoader`. `state_dict` counts the batches that the loop has taken, not those
    that workers have read ahead, so that it can be saved after any batch and loaded under other
    numbers of ranks and workers. Where a rank's worker dies, the loop ends with torch's own error.

    Its epoch is its own from the first `set_epoch` or `load_state_dict` on, and until then that of
    the dataset that it was made from; its open videos are its own. So loaders of one dataset, one
    to train and one to validate, leave each other alone.
    """

    def __init__(
        self, dataset: Keeping, batches: EpochBatches, *, num_workers: int, **options: Any
    ) -> None:
        """Load batches of a dataset; ``options`` are those of `DataLoader`."""
        options.setdefault("collate_fn", collate)
        self._keeping = dataset
        self._shelf = Shelf(0)
        super().__init__(
            dataset,  # type: ignore[arg-type]  # a protocol: torch asks for len and [] alone
            batch_sampler=batches,
            num_workers=num_workers,
            **options,
        )
        self.batches = batches
        self._position = batches.next_position()
        dataset.keep_open(batches, processes=batches.world_size * max(1, num_workers))

    @property
    def epoch(self) -> int:
        """The current epoch, from 0."""
        return self.batches.dataset.epoch

    def set_epoch(self, epoch: int) -> None:
        """Go to another epoch: another order, other random frames and transforms.

        Call it before each epoch. With the epoch of a state just loaded it changes nothing, so
        that a training loop begins as ``for epoch in range(loader.epoch, epochs)``.

        Raises:
            SelectionError: If it is negative.
        """
        self.batches.set_epoch(epoch)

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]  # torch names a private class
        """Yield the batches of the current epoch, or what a loaded state left of it."""
        batches = self.batches
        epoch, start = self._position = batches.next_position()
        end, consumed = batches.end(start), start
        for number, batch in zip(batches.share(start), self._loaded(), strict=True):
            consumed += batches.world_size
            self._position = epoch, min(consumed, end)
            if batches.tail == "wrap":
                batch["is_padding"] = torch.from_numpy(batches.is_padding(number))
            yield batch

    def _loaded(self) -> Iterator[Any]:
        """Yield batches as torch loads them; name a worker that died, however torch noticed."""
        try:
            for batch in self._begun():
                yield self._shelf.opened(batch) if isinstance(batch, Parcel) else batch
        except (ConnectionError, EOFError) as error:
            raise RuntimeError(
                f"a DataLoader worker died ({type(error).__name__}: {error}): it was killed, "
                "perhaps for want of memory. Load the last state, and use fewer workers or open "
                "scenes."
            ) from error

    def _begun(self) -> Iterator[Any]:
        """Begin to load; workers that start now share a shelf with this process."""
        keep_workers = self._iterator is not None
        if self.num_workers == 0 or self.pin_memory or self.collate_fn is not collate:
            return super().__iter__()
        if not keep_workers:
            self._shelf = Shelf(self.num_workers)
        self._keeping.shelf, self.collate_fn = self._shelf, self._shelf.packed
        try:
            return super().__iter__()
        finally:
            self._keeping.shelf, self.collate_fn = None, collate

    def state_dict(self) -> State:
        """Return the position after the last batch that the loop has taken."""
        epoch, consumed = self._position
        return self.batches.state_at(self.epoch, consumed if epoch == self.epoch else 0)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to a saved position; nothing is replayed, and later epochs are whole again.

        Raises:
            StateError: If it belongs to other samples or another order, naming what differs.
        """
        self.batches.load_state_dict(state)
        self._position = self.batches.next_position()

    def close(self) -> None:
        """Close the videos that this loader holds open in this process; it can be used again."""
        self._keeping.close()


def require_options(options: Mapping[str, Any]) -> None:
    """Refuse what a loader does not take, naming what to use instead.

    Raises:
        SelectionError: If there is such an option.
    """
    known = LoaderOptions.__annotations__
    for name in options:
        if name in _INSTEAD:
            raise SelectionError(
                f"a loader orders the epoch and takes no {name}: {_INSTEAD[name]}."
            )
        if name not in known:
            raise SelectionError(f"there is no option {name!r}; there are {', '.join(known)}.")


def split_options(options: Mapping[str, Any]) -> tuple[EpochOptions, dict[str, Any]]:
    """Return the options that order an epoch, and the others."""
    names = EpochOptions.__annotations__
    ordering = {name: value for name, value in options.items() if name in names}
    others = {name: value for name, value in options.items() if name not in names}
    return EpochOptions(**ordering), others  # type: ignore[typeddict-item]  # keys are its own
