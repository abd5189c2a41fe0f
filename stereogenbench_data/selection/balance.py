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
    """Return places of a subsample that holds equally many baselines of every stratum, ascending.

    Args:
        baselines_cm: Baselines in cm.
        by: "bins": the strata are the paper's baseline bins; "log_baseline": 16 equally wide
            intervals of log-baseline over the range at hand. Strata without any baseline at all
            do not count.
        limit: How many to draw in all; the strata's shares then differ by one at the most.
            None draws as many from each stratum as the poorest one has.
        seed: The draw's seed.

    Raises:
        SelectionError: If a stratum is poorer than its share of the limit.
    """
    strata = _strata(baselines_cm, by=by)
    names, stratum = np.unique(strata, return_inverse=True)
    members = [np.flatnonzero(stratum == number) for number in range(len(names))]
    poorest = min(map(len, members))
    shares = [poorest] * len(members) if limit is None else _shares(limit, len(members))
    generator = np.random.default_rng(np.random.SeedSequence((seed, 0xBA1A)))
    drawn = []
    for name, places, share in zip(names, members, shares, strict=True):
        if share > len(places):
            raise SelectionError(
                f"balance={by!r}, limit={limit}: {share} pairs are wanted of "
                f"{_stratum_name(name, by=by)}, which has {len(places)}; the most that balances is "
                f"{poorest * len(members)}."
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


def _shares(limit: int, strata: int) -> list[int]:
    if limit < strata:
        raise SelectionError(f"limit={limit} is less than one pair for each of {strata} strata.")
    return [limit // strata + (number < limit % strata) for number in range(strata)]


def _stratum_name(stratum: int, *, by: Balance) -> str:
    if by == "bins":
        return f"the bin {list(BASELINE_BINS)[stratum]} cm"
    return f"stratum {stratum + 1} of {LOG_STRATA} of log-baseline"
