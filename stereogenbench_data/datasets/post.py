"""How a stream's batches come through torch's own `DataLoader`: as parcels that open themselves.

The `DataLoader` knows nothing of slots. So a worker makes its own when it begins, and its parcels
are unpickled in the main process as the batches that they stand for.
"""

import itertools
import multiprocessing
import os
from collections.abc import Sequence
from typing import Any, Final, NamedTuple
from weakref import WeakValueDictionary

import torch
from torch.utils.data import get_worker_info

from stereogenbench_data.datasets.parcels import Parcel, Shelf
from stereogenbench_data.datasets.room import BatchRoom, Memory
from stereogenbench_data.datasets.tensors import collate
from stereogenbench_data.samples.load import Sample

Number = tuple[int, int]
Worker = tuple[int, bytes]
"""The number of a process, and a word of its own, for numbers of processes are used again."""

_count: Final = itertools.count()
_posts: Final[WeakValueDictionary[Number, "Post"]] = WeakValueDictionary()
"""The posts of this process, by the numbers that their copies in workers have too."""


class Post:
    """What a stream and its copies in worker processes send batches by."""

    def __init__(self, number: Number | None = None) -> None:
        """Begin with no worker, as the copy of one in another process if a number is given."""
        self._number = number or (os.getpid(), next(_count))
        _posts[self._number] = self
        self._own: tuple[Worker, Shelf] | None = None
        self._of_workers: dict[Worker, Shelf] = {}

    def room(self, count: int) -> BatchRoom | None:
        """Return room for a worker's next batch, None where `collated` does not make batches."""
        return None if self._own is None else self._own[1].room(count, Memory())

    def collated(self, samples: Sequence[Sample]) -> Any:
        """Return a batch; in a worker, what is unpickled as one, if it lies in a slot."""
        info = get_worker_info()
        if info is None:
            return collate(samples)
        if self._own is None:
            self._own = (os.getpid(), os.urandom(8)), Shelf(info.num_workers)
        worker, shelf = self._own
        packed = shelf.packed(samples)
        if not isinstance(packed, Parcel):
            return packed
        used = None if packed.memory is None else shelf.used
        return _Posted(self._number, worker, used, packed)

    def opened(self, worker: Worker, used: torch.Tensor | None, parcel: Parcel) -> dict[str, Any]:
        """Return the batch of a parcel, in the process that started the worker."""
        if worker not in self._of_workers:
            running = {process.pid for process in multiprocessing.active_children()}
            for ended in [known for known in self._of_workers if known[0] not in running]:
                del self._of_workers[ended]
            self._of_workers[worker] = Shelf(0, used=used)
        return self._of_workers[worker].opened(parcel)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what another process makes a copy from; in this one it is a post by itself."""
        return _copied, (self._number,)


def _copied(number: Number) -> Post:
    return Post() if number in _posts else Post(number)


class _Posted(NamedTuple):
    """A parcel on its way, with what `used` of its slots is where that may not be known yet."""

    number: Number
    worker: Worker
    used: torch.Tensor | None
    parcel: Parcel

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what the batch is made from where it arrives."""
        return _opened, tuple(self)


def _opened(
    number: Number, worker: Worker, used: torch.Tensor | None, parcel: Parcel
) -> dict[str, Any]:
    return _posts[number].opened(worker, used, parcel)
