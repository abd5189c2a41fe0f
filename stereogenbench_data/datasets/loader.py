"""A torch `DataLoader` over the batches of an epoch that knows what its loop has consumed."""

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from torch.utils.data import DataLoader

from stereogenbench_data.datasets.batches import EpochBatches, EpochOptions, Numbered, State
from stereogenbench_data.datasets.tensors import collate


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


class PairsLoader(DataLoader[Any]):
    """The batches of an epoch, loaded: what ``loader(...)`` of a dataset returns.

    It is a torch `DataLoader`. `state_dict` counts the batches that the loop has taken, not those
    that workers have read ahead, so that it can be saved after any batch and loaded under other
    numbers of ranks and workers. Where a rank's worker dies, the loop ends with torch's own error.
    """

    def __init__(
        self, dataset: Keeping, batches: EpochBatches, *, num_workers: int, **options: Any
    ) -> None:
        """Load batches of a dataset; ``options`` are those of `DataLoader`."""
        options.setdefault("collate_fn", collate)
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
            yield from super().__iter__()
        except (ConnectionError, EOFError) as error:
            raise RuntimeError(
                f"a DataLoader worker died ({type(error).__name__}: {error}): it was killed, "
                "perhaps for want of memory. Load the last state, and use fewer workers or open "
                "scenes."
            ) from error

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


def split_options(options: Mapping[str, Any]) -> tuple[EpochOptions, dict[str, Any]]:
    """Return the options that order an epoch, and the others."""
    names = EpochOptions.__annotations__
    ordering = {name: value for name, value in options.items() if name in names}
    others = {name: value for name, value in options.items() if name not in names}
    return EpochOptions(**ordering), others  # type: ignore[typeddict-item]  # keys are its own
