"""Memory that worker processes share with the process that starts them.

Forked workers see the rows of an index anyway. Workers that are spawned get them as shared memory,
which is freed when the last of them ends.
"""

import os
from multiprocessing.reduction import ForkingPickler
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
import pyarrow as pa
import torch
from torch.utils.data import get_worker_info

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex

_FOLLOWS: Final = -1
"""Stands for the epoch that is followed."""

_COUNTED: Final = 255
"""Workers with a place of their own in `FetchedCounts`."""

_rows: Final[WeakKeyDictionary[SceneIndex, torch.Tensor]] = WeakKeyDictionary()
"""The rows of each index that was sent to other processes, laid out once."""


def shared_full(size: tuple[int, ...], value: int) -> torch.Tensor:
    """Return an int64 tensor of which workers see every change."""
    numbers = torch.full(size, value, dtype=torch.int64)
    numbers.share_memory_()
    return numbers


class SharedEpoch:
    """The current epoch of a dataset, in memory that all its workers see.

    Datasets, batches, loaders and streams read it. A loader's epoch follows that of its dataset
    until it is set itself.
    """

    def __init__(self, followed: "SharedEpoch | None" = None) -> None:
        """Begin at epoch 0, or follow another one."""
        # The epoch, and how often it was set.
        self._own = shared_full((2,), 0 if followed is None else _FOLLOWS)
        self._own[1] = 0
        self._followed = self._own if followed is None else followed._own
        self._advanced_from: int | None = None

    @property
    def value(self) -> int:
        """The epoch, from 0."""
        own, followed = int(self._own[0]), int(self._followed[0])
        if own == _FOLLOWS or self._advanced_from not in (None, int(self._followed[1])):
            return followed
        return own

    @property
    def version(self) -> tuple[int, int]:
        """What differs after each `set`, whatever epoch it sets."""
        return int(self._own[1]), int(self._followed[1])

    def set(self, epoch: int) -> None:
        """Go to an epoch at the user's request.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        if not isinstance(epoch, int | np.integer) or not 0 <= epoch < 2**63:
            raise SelectionError(f"an epoch is a whole number from 0, got {epoch!r}.")
        self._own[0] = int(epoch)
        self._own[1] += 1
        self._advanced_from = None

    def advance(self, epoch: int) -> None:
        """Go to an epoch because a pass is over: until `set` is called, here or on the followed."""
        self._own[0] = epoch
        self._advanced_from = int(self._followed[1])


class FetchedCounts:
    """How many requests the processes of a loader made, and how many bytes they fetched."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._of_worker = shared_full((_COUNTED + 1, 2), 0)
        self._before: tuple[int, torch.Tensor] | None = None

    def publish(self, fetched: tuple[int, int]) -> None:
        """Take what this process has fetched since it began."""
        if fetched == (0, 0):
            return
        info = get_worker_info()
        row = 0 if info is None else 1 + info.id % _COUNTED
        if self._before is None or self._before[0] != os.getpid():
            self._before = os.getpid(), self._of_worker[row].clone()
        self._of_worker[row] = self._before[1] + torch.tensor(fetched)

    @property
    def total(self) -> tuple[int, int]:
        """Requests and bytes of all processes, after the last batch that each has made."""
        requests, count = self._of_worker.sum(dim=0).tolist()
        return requests, count


def _parted(index: SceneIndex) -> tuple[Any, ...]:
    table, rest = index.parted()
    if index not in _rows:
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
        _rows[index] = torch.frombuffer(bytearray(sink.getvalue()), dtype=torch.uint8)
        _rows[index].share_memory_()
    return _joined, (_rows[index], rest)


def _joined(rows: torch.Tensor, rest: dict[str, Any]) -> SceneIndex:
    with pa.ipc.open_stream(pa.py_buffer(rows.numpy())) as stream:
        return SceneIndex.of_parts(stream.read_all(), rest)


# For processes of this machine alone: a plain pickle of an index holds its rows.
ForkingPickler.register(SceneIndex, _parted)
