"""Whether the contestants load the same samples: compares the arrays of each with ours."""

from collections.abc import Collection
from typing import Any

import numpy as np
import torch

from benchmarks.clock import in_a_fork
from benchmarks.contestants import limit
from benchmarks.field import CONTESTANTS, LIMIT, entrants, why_not
from benchmarks.material import Material
from benchmarks.workloads import WORKLOADS, Job, tiny
from stereogenbench_data import StereoPairs

Key = tuple[str, int, int, int]
Difference = dict[str, float]


def differences(material: Material, *, only: Collection[str] = ()) -> dict[str, dict[str, Any]]:
    """Return, by workload and contestant, the difference of its samples from ours.

    It compares a few samples of each workload (or of the named ones). ``samples`` is their number,
    ``grey`` the mean difference of pictures in grey levels, ``worst_grey`` the largest, and
    ``ulps`` the largest difference of disparities in ulps of float32 (from the limit, where depth
    was measured). ``error`` is the message of a failure.
    """
    found: dict[str, dict[str, Any]] = {}
    for workload in (tiny(each) for each in WORKLOADS if not only or each.name in only):
        found[workload.name] = {}
        for name, _ in entrants(workload):
            reason = why_not(name)
            if reason is None:
                job = Job(workload, material, reading=CONTESTANTS[name].reading)
                result = in_a_fork(lambda name=name, job=job: difference(name, job))
            else:
                result = {"error": reason}
            found[workload.name][name] = result
    return found


def difference(name: str, job: Job) -> Difference:
    """Return the difference of a contestant's samples from ours."""
    torch.set_num_threads(1)
    pairs = StereoPairs(job.tree, **job.selection)
    ours = {_key(sample): sample for sample in (pairs[number] for number in job.numbers)}
    theirs = samples_of(name, job)
    worst = {"samples": 0.0, "grey": 0.0, "worst_grey": 0.0, "ulps": 0.0}
    for key, sample in theirs:
        _widen(worst, sample, ours[key], is_limit=name == LIMIT)
        worst["samples"] += 1
    return worst


def samples_of(name: str, job: Job) -> list[tuple[Key, dict[str, np.ndarray]]]:
    """Return all of a contestant's samples as arrays, by scene, cameras and first frame."""
    batches = CONTESTANTS[name].batches
    if batches is None:
        return [
            (
                (wanted.scene, wanted.left, wanted.right, wanted.frames[0]),
                {field: np.array(array) for field, array in sample.items()},
            )
            for sample in limit.samples(job, job.of_scene)
            for wanted in [sample.pop("wanted")]
        ]
    found = []
    for batch in batches(job, num_workers=0):
        for place in range(len(batch["scene"])):
            sample = {field: values[place] for field, values in batch.items()}
            arrays = {
                field: np.asarray(value)
                for field, value in sample.items()
                if field in ("left", "right", "disparity", "disparity_right")
            }
            found.append((_key(sample), arrays))
    return found


def _key(sample: dict[str, Any]) -> Key:
    left, right = np.asarray(sample["pair"]).tolist()
    return sample["scene"], left, right, int(np.asarray(sample["frame_index"]).flat[0])


def _widen(
    worst: Difference, theirs: dict[str, np.ndarray], ours: dict[str, Any], *, is_limit: bool
) -> None:
    for field in ("left", "right"):
        grey = np.abs(theirs[field].astype(np.int16) - np.asarray(ours[field]))
        worst["grey"] = max(worst["grey"], float(grey.mean()))
        worst["worst_grey"] = max(worst["worst_grey"], float(grey.max()))
    for field in ("disparity", "disparity_right"):
        if field not in ours:
            continue
        own, other = np.asarray(ours[field]), theirs[field]
        # The limit masks nothing: where depth was not measured, it divides all the same.
        kept = own > 0 if is_limit else np.ones(own.shape, dtype=bool)
        error = np.abs(other[kept].astype(np.float64) - own[kept]) / np.spacing(own[kept])
        worst["ulps"] = max(worst["ulps"], float(error.max(initial=0)))
