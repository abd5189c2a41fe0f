"""An iterable dataset with the order of the map-style ones, for trainers that want one."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, Unpack

from torch.utils.data import IterableDataset, get_worker_info

from stereogenbench_data.datasets.batch_buffers import collate
from stereogenbench_data.datasets.batches import (
    EpochBatches,
    Pass,
    Position,
    State,
    require_count,
)
from stereogenbench_data.datasets.division import WorkerShare
from stereogenbench_data.datasets.epoch_rule import EPOCH_DEFAULTS, EpochOptions
from stereogenbench_data.datasets.mapped import PAIRS_DEFAULTS, Data, PairsOptions, StereoPairs
from stereogenbench_data.datasets.shared import SharedNumbers
from stereogenbench_data.errors import StateError
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.selection.options import require_options, split_options
from stereogenbench_data.selection.signatures import list_options

_MOST_WORKERS: Final = 4096
"""Workers for each of which a stream counts passes."""


class StreamOptions(PairsOptions, EpochOptions, total=False):
    """What `StereoPairs` takes, and `EpochOptions`; ``seed`` is the seed of both."""

    fields: Iterable[str]


class StereoPairStream(IterableDataset[Sample]):
    """The samples of `StereoPairs` one after another, in the order of its batches.

    ``DataLoader(stream, batch_size=B, num_workers=W, collate_fn=stream.collate)``, with the batch
    size of the stream, gives the batches that ``StereoPairs(...).loader(B, num_workers=W)`` gives:
    each rank and worker yields its own, without duplicates or holes, also where there are more
    workers than scenes. With ``drop_last="pad"`` a sample has the field ``is_padding``, a bool. A
    stream holds one position: make one for each `DataLoader` that is used side by side with others.

    >>> from stereogenbench_data import StereoPairStream
    >>> stream = StereoPairStream(getfixture("small_release"), 2, drop_last=False)
    >>> len(stream), len({sample["scene"] for sample in stream})
    (4, 4)
    """

    @list_options(PAIRS_DEFAULTS, EPOCH_DEFAULTS, {"seed": 0})
    def __init__(self, data: Data, batch_size: int, **options: Unpack[StreamOptions]) -> None:
        """Select the samples; no video is opened before the first sample is read.

        Args:
            data: As for `StereoPairs`.
            batch_size: Samples in a batch of one rank; give `DataLoader` the same.
            **options: What `StereoPairs` takes; and `EpochOptions` (rank, world_size, shuffle,
                drop_last, shuffle_groups, open_scenes).

        Raises:
            SelectionError: If nothing matches, or an option is out of its range.
            FieldError: If a field does not exist, or a size is not one.
            StorageError: If the data are not there, or hold more than a few broken scenes.
            MediaError: If depth that a field needs cannot have been stored whole.
        """
        require_options(StereoPairStream, options)
        ordering, others = split_options(options, EpochOptions)
        if "seed" in ordering:
            others["seed"] = ordering["seed"]
        self.pairs = StereoPairs(data, **others)
        self.batches = EpochBatches(self.pairs, batch_size, **ordering)
        self.pairs.is_watched |= self.batches.rule.shuffle
        # Worker processes begin passes, so all processes see the position that was set (an epoch,
        # a global batch), and how many passes each worker has begun since.
        self._set_to = SharedNumbers([self.epoch, 0])
        self._begun = SharedNumbers([0] * _MOST_WORKERS)
        self._latest: Pass | None = None
        # A pass that was loaded, and the process that may go on with it: no worker forked from it.
        self._resumed: tuple[Pass, int] | None = None

    def collate(self, samples: Sequence[Sample]) -> Any:
        """Make a batch of samples, as `collate` does: a ``collate_fn`` of `DataLoader`.

        Raises:
            FieldError: If a field has another shape in one sample than in the first.
        """
        return collate(samples)

    @property
    def epoch(self) -> int:
        """The current epoch, from 0."""
        return self.pairs.epoch

    def set_epoch(self, epoch: int) -> None:
        """Go to another epoch, in this process and in running workers. Call it before each epoch.

        Raises:
            SelectionError: If it is negative.
        """
        is_loaded = self.epoch == epoch and not self._has_begun
        self._go_to(epoch, self._first_position[1] if is_loaded else 0)

    def _go_to(self, epoch: int, start: int) -> None:
        """Let the next pass of each worker begin at a global batch of an epoch."""
        self.pairs.set_epoch(epoch)
        self._set_to.here[:] = [epoch, start]
        self._begun.here[:] = [0] * _MOST_WORKERS
        self._latest = None

    @property
    def _has_begun(self) -> bool:
        """Whether this process, or this worker, has begun a pass since the position was set."""
        begun: int = self._begun.here[self._share.worker % _MOST_WORKERS]
        return begun > 0

    @property
    def _first_position(self) -> Position:
        """Where the first pass begins, or has begun, since the position was set."""
        epoch, start = self._set_to.here
        return self.epoch, start if epoch == self.epoch else 0

    def __len__(self) -> int:
        """Return how many samples this rank has in a whole epoch."""
        share, size = self.batches.share(0), self.batches.batch_size
        if not share or self.batches.is_padded:
            return len(share) * size
        return len(share) * size - max(0, (share[-1] + 1) * size - len(self.pairs))

    def __repr__(self) -> str:
        """Return a summary."""
        return f"<{type(self).__name__}: epoch {self.epoch} of {self.pairs!r}, {self.batches!r}>"

    def __iter__(self) -> Iterator[Sample]:
        """Return this rank's and this worker's samples of the current epoch.

        Raises:
            SelectionError: If Accelerate would share these samples among ranks a second time.
        """
        self.batches.require_shared_once(self)
        share = self._share
        self.pairs.read_by(self.batches, share)
        begun, pid = self._resumed or (None, 0)
        self._resumed = None
        if begun is None or pid != os.getpid() or begun.epoch != self.epoch:
            epoch, start = self._first_position
            begun = self._pass_of_worker(epoch, 0 if self._has_begun else start)
        self._begun.here[share.worker % _MOST_WORKERS] += 1
        self._latest = begun
        return self._samples(begun)

    def _samples(self, begun: Pass) -> Iterator[Sample]:
        for number in begun.share[begun.taken :]:
            batch = self.batches.of_all_ranks.batch(number, epoch=begun.epoch)
            for sample in self.pairs.samples_of(batch, range(begun.part, len(batch))):
                begun.part += 1
                if begun.part == len(batch):
                    begun.taken, begun.part = begun.taken + 1, 0
                yield sample
        begun.is_exhausted = True

    def _pass_of_worker(self, epoch: int, start: int) -> Pass:
        """Return a pass over this worker's part of the rank's batches."""
        begun = self.batches.pass_from(epoch, start)
        begun.share = begun.share[self._share.worker :: self._share.workers]
        return begun

    @property
    def _share(self) -> WorkerShare:
        """Which part of the batches this process iterates."""
        return WorkerShare.of_this_process(self.batches.rank, self.batches.world_size)

    @property
    def _place(self) -> dict[str, int]:
        """The same in a state."""
        place: dict[str, Any] = self._share._asdict()
        return {name: place[name] for name in ("rank", "world_size", "worker", "workers")}

    def state_dict(self, *, batches: int | None = None) -> State:
        """Return a position that any number of ranks and workers can load.

        Args:
            batches: How many batches of this rank the training loop has taken in this epoch, since
                it began or since a state was loaded; what this process has itself iterated if
                None, which tells nothing where worker processes iterate.

        Raises:
            StateError: If the number is needed and not given.
        """
        latest = self._latest
        if batches is not None:
            taken = self.batches.pass_from(*self._first_position)
            taken.taken = batches
            return self.batches.state_at(*taken.position)
        if latest is not None and latest.epoch == self.epoch:
            given = latest.taken * self.batches.batch_size + latest.part
            own = {"start": latest.start, "samples_given": given, **self._place}
            return self.batches.state_at(*latest.position) | own
        if latest is None and get_worker_info() is None and any(self._begun.here):
            raise StateError(
                "worker processes iterate this stream and read ahead: pass the number of "
                "batches the loop has taken, state_dict(batches=...), or use the loader of "
                "StereoPairs or torchdata's StatefulDataLoader, which count them."
            )
        epoch, start = self._first_position
        return self.batches.state_at(epoch, 0 if self._has_begun else start)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to a saved position: the next pass begins there, all later ones at the beginning.

        In a worker process, as of torchdata's loader, it is the position of this worker.

        Raises:
            StateError: If it belongs to other samples or another order, naming what differs; or,
                in a worker, to another one.
        """
        epoch, start = self.batches.position_in(state)
        is_worker = get_worker_info() is not None
        differing = [
            f"{name} is {value} here and {state.get(name)} there"
            for name, value in self._place.items()
            if state.get(name) != value
        ]
        if differing and is_worker:
            raise StateError(
                f"the position is that of another worker: {'; '.join(differing)}. Load it under "
                "the same ranks and workers; the state of a stream itself goes with any."
            )
        resumed = None
        if not differing:
            first = require_count(state, "start", most=self.batches.batches_of_all)
            resumed, size = self._pass_of_worker(epoch, first), self.batches.batch_size
            given = require_count(state, "samples_given", most=len(resumed.share) * size)
            resumed.taken, resumed.part = divmod(given, size)
        if is_worker:
            self.pairs.set_epoch(epoch)
        else:
            self._go_to(epoch, start)
        self._resumed = None if resumed is None else (resumed, os.getpid())

    def close(self) -> None:
        """Close the videos that this process holds open; the stream can be used again."""
        self.pairs.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs."""
        self.batches.require_shared_once(self)
        return self.__dict__ | {"_latest": None, "_resumed": None}
