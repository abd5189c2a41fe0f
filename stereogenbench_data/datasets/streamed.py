"""An iterable dataset with the order of the map-style ones, for trainers that want one."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from torch.utils.data import IterableDataset, get_worker_info

from stereogenbench_data.datasets.batch_buffers import BatchArrays, Buffers
from stereogenbench_data.datasets.batches import (
    EpochBatch,
    EpochBatches,
    EpochOptions,
    State,
    require_count,
)
from stereogenbench_data.datasets.loader import split_options
from stereogenbench_data.datasets.mapped import Check, Data, StereoPairs
from stereogenbench_data.datasets.shared_epoch import RepeatedEpochWarning, SharedNumbers
from stereogenbench_data.errors import StateError
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.request import Transform
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import Selection
from stereogenbench_data.sources.cache import ShardCache

MOST_WORKERS = 4096


class StreamOptions(Selection, EpochOptions, total=False):
    """What `StereoPairs` takes, and `EpochOptions`; ``seed`` is the seed of both."""

    fields: Iterable[str]
    size: tuple[int, int] | str | None
    transform: Transform | None
    depth: DepthEncoding | None
    conventions: str | Path | Conventions | None
    cache: ShardCache | None
    check: Check
    buffers: Buffers
    fetch_ahead_bytes: int


class StereoPairStream(IterableDataset[Sample]):
    """The samples of `StereoPairs` one after another, in the order of its batches.

    ``DataLoader(stream, batch_size=B, num_workers=W, collate_fn=stream.collate)``, with the batch
    size of the stream, gives the batches that ``StereoPairs(...).loader(B, num_workers=W)`` gives:
    each rank and worker yields its own, without duplicates or holes, also where there are more
    workers than scenes. torch's own ``collate_fn`` gives the same, and copies more. With
    ``tail="wrap"`` a sample has the field ``is_padding``, a bool. A stream holds one position: make
    one for each `DataLoader` that is used side by side with others.

    >>> from stereogenbench_data import StereoPairStream
    >>> stream = StereoPairStream(getfixture("small_release"), 2, tail="uneven")
    >>> len(stream), len({sample["scene"] for sample in stream})
    (4, 4)
    """

    def __init__(self, data: Data, batch_size: int, **options: Unpack[StreamOptions]) -> None:
        """Select the samples; no video is opened before the first sample is read.

        Args:
            data: As for `StereoPairs`.
            batch_size: Samples in a batch of one rank; give `DataLoader` the same.
            **options: What `StereoPairs` takes; and `EpochOptions` (rank, world_size, tail,
                shuffle_groups, open_scenes, order).

        Raises:
            SelectionError: If nothing matches, or an option is out of its range.
            FieldError: If a field does not exist, or a size is not one.
            StorageError: If the data are not there, or hold more than a few broken scenes.
            MediaError: If depth that a field needs cannot have been stored whole.
        """
        require_options(StereoPairStream, options)
        ordering, others = split_options(options)
        if "seed" in ordering:
            others["seed"] = ordering["seed"]
        self.pairs = StereoPairs(data, **others)
        self.batches = EpochBatches(self.pairs, batch_size, **ordering)
        # The position loaded last, and how many passes each worker has begun since: workers may be
        # new copies in every epoch.
        self._loaded = SharedNumbers([0, 0])
        self._begun = SharedNumbers([0] * MOST_WORKERS)
        self._was_told = SharedNumbers([0])
        self._latest: SamplePass | None = None

    def collate(self, samples: Sequence[Sample]) -> Any:
        """Make a batch of samples: `DataLoader`'s ``collate_fn``, where speed matters.

        Worker processes then write samples where their batch will be, in shared memory that is
        used again once the loop drops the batch. Do not keep samples in a worker. Any other
        ``collate_fn`` works too, and costs the copies that torch makes.

        Raises:
            FieldError: If a field has another shape in one sample than in the first.
        """
        return self.pairs.buffers.collate(samples)

    @property
    def epoch(self) -> int:
        """The current epoch, from 0."""
        return self.pairs.epoch

    def set_epoch(self, epoch: int) -> None:
        """Go to another epoch, in this process and in running workers. Call it before each epoch.

        Raises:
            SelectionError: If it is negative.
        """
        self.pairs.set_epoch(epoch)
        self._was_told[0] = 1

    def __len__(self) -> int:
        """Return how many samples this rank has in a whole epoch."""
        batches = self.batches
        share, size = batches.share(0), batches.rule.batch_size
        short = len(self.pairs) % size
        has_short = batches.tail == "uneven" and short > 0 and len(self.pairs) // size in share
        return len(share) * size - (size - short if has_short else 0)

    def __repr__(self) -> str:
        """Return a summary."""
        return f"<{type(self).__name__}: epoch {self.epoch} of {self.pairs!r}, {self.batches!r}>"

    def __iter__(self) -> "SamplePass":
        """Return this rank's and this worker's samples of the current epoch.

        Raises:
            SelectionError: If Accelerate would share these samples among ranks a second time.
        """
        self.batches.require_shared_once(self)
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        epoch, place = self.epoch, worker % MOST_WORKERS
        start = self._loaded[1] if self._loaded[0] == epoch and not self._begun[place] else 0
        if self._begun[place] == 1 and worker == 0 and not self._was_told[0]:
            warnings.warn(
                f"{self!r} begins epoch {epoch} a second time: with the same order, random frames "
                "and transforms. Call set_epoch(epoch) of the stream before each pass.",
                RepeatedEpochWarning,
                stacklevel=2,
            )
        self._begun[place] += 1
        self.pairs.keep_open(self.batches, processes=self.batches.world_size * workers)
        self._latest = SamplePass(self, epoch=epoch, start=start, worker=worker, workers=workers)
        return self._latest

    def state_dict(self, *, batches: int | None = None) -> State:
        """Return a position that any number of ranks and workers can load.

        Args:
            batches: How many batches of this rank the training loop has taken in this epoch, since
                it began or since a state was loaded; what this process has itself iterated if
                None, which tells nothing where worker processes iterate.

        Raises:
            StateError: If the number is needed and not given.
        """
        if self._latest is not None and batches is None:
            return self._latest.state_dict()
        if batches is None:
            if self._begun.tensor.any():
                raise StateError(
                    "worker processes iterate this stream and read ahead: pass the number of "
                    "batches the loop has taken, state_dict(batches=...), or use the loader of "
                    "StereoPairs or torchdata's StatefulDataLoader, which count them."
                )
            batches = 0
        epoch = self.epoch
        taken = self.batches.pass_from(epoch, self._loaded[1] if self._loaded[0] == epoch else 0)
        taken.taken = batches
        return self.batches.state_at(*taken.position)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to a saved position: the next pass begins there, all later ones at the beginning.

        Raises:
            StateError: If it belongs to other samples or another order, naming what differs.
        """
        epoch, start = self.batches.position_in(state)
        self.set_epoch(epoch)
        if get_worker_info() is not None:
            # torchdata's: it gives the position of each worker to its pass.
            return
        self._loaded[0], self._loaded[1] = epoch, start
        self._begun.tensor.zero_()
        self._latest = None

    def close(self) -> None:
        """Close the videos that this process holds open; the stream can be used again."""
        self.pairs.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs."""
        self.batches.require_shared_once(self)
        return self.__dict__ | {"_latest": None}


class SamplePass(Iterator[Sample]):
    """One pass of one worker over its samples."""

    def __init__(
        self, stream: StereoPairStream, *, epoch: int, start: int, worker: int, workers: int
    ) -> None:
        """Begin an epoch at a global batch."""
        self._stream = stream
        self._place = {"worker": worker, "workers": workers}
        self._go_to(epoch, start, given=0)

    def __next__(self) -> Sample:
        """Return the next sample."""
        if self._at == len(self._batch):
            self._next_batch()
        sample = self._stream.pairs.load_into(
            self._arrays, self._at, self._batch[self._at], batch=self._batch
        )
        self._at += 1
        self._given += 1
        return sample

    def state_dict(self) -> State:
        """Return the position: for all ranks, and for this worker in its own samples."""
        batches = self._stream.batches
        whole = batches.pass_from(self._epoch, self._start)
        whole.taken, part = divmod(self._given, batches.batch_size)
        if part > 0 and self._at == len(self._batch):
            whole.taken += 1  # the epoch's last batch is short
        return {
            **batches.state_at(*whole.position),
            "start": self._start,
            "samples_given": self._given,
            **self._own_place,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to the position of the same worker of as many.

        Raises:
            StateError: If it belongs to other samples, another order, or another worker.
        """
        batches = self._stream.batches
        epoch, _ = batches.position_in(state)
        differing = [
            f"{name} is {value} here and {state.get(name)} there"
            for name, value in self._own_place.items()
            if state.get(name) != value
        ]
        if differing:
            raise StateError(
                f"the position is that of another worker: {'; '.join(differing)}. Load it under "
                "the same ranks and workers; the state of a stream itself goes with any."
            )
        start = require_count(state, "start", most=batches.batches_of_all)
        share = len(self._share(start))
        given = require_count(state, "samples_given", most=share * batches.batch_size)
        self._stream.set_epoch(epoch)
        self._go_to(epoch, start, given=given)

    @property
    def _own_place(self) -> dict[str, int]:
        batches = self._stream.batches
        return {"rank": batches.rank, "world_size": batches.world_size, **self._place}

    def _share(self, start: int) -> range:
        """Return the global numbers of this worker's batches from a global batch on."""
        share: range = self._stream.batches.share(start)
        return share[self._place["worker"] :: self._place["workers"]]

    def _go_to(self, epoch: int, start: int, *, given: int) -> None:
        self._epoch, self._start, self._given = epoch, start, given
        whole, part = divmod(given, self._stream.batches.batch_size)
        self._left = iter(self._share(start)[whole:])
        self._batch, self._at = EpochBatch((), epoch=epoch), 0
        self._arrays: BatchArrays | None = None
        if part > 0:
            self._next_batch()
            self._at = part

    def _next_batch(self) -> None:
        self._batch = self._stream.batches.batch(next(self._left), epoch=self._epoch)
        self._at = 0
        buffers = self._stream.pairs.buffers
        self._arrays = buffers.allocate(len(self._batch)) if buffers.makes_batches else None
        self._stream.pairs.expect(self._batch)
