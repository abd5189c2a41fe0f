"""The relations that must hold between the calibration controls, on whatever scenes."""

import math
import statistics

from stereogenbench_data.evaluation.aggregate import cell
from stereogenbench_data.evaluation.columns import HEAVY_TAILED
from stereogenbench_data.evaluation.controls import wrong_camera

TARGET, COPIED, WRONG, RANDOM = range(4)
"""The controls in the order in which they are scored."""

ORDERED = [
    ("psnr", (RANDOM,), (COPIED, WRONG)),
    ("ssim", (COPIED, WRONG, RANDOM), (TARGET,)),
    ("ssim", (RANDOM,), (COPIED, WRONG)),
    ("p_psnr", (RANDOM,), (TARGET, COPIED, WRONG)),
    ("e_match", (TARGET, COPIED, WRONG), (RANDOM,)),
    ("sd_filtered", (TARGET,), (COPIED,)),
    ("sd_filtered", (TARGET,), (WRONG,)),
]
"""A column, and the controls whose mean (of SD median) is below that of others."""


def broken_relations(results):
    """Return what does not hold; a control without any number of a column is passed over."""

    def middle(column, control):
        found = cell(results[control].pairs, column)
        return found.median if column in HEAVY_TAILED else found.mean

    target = results[TARGET]
    frames = sum(pair.frames for pair in target.pairs)
    copied_match = middle("e_match", COPIED)
    holds = {
        "every frame of the target is identical": cell(target.pairs, "psnr").infinite == frames,
        "E_match of the target is 0": middle("e_match", TARGET) in (0, None),
        "E_match of the copied left is above 0": copied_match is None or copied_match > 0,
    }
    for column, lower, upper in ORDERED:
        low, high = ([middle(column, each) for each in side] for side in (lower, upper))
        below = None in low + high or max(low) < min(high)
        holds[f"{column} of {lower} is below {upper}"] = below
    off = []
    for pair in results[WRONG].pairs:
        slope, r2 = pair.tallies["sd_filtered_slope"], pair.tallies["sd_filtered_r2"]
        if slope.finite and r2.mean >= 0.8:  # else the matcher's search is too short for it
            rig = target.index.scene(pair.row).rig
            other_cm = rig.baseline_cm(pair.pair[0], wrong_camera(*pair.pair))
            off.append(abs(slope.mean - pair.baseline_cm / other_cm))
    median_off = statistics.median_high(off) if off else math.nan
    holds["the wrong baseline's slope is the ratio of baselines"] = not median_off > 0.1
    return [what for what, is_so in holds.items() if not is_so]
