"""What running workers see of the process that trains: its epoch; if spawned, an index's rows."""

import multiprocessing
import os
import warnings
from collections.abc import Sequence
from multiprocessing.context import get_spawning_popen
from multiprocessing.reduction import ForkingPickler
from multiprocessing.sharedctypes import RawArray
from typing import Any, Final
from weakref import WeakKeyDictionary

import pyarrow as pa
import torch
from torch.utils.data import get_worker_info

from stereogenbench_data.errors import users_level
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import require_whole
from stereogenbench_data.selection.order import OrderRule

_rows: Final[WeakKeyDictionary[SceneIndex, torch.Tensor]] = WeakKeyDictionary()
"""The rows of each index that was sent to other processes, laid out once."""


class RepeatedEpochWarning(UserWarning):
    """A second pass draws the same random frames and transforms, or has the same order."""


class SharedNumbers:
    """Whole numbers of which running workers see every change.

    The workers of the process that made them have the same numbers, however they are started. Any
    other copy has numbers of its own, which its own workers share: by `copy`, by pickle, or in a
    process that was forked or spawned as another rank.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        """Begin with these numbers.

        The standard library keeps those of a process in few open files, though it may have
        thousands of datasets.
        """
        self._owner, self._shared = os.getpid(), RawArray("q", list(numbers))

    @property
    def here(self) -> Any:
        """The numbers as this process shares them: an array whose changes all its workers see."""
        if self._owner != os.getpid():
            parent = multiprocessing.parent_process()
            started_by = None if get_worker_info() is None or parent is None else parent.pid
            if started_by != self._owner:
                self._owner, self._shared = os.getpid(), RawArray("q", self._shared[:])
        return self._shared

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what a copy is made from: these numbers, in a process that is being started."""
        shared = self.here
        if get_spawning_popen() is None:
            return SharedNumbers, (shared[:],)
        return object.__new__, (SharedNumbers,), {"_owner": self._owner, "_shared": shared}


class SharedEpoch:
    """The epoch that a dataset draws random frames and transforms for, as all its workers see it.

    torch's own `DataLoader` makes passes of the same epoch until one is set, so each would draw the
    same random frames and transforms. The first sample that any process draws in an epoch is
    watched; the process that draws it again warns, once. A copy has an epoch of its own.
    """

    def __init__(self, epoch: int = 0) -> None:
        """Begin at an epoch that was never set, with no sample watched."""
        self._numbers = SharedNumbers([epoch, 0])
        self._watched = SharedNumbers([-1, -1, 0])  # epoch and sample, and whether it was told
        self._ended: tuple[OrderRule, int, int] | None = None
        self._ended_by, self._was_told = 0, False

    @property
    def value(self) -> int:
        """The epoch, from 0."""
        epoch: int = self._numbers.here[0]
        return epoch

    @property
    def times_set(self) -> int:
        """How often it was set."""
        times: int = self._numbers.here[1]
        return times

    def set(self, epoch: int) -> None:
        """Go to an epoch.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        self._numbers.here[0] = require_whole("epoch", epoch, least=0)
        self._numbers.here[1] += 1

    def mark_drawn(self, numbers: Sequence[int], *, epoch: int, dataset: object) -> None:
        """Take samples as drawn, and warn if the watched one is drawn again.

        Args:
            numbers: The samples.
            epoch: Their epoch.
            dataset: What draws them, for the warning.
        """
        watched, marked = self._watched.here, hash((epoch, self.times_set))
        if watched[0] != marked and numbers:
            watched[1], watched[0] = numbers[0], marked
        elif watched[1] in numbers and not watched[2]:
            watched[2] = 1
            warnings.warn(
                f"{dataset!r} is read by torch's own DataLoader, and samples of epoch {epoch} "
                "come a second time, in the same order or with the same random frames and "
                "transforms. If this is another pass, call set_epoch(epoch) before each, or use "
                "StereoPairs(...).loader(...), whose every pass is of the next epoch. A sampler "
                "that draws with replacement repeats samples within a pass, and that changes "
                "nothing.",
                RepeatedEpochWarning,
                stacklevel=users_level(),
            )

    def mark_ended(self, rule: OrderRule, *, loader: int) -> None:
        """Take a pass of the dataset's epoch as ended: its order, and the number of its loader."""
        self._ended, self._ended_by = (rule, self.value, self.times_set), loader

    def mark_begun(self, rule: OrderRule, *, loader: int) -> None:
        """Warn, once, where another loader has ended the same pass of the dataset's epoch."""
        is_again = self._ended == (rule, self.value, self.times_set)
        if is_again and self._ended_by != loader and not self._was_told:
            self._was_told = True
            warnings.warn(
                f"a new loader repeats epoch {self.value} of the loader before it: the same order, "
                "random frames and transforms. Make the loader once, before the loop over epochs: "
                "each of its passes is of the next epoch. Or call set_epoch(epoch) of the dataset, "
                "or of the new loader, before each pass.",
                RepeatedEpochWarning,
                stacklevel=users_level(),
            )


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
