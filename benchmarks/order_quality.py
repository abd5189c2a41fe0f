"""How well an order shuffles: what its batches show, beside a sampler that shuffles everything."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Int64

from stereogenbench_data.selection.order import EpochOrder
from stereogenbench_data.selection.plan import Plan

_LONG: Final = 1000
"""Over so many batches scenes are counted."""


@dataclass(frozen=True, slots=True)
class BatchContent:
    """What full batches show, on average.

    Attributes:
        scenes: Different scenes in a batch.
        moments: Different moments in a batch: frames of a scene, or clips.
        frame_spread: Standard deviation of the frame numbers in a batch; of clips, of their first.
        scenes_in_1000_batches: Different scenes in 1,000 batches that follow one another, or in as
            many as there are.
    """

    scenes: float
    moments: float
    frame_spread: float
    scenes_in_1000_batches: int


@dataclass(frozen=True, slots=True)
class OrderQuality:
    """What the batches of an order show, beside those of a permutation of all samples.

    Attributes:
        batch_size: Samples in a batch.
        found: Of the order.
        shuffled: Of a fully shuffled sampler.
    """

    batch_size: int
    found: BatchContent
    shuffled: BatchContent

    @property
    def frame_spread_ratio(self) -> float:
        """The spread of frame numbers as a share of the shuffled sampler's; 1 if that has none."""
        independent = self.shuffled.frame_spread
        return self.found.frame_spread / independent if independent else 1.0

    def __str__(self) -> str:
        """Say it in a line."""
        return (
            f"a batch of {self.batch_size} shows {self.found.scenes:.1f} scenes and "
            f"{self.found.moments:.1f} moments ({self.shuffled.scenes:.1f} and "
            f"{self.shuffled.moments:.1f} fully shuffled), frame numbers spread "
            f"{self.frame_spread_ratio:.2f} of fully shuffled, "
            f"{self.found.scenes_in_1000_batches} scenes in 1,000 batches"
        )


def order_quality(order: EpochOrder, plan: Plan, *, batches: int = _LONG) -> OrderQuality:
    """Return what so many batches from the epoch's start on show.

    >>> from stereogenbench_data import EpochBatches, StereoPairs
    >>> pairs = StereoPairs(getfixture("small_release"), frames="all")
    >>> order = EpochBatches(pairs, 4).of_all_ranks.order(0)
    >>> print(order_quality(order, pairs.plan))  # doctest: +ELLIPSIS
    a batch of 4 shows ... scenes in 1,000 batches
    """
    size = order.rule.batch_size
    full = max(1, min(batches, order.samples // size))
    rows = np.stack([order.batch(number) for number in range(full)])
    drawn = np.random.default_rng(0).integers(0, order.samples, rows.shape)
    found, shuffled = (_content(each, plan, epoch=order.epoch) for each in (rows, drawn))
    return OrderQuality(size, found, shuffled)


def _content(numbers: Int64[np.ndarray, "b n"], plan: Plan, *, epoch: int) -> BatchContent:
    scenes = np.searchsorted(plan.first_sample, numbers, side="right") - 1
    windows = (numbers - plan.first_sample[scenes]) // np.diff(plan.first_pair)[scenes]
    frames = np.array(
        [plan.locate(number, epoch=epoch).frames[0] for number in numbers.ravel().tolist()]
    ).reshape(numbers.shape)
    most = int(windows.max()) + 1
    return BatchContent(
        scenes=float(_different(scenes).mean()),
        moments=float(_different(scenes * most + windows).mean()),
        frame_spread=float(frames.std(axis=1).mean()),
        scenes_in_1000_batches=len(np.unique(scenes[:_LONG])),
    )


def _different(values: Int64[np.ndarray, "b n"]) -> Int64[np.ndarray, " b"]:
    """Return how many different numbers each row has."""
    found: Int64[np.ndarray, " b"] = 1 + (np.diff(np.sort(values, axis=1), axis=1) != 0).sum(axis=1)
    return found
