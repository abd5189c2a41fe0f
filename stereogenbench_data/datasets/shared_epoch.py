"""Memory that worker processes share with the process that starts them.

Forked workers see the rows of an index anyway. Workers that are spawned get them as shared memory,
which is freed when the last of them ends.
"""

import warnings
from collections.abc import Sequence
from multiprocessing.reduction import ForkingPickler
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
import pyarrow as pa
import torch

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex

_rows: Final[WeakKeyDictionary[SceneIndex, torch.Tensor]] = WeakKeyDictionary()
"""The rows of each index that was sent to other processes, laid out once."""


class RepeatedEpochWarning(UserWarning):
    """A second pass draws the same random frames and transforms, or has the same order."""


class SharedNumbers:
    """Whole numbers of which running workers see every change.

    Workers get the same numbers, however they are started. Any other copy, by `copy` or by pickle,
    has numbers of its own, which its own workers share.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        """Begin with these numbers."""
        self.tensor = torch.tensor(numbers, dtype=torch.int64)
        self.tensor.share_memory_()

    def __getitem__(self, place: int) -> int:
        """Return a number."""
        return int(self.tensor[place])

    def __setitem__(self, place: int, number: int) -> None:
        """Change a number for all processes."""
        self.tensor[place] = number

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what a copy is made from: numbers of its own."""
        return SharedNumbers, (self.tensor.tolist(),)


def _over(tensor: torch.Tensor) -> SharedNumbers:
    """Return the numbers that lie in shared memory."""
    numbers = SharedNumbers.__new__(SharedNumbers)
    numbers.tensor = tensor
    return numbers


# Of processes of this machine alone, such as workers that are spawned.
ForkingPickler.register(SharedNumbers, lambda numbers: (_over, (numbers.tensor,)))


class SharedEpoch:
    """The epoch that a dataset draws random frames and transforms for, as all its workers see it.

    A copy has an epoch of its own.
    """

    def __init__(self, epoch: int = 0) -> None:
        """Begin at an epoch."""
        self._numbers = SharedNumbers([epoch, 0])

    @property
    def value(self) -> int:
        """The epoch, from 0."""
        return self._numbers[0]

    @property
    def times_set(self) -> int:
        """How often it was set."""
        return self._numbers[1]

    def set(self, epoch: int) -> None:
        """Go to an epoch.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        self._numbers[0] = require_epoch(epoch)
        self._numbers[1] += 1


def require_epoch(epoch: int) -> int:
    """Return the number of an epoch.

    Raises:
        SelectionError: If it is not a whole number from 0.
    """
    if not isinstance(epoch, int | np.integer) or not 0 <= epoch < 2**63:
        raise SelectionError(f"an epoch is a whole number from 0, got {epoch!r}.")
    return int(epoch)


class DrawnSamples:
    """Whether the random samples of an epoch are drawn a second time, by torch's own `DataLoader`.

    Its passes are of the same epoch until ``set_epoch`` is called, so each would draw the same
    random frames and transforms. The first sample that any process draws in an epoch is watched;
    the process that draws it again warns, once.
    """

    def __init__(self) -> None:
        """Begin with none: an epoch, the sample that is watched, and whether it was told."""
        self._watched = SharedNumbers([-1, -1, 0])

    def mark(self, numbers: Sequence[int], *, epoch: tuple[int, int], dataset: object) -> None:
        """Take samples as drawn, and warn if the watched one is drawn again.

        Args:
            numbers: The samples.
            epoch: Their epoch, and how often it was set.
            dataset: What draws them, for the warning.
        """
        watched, marked = self._watched, hash(epoch)
        if watched[0] != marked and numbers:
            watched[1], watched[0] = numbers[0], marked
        elif watched[1] in numbers and not watched[2]:
            watched[2] = 1
            warnings.warn(
                f"{dataset!r} is read by torch's own DataLoader, and samples of epoch {epoch[0]} "
                "come a second time, with the same random frames and transforms. Call "
                "set_epoch(epoch) before each pass, or use StereoPairs(...).loader(...), whose "
                "every pass is of the next epoch.",
                RepeatedEpochWarning,
                stacklevel=3,
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
