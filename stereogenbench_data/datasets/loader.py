"""A torch `DataLoader` over the batches of an epoch, which counts what its loop has taken.

The loader starts passes. A `LoaderPass` owns its position, its workers (`Workers`) and their
memory.

Accelerate and Lightning give each rank its share of a torch `DataLoader`. Our loaders have already
done that; dividing them again would silently lose samples. Lightning leaves loaders alone whose
sampler is torch's `DistributedSampler`, Accelerate those that say they are prepared. Batches and
streams that are divided twice all the same are refused (`EpochBatches`).
"""

import copy
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from inspect import signature
from time import perf_counter
from typing import Any, Final, NamedTuple, SupportsIndex

import torch
from torch.utils.data import DataLoader, DistributedSampler, SequentialSampler

from stereogenbench_data.datasets.batch_buffers import collate
from stereogenbench_data.datasets.batch_parts import Making
from stereogenbench_data.datasets.batches import EpochBatches, Pass, State
from stereogenbench_data.datasets.division import WorkerShare
from stereogenbench_data.datasets.epoch_rule import EPOCH_DEFAULTS, EpochOptions
from stereogenbench_data.datasets.workers import Workers, pids_for
from stereogenbench_data.errors import PassError, StateError, StereoGenBenchError
from stereogenbench_data.samples.load import Work


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


LOADER_DEFAULTS: Final = {
    name: each.default for name, each in signature(DataLoader.__init__).parameters.items()
} | EPOCH_DEFAULTS
"""Torch's own, and those of an epoch; without ``collate_fn`` batches are made in place."""


class LoaderStats(NamedTuple):
    """A loader's state in the calling process.

    Attributes:
        epoch: The current epoch.
        batches_taken: How many global batches of it the loop has taken, of all ranks.
        workers: How many worker processes run for it.
        videos_open: How many videos this process has open for it; each worker has its own.
        videos_limit: How many videos a process opens for it at most.
        waiting: The share of the time that the loop has waited for batches, from the beginning of
            the latest pass to its latest batch; starting the workers counts.
        packets_decoded: How many packets were given to decoders, by all workers, in all passes.
        frames_used: How many frames of videos the samples showed, each camera's frame once. One
            packet a frame is the least; a scene that is begun inside takes more.
        time: Where the time of those who load went, and which is the limit, in one line.
    """

    epoch: int
    batches_taken: int
    workers: int
    videos_open: int
    videos_limit: int
    waiting: float
    packets_decoded: int
    frames_used: int
    time: str


class ShareSampler(DistributedSampler[Any]):
    """The samples of one rank, as a sampler that tells frameworks that they are divided already."""

    def __init__(self, batches: EpochBatches) -> None:
        """Stand for the samples of these batches."""
        # torch asks a sampler's dataset for its length alone.
        samples: Any = range(batches.samples_of_epoch)
        super().__init__(samples, num_replicas=batches.world_size, rank=batches.rank)
        self.batches = batches

    def __iter__(self) -> Iterator[int]:
        """Yield the numbers of the samples of this rank's batches."""
        for batch in self.batches:
            yield from batch

    def __len__(self) -> int:
        """The number of samples in this rank's full batches."""
        return len(self.batches) * self.batches.batch_size

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the batches: Lightning does before each epoch."""
        self.batches.set_epoch(epoch)


class OrderedShareSampler(ShareSampler, SequentialSampler):
    """The samples of one rank in order: Lightning's ``overfit_batches`` leaves them as they are."""


