"""A balanced subsample: as many pairs in every stratum of baseline, drawn by a seed.

The release's baselines follow what passed its filters (short gaps are the most frequent); the
paper asks those who need a uniform distribution to subsample. Source: the paper's appendix on
the realised baseline distributions.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.release import BASELINE_BINS, baseline_bin

Balance = Literal["bins", "log_baseline"]
LOG_STRATA = 16


def balanced(
    baselines_cm: Float64[np.ndarray, " n"], *, by: Balance, limit: int | None, seed: int
) -> Int64[np.ndarray, " m"]:
    """Return the places, ascending, of a subsample with equally many baselines of each stratum.

    Args:
        baselines_cm: Baselines in cm.
        by: "bins": the strata are the paper's baseline bins; "log_baseline": 16 equally wide
            intervals of log-baseline over the range at hand. Empty strata do not count.
        limit: How many to draw in all; the strata's shares differ by at most one. None draws as
            many from each stratum as the smallest one has.
        seed: The draw's seed.

    Raises:
        SelectionError: If a stratum has fewer baselines than its share of the limit, or the limit
            is less than one for each.
    """
    strata = _strata(baselines_cm, by=by)
    found = np.unique(strata).tolist()
    members = [np.flatnonzero(strata == stratum) for stratum in found]
    poorest = min(map(len, members))
    if limit is None:
        limit = poorest * len(found)
    if limit < len(found):
        raise SelectionError(
            f"limit={limit} is less than one pair for each of {len(found)} strata."
        )
    generator = np.random.default_rng(np.random.SeedSequence((seed, 0xBA1A)))
    drawn = []
    for number, (stratum, places) in enumerate(zip(found, members, strict=True)):
        share = limit // len(found) + (number < limit % len(found))
        if share > len(places):
            name = f"stratum {stratum + 1} of {LOG_STRATA} of log-baseline"
            if by == "bins":
                name = f"the bin {list(BASELINE_BINS)[stratum]} cm"
            raise SelectionError(
                f"balance={by!r}, limit={limit}: {share} pairs are wanted of {name}, which has "
                f"{len(places)}; the most that balances is {poorest * len(found)}."
            )
        drawn.append(generator.choice(places, size=share, replace=False))
    return np.sort(np.concatenate(drawn))


def _strata(baselines_cm: Float64[np.ndarray, " n"], *, by: Balance) -> Int64[np.ndarray, " n"]:
    if by == "bins":
        order = list(BASELINE_BINS)
        return np.array([order.index(baseline_bin(value)) for value in baselines_cm])
    if by != "log_baseline":
        raise SelectionError(f"balance must be 'bins' or 'log_baseline', got {by!r}.")
    logs = np.log(baselines_cm)
    width = max(float(np.ptp(logs)) / LOG_STRATA, np.finfo(np.float64).tiny)
    strata: Int64[np.ndarray, " n"] = ((logs - logs.min()) // width).astype(np.int64)
    strata[strata == LOG_STRATA] = LOG_STRATA - 1
    return strata
