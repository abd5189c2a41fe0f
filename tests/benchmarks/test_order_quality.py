"""What batches show, beside a sampler that shuffles everything."""

import numpy as np
import pytest

from benchmarks.order_quality import order_quality
from stereogenbench_data import EpochBatches, StereoPairs


@pytest.fixture(scope="module")
def pairs(small_release):
    return StereoPairs(small_release, frames="all", pairs="all", fields=("__key__",))


def test_scenes_moments_and_frame_numbers_are_counted_as_by_hand(pairs):
    batches = EpochBatches(pairs, 12)
    order, plan = batches.of_all_ranks.order(0), pairs.plan
    found = order_quality(order, plan)
    rows = [
        [plan.locate(number, epoch=0) for number in order.batch(batch)]
        for batch in range(order.samples // 12)
    ]

    assert found.found.scenes == np.mean([len({each.row for each in row}) for row in rows])
    moments = [len({(each.row, each.frames) for each in row}) for row in rows]
    assert found.found.moments == np.mean(moments)
    spreads = [np.std([each.frames[0] for each in row]) for row in rows]
    assert found.found.frame_spread == pytest.approx(np.mean(spreads), rel=1e-12)
    assert found.found.scenes_in_1000_batches == 4