class PairsLoader(DataLoader[Any]):
    """The batches of an epoch, loaded: what ``loader(...)`` of a dataset returns.

    It is a torch `DataLoader`. `state_dict` counts the batches that the loop has taken, not those
    that workers have read ahead, so that it can be saved after any batch and loaded under other
    numbers of ranks and workers.

    Each pass is of the next epoch, unless an epoch was set since: after a whole pass, and after one
    whose loop was left. So training loops need not call `set_epoch`, and a loop that stops after
    some steps sees other samples in each epoch. Only `load_state_dict` goes on inside an epoch. To
    repeat a pass, as for validation on random frames, call ``set_epoch(0)`` before it.

    A pass owns its workers and their memory, so several passes over one loader can run at a time;
    one that begins while another runs is of the same epoch. Workers that persist serve one pass at
    a time: a new pass ends the previous one, which then raises `PassError`. If a worker dies, the
    loop ends with `WorkerError`, or with torch's own `RuntimeError` if it dies while the body of
    the loop runs: catch `RuntimeError`, the base of `WorkerError`. Threads that share a pass take
    turns.

    Its epoch follows that of its dataset until the first `set_epoch` or `load_state_dict`. Its open
    videos are its own. So a loader to train and a loader to validate may share a dataset.

    ``accelerator.prepare(loader)`` of Accelerate returns the loader itself, as it shares batches
    among ranks already; from then on batches come on the accelerator's device, and
    ``save_state`` and ``load_state`` keep its position.

    Attributes:
        batches: The samples of its batches, in their order.
        use_stateful_dataloader: That Accelerate's ``save_state`` keeps the loader's ``state_dict``.
        end_of_dataloader: Whether the batch given last is the last of its pass.
        remainder: How many samples of all ranks' last batches are not padding; 0 where none is
            padding. Accelerate reads these.
    """

    dataset: Any
    batches: EpochBatches
    use_stateful_dataloader: Final = True
    end_of_dataloader = False
    remainder = 0
    _device: torch.device | None = None
    _gradient_state: Any = None

    def __init__(
        self,
        dataset: Any,
        batches: EpochBatches,
        *,
        num_workers: int = 0,
        batch_sampler: Any = None,
        **options: Any,
    ) -> None:
        """Load batches of a dataset.

        Args:
            dataset: The samples: `StereoPairs` or `SceneViews`, whose module imports this one.
            batches: Their batches.
            num_workers: How many processes load; 0 loads in this one.
            batch_sampler: What gives the batches on their way to the workers, such as what
                Lightning puts around them to learn what it predicts; ``batches`` itself if None.
            **options: Those of `DataLoader`.
        """
        if options.get("collate_fn") is None:
            options["collate_fn"] = collate
        super().__init__(
            dataset,
            batch_sampler=batch_sampler or batches,
            num_workers=num_workers,
            **options,
        )
        self.batches = batches
        self._begun_passes = 0
        self._pass_began_s = self._passed_s = self._waited_s = 0.0
        self._persistent: Workers | None = None
        self.making = Making(self.collate_fn, dataset.buffers)
        self._set_sampler()
        dataset.read_by(batches, self.share)

    @property
    def share(self) -> WorkerShare:
        """How the batches of this rank are divided among the workers."""
        batches, workers = self.batches, self.num_workers
        is_by_streams = workers == 0 or batches.rule.shuffle or self._holds_runs
        return WorkerShare(
            batches.rank,
            batches.world_size,
            worker=0,
            workers=max(1, workers),
            of="streams" if is_by_streams else "batches",
        )

    @property
    def _holds_runs(self) -> bool:
        """Whether an eighth of a run for each worker is on its way, where nothing is shuffled.

        Measured with 2 workers at 1280x1280, with depth: from a sixth of a run on, whole runs take
        0.7 to 0.9 of the time of batches in turn, and 0.6 of the processor's. With far less than
        that nearly all workers would wait for the one whose run is due.
        """
        lengths = self.batches.dataset.plan.runs.lengths
        ahead = (self.prefetch_factor or 0) * self.batches.batch_size * self.batches.world_size
        return bool(8 * ahead >= lengths.mean())

    def _set_sampler(self) -> None:
        # Past torch's guard against another sampler: it says that the batches are a rank's share.
        kind = ShareSampler if self.batches.rule.shuffle else OrderedShareSampler
        object.__setattr__(self, "sampler", kind(self.batches))

    @property
    def epoch(self) -> int:
        """The current epoch, from 0: until the next pass begins, that of the last one."""
        return self.batches.passes.position[0]

    def set_epoch(self, epoch: int) -> None:
        """Go to an epoch: another order, other random frames and transforms.

        Without it each pass is followed by one of the next epoch. With the epoch of a state just
        loaded it changes nothing, so that a training loop may begin as
        ``for epoch in range(loader.epoch, epochs)``.

        Raises:
            SelectionError: If it is negative.
        """
        self.batches.set_epoch(epoch)

    def __iter__(self) -> "LoaderPass":  # type: ignore[override]  # torch names a private class
        """Return a pass over the next epoch, or over what a loaded state left of its own.

        The pass begins with its first batch, because trainers set the epoch in between.
        """
        return LoaderPass(self)

    def state_dict(self) -> State:
        """Return the position after the last batch that the loop has taken.

        Raises:
            StateError: If the loop runs over another DataLoader, made of this one's parts.
        """
        latest = self.batches.passes.latest
        if latest is not None and latest.is_read_ahead and not latest.is_complete:
            raise StateError(
                "these batches are read by another DataLoader than the loader that is asked for "
                "its position, as after skip_first_batches of Accelerate, and nobody counts what "
                "its loop takes. Go on from a saved state with load_state_dict (Accelerate: "
                "load_state), without skip_first_batches."
            )
        return self.batches.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to a saved position. Nothing is replayed; later epochs are whole again.

        A position behind the last batch of an epoch is the beginning of the next one.

        Raises:
            StateError: If it belongs to other samples or another order, naming what differs.
        """
        rule = self.batches.rule
        epoch, start = self.batches.position_in(state)
        if self.batches.rule != rule:
            # Workers that persist expect the batches of another order.
            if self._persistent is not None:
                self._forget(self._persistent)
            self.dataset.read_by(self.batches, self.share)
        if start > 0 and start >= self.batches.end(start):
            epoch, start = epoch + 1, 0
        self.batches.passes.set(epoch, start)

    def stats(self) -> LoaderStats:
        """Return what the loader has and holds now: open videos, workers, batches."""
        pids = pids_for(self)
        work = self.work()
        videos = self.dataset.stats()
        epoch, taken = self.batches.passes.position
        return LoaderStats(
            epoch=epoch,
            batches_taken=taken,
            workers=len(pids),
            videos_open=videos.videos_open,
            videos_limit=videos.videos_limit,
            waiting=self._waited_s / self._passed_s if self._passed_s else 0.0,
            packets_decoded=work.packets_decoded,
            frames_used=work.frames_used,
            time=work.in_words(),
        )

    def work(self) -> Work:
        """Return what was done for this loader, by its workers or this process, in all passes."""
        self.making.work.add(self.dataset.take_work())
        return copy.copy(self.making.work)

    def __repr__(self) -> str:
        """Return a summary."""
        return (
            f"<{type(self).__name__}: epoch {self.epoch} of {self.dataset!r} by "
            f"{self.num_workers} workers, {self.batches!r}>"
        )

    @property
    def _is_accelerate_prepared(self) -> bool:
        """Whether Accelerate need not divide the batches; ``accelerator.prepare`` reads it.

        Raises:
            SelectionError: If the batches are shared out otherwise than Accelerate's processes are.
        """
        states = sys.modules.get("accelerate.state")
        if states is None:
            return False
        state = states.PartialState()
        self.batches.require_group(state.process_index, state.num_processes)
        return True

    @_is_accelerate_prepared.setter
    def _is_accelerate_prepared(self, value: bool) -> None:
        """Give batches on Accelerate's device from now on: ``accelerator.prepare`` sets it."""
        states = sys.modules["accelerate.state"]
        self._device = states.PartialState().device if value else None
        self._gradient_state = states.GradientState() if value else None

    def on_device(self, batch: Any) -> Any:
        """Return a batch on the device of Accelerate's process; as it is without Accelerate."""
        if self._device is None:
            return batch
        from accelerate.utils import send_to_device

        pinned = isinstance(batch, dict) and any(
            isinstance(value, torch.Tensor) and value.is_pinned() for value in batch.values()
        )
        return send_to_device(batch, self._device, non_blocking=pinned)

    def close(self) -> None:
        """End workers that persist, and close this process's videos; it can be used again."""
        if self._persistent is not None:
            self._forget(self._persistent)
        self.dataset.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: it has passes and workers of its own."""
        own = {"_persistent": None, "_begun_passes": 0, "sampler": None}
        making = replace(self.making, work=Work())
        return self.__dict__ | own | {"batches": copy.copy(self.batches), "making": making}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become a copy."""
        self.__dict__.update(state)
        if isinstance(self.batch_sampler, EpochBatches):
            self.__dict__["batch_sampler"] = self.batches
        self._set_sampler()

    def _forget(self, workers: Workers) -> None:
        """End workers; the next pass starts others."""
        if workers is self._persistent:
            self._persistent = None
        workers.end()

    def _workers_of_a_pass(self) -> Workers:
        """Return the workers of a pass that begins: those that persist, or new ones."""
        if self._persistent is not None and self._persistent.is_of_this_process:
            return self._persistent
        workers = Workers(self)
        if self.persistent_workers:
            self._persistent = workers
        return workers

    def _begin(self, begun: Pass) -> None:
        """Record that a pass begins."""
        self.batches.passes.begin(begun)
        self.end_of_dataloader = False
        self._pass_began_s, self._waited_s = perf_counter(), 0.0
        self._begun_passes += 1
        if self._begun_passes == 1 and self._gradient_state is not None:
            batches, self.remainder = self.batches, 0
            if not batches.drop_last:
                of_all_ranks = batches.batch_size * batches.world_size
                self.remainder = batches.samples_of_epoch % of_all_ranks
            self._gradient_state._add_dataloader(self)

    def _end(self, ended: Pass) -> None:
        """Record that a pass is over."""
        self.batches.passes.end(ended)
        self._begun_passes -= 1
        if self._begun_passes == 0 and self._gradient_state is not None:
            self._gradient_state._remove_dataloader(self)


