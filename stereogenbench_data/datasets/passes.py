"""Passes over the batches of an epoch: the one place where a position stands.

A position is an epoch and how many of its batches are consumed, counted over all ranks. Each pass
counts what was taken of it. `Passes` says where the next one begins and which one a state is of.
"""

from typing import Any, Final, Literal

from torch.utils.data import get_worker_info

from stereogenbench_data.datasets.shared_epoch import SharedEpoch, SharedNumbers, require_epoch

Position = tuple[int, int]
"""An epoch, and how many of its global batches are consumed."""

_MOST_WORKERS: Final = 4096
"""Workers with a number of their own in `StreamPasses`."""


class Pass:
    """One pass over batches of an epoch, and how many were taken.

    Attributes:
        epoch: The epoch.
        start: The global batch at which all ranks began.
        share: The global numbers of its batches.
        taken: How many of them were taken.
        part: How many samples of the next one were taken, where samples are taken one by one.
        is_read_ahead: Whether "taken" counts what was given out to another `DataLoader`, whose
            workers read ahead of its loop.
    """

    is_read_ahead = False

    def __init__(self, epoch: int, share: range, *, start: int, end: int, world_size: int) -> None:
        """Begin before the first batch.

        Args:
            epoch: The epoch.
            share: The global numbers of its batches.
            start: The global batch at which all ranks begin.
            end: The global batch at which the epoch ends.
            world_size: How many ranks take turns.
        """
        self.epoch = epoch
        self.start = start
        self.share = share
        self.taken = self.part = 0
        self._end, self._world_size = end, world_size
        self._is_exhausted = False

    @property
    def is_complete(self) -> bool:
        """Whether all of its batches were taken."""
        return self.taken >= len(self.share)

    def exhaust(self) -> None:
        """Record that its loop is over: the epoch is, for ranks with fewer batches, too."""
        self._is_exhausted = True

    @property
    def position(self) -> Position:
        """The position after the batch taken last."""
        if self._is_exhausted:
            return self.epoch, self._end
        return self.epoch, min(self.start + self.taken * self._world_size, self._end)


class Passes:
    """The passes over a rank's batches, one after another, or one within another.

    A pass ends with its last batch, or when its loop is left. The next one is then of the next
    epoch (a loader's), or of the same until another is set (a sampler's, as torch's samplers do).
    A pass that begins while another runs is of the same epoch.

    Attributes:
        latest: The pass whose position counts: of those that run the one begun last, or else the
            one that ended last; None where none has begun since the position was set.
    """

    latest: Pass | None

    def __init__(self, epoch: SharedEpoch, *, then: Literal["same epoch", "next epoch"]) -> None:
        """Begin with the epoch of a dataset.

        Args:
            epoch: The dataset's. A sampler sets it, too. A loader follows it until an epoch of its
                own is set.
            then: Which epoch follows a pass.
        """
        self._dataset_epoch = epoch
        self._then = then
        self._follows = True
        self.go_to(epoch.value, 0)

    def go_to(self, epoch: int, start: int) -> None:
        """Let the next pass begin at a global batch of an epoch; passes that run count no more."""
        self._next: Position = (epoch, start)
        self._times_set = self._dataset_epoch.times_set
        self._running: list[Pass] = []
        self.latest = None

    def set(self, epoch: int, start: int = 0) -> None:
        """Go to a position at the user's request.

        Raises:
            SelectionError: If the epoch is not a whole number from 0.
        """
        epoch = require_epoch(epoch)
        if self._then == "same epoch":
            self._dataset_epoch.set(epoch)
        else:
            self._follows = False
        self.go_to(epoch, start)

    def set_epoch(self, epoch: int) -> None:
        """Go to the beginning of an epoch; where a state was loaded, stay in its epoch.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        is_there = self.latest is None and self.next_position[0] == epoch
        self.set(epoch, self.next_position[1] if is_there else 0)

    @property
    def next_position(self) -> Position:
        """Where the next pass begins."""
        return (self._dataset_epoch.value, 0) if self._is_behind else self._next

    @property
    def position(self) -> Position:
        """The position that a state holds."""
        is_of_pass = self.latest is not None and not self._is_behind
        return self.latest.position if self.latest and is_of_pass else self.next_position

    @property
    def _is_behind(self) -> bool:
        """Whether the dataset was set an epoch that these passes have not followed."""
        return self._follows and self._times_set != self._dataset_epoch.times_set

    def begin(self, begun: Pass) -> None:
        """Record that a pass begins."""
        if self._is_behind:
            self.go_to(begun.epoch, 0)
        self._next = begun.epoch, 0
        self._running.append(begun)
        self.latest = begun

    def end(self, ended: Pass) -> None:
        """Record that a pass is over, whole or not."""
        if ended not in self._running:
            return
        self._running.remove(ended)
        if self._running:
            self.latest = self._running[-1]
        elif self._then == "next epoch":
            self._next = ended.epoch + 1, 0

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: none of these passes is its own."""
        return self.__dict__ | {"_running": [], "latest": None}


class StreamPasses(Passes):
    """The passes of a stream. Worker processes begin them, so all processes see where."""

    def __init__(self, epoch: SharedEpoch) -> None:
        """Begin with the epoch of a dataset; a stream sets it, too."""
        self._set_to = SharedNumbers([epoch.value, 0])
        self._begun = SharedNumbers([0] * _MOST_WORKERS)
        super().__init__(epoch, then="same epoch")

    def go_to(self, epoch: int, start: int) -> None:
        """Let the next pass of each worker begin at a global batch of an epoch."""
        self.latest = None
        self._set_to[0], self._set_to[1] = epoch, start
        self._begun.tensor.zero_()

    @property
    def first_position(self) -> Position:
        """Where the first pass began since the position was set; workers may have begun it."""
        epoch = self._dataset_epoch.value
        return epoch, self._set_to[1] if self._set_to[0] == epoch else 0

    @property
    def next_position(self) -> Position:
        """Where the next pass of this process begins."""
        return (self._dataset_epoch.value, 0) if self._times_begun else self.first_position

    @property
    def position(self) -> Position:
        """The position after what this process has taken."""
        epoch = self._dataset_epoch.value
        is_of_pass = self.latest is not None and self.latest.epoch == epoch
        return self.latest.position if self.latest and is_of_pass else self.next_position

    @property
    def are_begun_by_workers(self) -> bool:
        """Whether worker processes alone have begun passes since the position was set."""
        return self.latest is None and bool(self._begun.tensor.any())

    @property
    def is_second_of_unset_epoch(self) -> bool:
        """Whether the next pass would be the first one to repeat an epoch that nobody chose."""
        return self._times_begun == 1 and self._dataset_epoch.times_set == 0

    def begin(self, begun: Pass) -> None:
        """Record that a pass begins in this process."""
        self._begun[_worker_number()] += 1
        self.latest = begun

    @property
    def _times_begun(self) -> int:
        return self._begun[_worker_number()]


def _worker_number() -> int:
    info = get_worker_info()
    return 0 if info is None else info.id % _MOST_WORKERS
