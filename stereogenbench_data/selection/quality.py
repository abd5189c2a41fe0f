"""How well an order shuffles."""

from typing import NamedTuple

import numpy as np

from stereogenbench_data.selection.order import EpochOrder


class OrderQuality(NamedTuple):
    """How well an order shuffles.

    Attributes:
        fewest_scenes: Different scenes in the full batch that has fewest.
        mean_scenes: Different scenes in a full batch, on average.
        neighbour_correlation: Pearson's correlation between the numbers of samples that follow one
            another: 1 for the plan's own order, near 0 for a good shuffle.
    """

    fewest_scenes: int
    mean_scenes: float
    neighbour_correlation: float


def order_quality(order: EpochOrder, *, batches: int = 10_000) -> OrderQuality:
    """Return how well an order shuffles, from the first so many full batches of the epoch.

    >>> from stereogenbench_data.selection.order import EpochOrder, OrderRule
    >>> scenes = np.arange(65) * 81
    >>> order_quality(EpochOrder(scenes, OrderRule(16, kind="sequential"), epoch=0)).fewest_scenes
    1
    >>> order_quality(EpochOrder(scenes, OrderRule(16), epoch=0)).fewest_scenes
    14
    """
    full = min(batches, order.samples // order.rule.batch_size)
    numbers = np.array([order.batch(number) for number in range(full)])
    scenes = np.sort(order.scenes_of(numbers), axis=-1)
    different = 1 + (np.diff(scenes, axis=-1) != 0).sum(axis=-1)
    flat = numbers.ravel().astype(np.float64)
    correlation = np.corrcoef(flat[:-1], flat[1:])[0, 1]
    return OrderQuality(int(different.min()), float(different.mean()), float(correlation))