class LoaderPass(Iterator[Any]):
    """One pass over the batches of a loader: what ``iter(loader)`` returns.

    It owns its position and its workers; no reference to it is kept elsewhere, so it ends when its
    loop is left.
    """

    def __init__(self, loader: PairsLoader) -> None:
        """Represent the next pass of a loader; workers start with the first batch."""
        self._loader = loader
        self._pass: Pass | None = None
        self._workers: Workers | None = None
        self._is_closed = False
        self._error: str | None = None
        self._pid = os.getpid()
        # Threads that share a pass take turns.
        self._lock = threading.RLock()

    def __len__(self) -> int:
        """Return how many batches it has in all."""
        return len((self._pass or self._loader.batches.next_pass()).share)

    def __next__(self) -> Any:
        """Return the next batch.

        Raises:
            PassError: If persistent workers serve a later pass, another process began this one, or
                an error ended it.
            WorkerError: If a worker process died.
        """
        if os.getpid() != self._pid:
            raise PassError(
                f"process {self._pid} began this pass, and its fork {os.getpid()} uses it: both "
                "would take batches from the same workers. Call iter(loader) in the process that "
                "uses it."
            )
        with self._lock:
            return self._next()

    def _next(self) -> Any:
        if self._error is not None:
            raise PassError(self._error)
        if self._pass is None and not self._is_closed:
            self._begin()
        begun, workers = self._pass, self._workers
        if begun is None or workers is None:
            raise StopIteration
        if workers.serves is not begun:
            raise PassError(
                f"this pass over epoch {begun.epoch} ended after {begun.taken} of {len(self)} "
                "batches, as another one was begun, or the loader closed: workers that persist "
                "serve one pass at a time. Use a loader for each, or persistent_workers=False."
            )
        loader, asked_s = self._loader, perf_counter()
        with self._ended_by_errors():
            batch = workers.next()
        loader._waited_s += perf_counter() - asked_s
        loader._passed_s = perf_counter() - loader._pass_began_s
        begun.taken += 1
        if begun.is_complete:
            loader.batches.passes.end(begun)
        loader.end_of_dataloader = begun.is_complete
        return loader.on_device(batch)

    def _begin(self) -> None:
        """Begin at the position that the loader is at now."""
        loader, batches = self._loader, self._loader.batches
        begun = batches.next_pass()
        # No reference to this pass in it: without a cycle, a pass that is left ends at once.
        batch_of = partial(batches.of_all_ranks.batch, epoch=begun.epoch)
        numbers: Iterator[Any] = map(batch_of, begun.share)
        if loader.batch_sampler is not batches:
            numbers = iter(loader.batch_sampler or ())
        workers = loader._workers_of_a_pass()
        if workers.serves is not None:
            batches.passes.end(workers.serves)
        loader._begin(begun)
        self._pass, self._workers = begun, workers
        with self._ended_by_errors():
            workers.begin(begun, numbers, loader)

    @contextmanager
    def _ended_by_errors(self) -> Iterator[None]:
        """Close the pass where an error is raised, and keep what is said to who asks on.

        Where a dead worker caused it, the error names that.
        """
        workers, death = self._workers, None
        try:
            yield
        except BaseException as error:
            begun = self._pass or self._loader.batches.next_pass()
            is_torchs = isinstance(error, RuntimeError | OSError | EOFError)
            if workers is not None and is_torchs and not isinstance(error, StereoGenBenchError):
                death = workers.error(error)
            if workers is not None and death is not None:
                self._loader._forget(workers)
            if isinstance(error, StopIteration):
                begun.is_exhausted = True
            else:
                self._error = (
                    f"this pass over epoch {begun.epoch} ended after {begun.taken} of {len(self)} "
                    "batches with an error: begin another one, or load a state."
                )
            self.close()
            if death is not None:
                raise death from error
            raise

    def close(self) -> None:
        """End the pass, begun or not; its workers end, too, unless they persist."""
        self._is_closed = True
        workers, self._workers = self._workers, None
        if self._pass is None or workers is None:
            return
        self._loader._end(self._pass)
        if self._pid == os.getpid() and self._loader.num_workers == 0:
            self._loader.dataset.stop_fetching()
        if workers is not self._loader._persistent:
            workers.end()

    def __reduce_ex__(self, protocol: SupportsIndex) -> Any:
        """Refuse to be copied or pickled: two passes would take batches from the same workers.

        Raises:
            PassError: Always.
        """
        raise PassError(
            "a pass over a loader cannot be copied: its workers serve one loop. Call iter(loader) "
            "for another pass, or copy the loader."
        )

    def __del__(self) -> None:
        """End the pass when no reference is left."""
        self.close()


def accelerates_epoch(dataset: object) -> int | None:
    """Return the epoch of the pass that Accelerate begins over a map-style dataset, None if none.

    Accelerate counts its passes, and calls ``set_epoch`` of a dataset in some of its loops only:
    neither where it shares batches among processes nor where it goes on in mid-epoch.
    """
    states = sys.modules.get("accelerate.state")
    active = None if states is None else states.GradientState().active_dataloader
    if active is None or getattr(active, "dataset", None) is not dataset:
        return None
    iteration = getattr(active, "iteration", None)
    return iteration if isinstance(iteration, int) else None
