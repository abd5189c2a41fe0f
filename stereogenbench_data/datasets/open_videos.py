"""How many videos a process keeps open so that none is opened twice."""

import math
import warnings
from dataclasses import replace
from typing import Final

import numpy as np

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Stream
from stereogenbench_data.samples.streams import OPEN_STREAMS
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.order import (
    GROUPS_OF_LARGE,
    OPEN_SCENES,
    SHUFFLE_GROUPS,
    Numbers,
    OrderRule,
)
from stereogenbench_data.selection.plan import Plan

SPARE_FILES = 128
"""Open files that are left to everything else."""


GROUP_BYTES: Final = 900_000_000
"""Memory for the open scenes of a shuffle group, where nobody asks for a number of them."""

_DECODER_BYTES: Final = 17
"""Of a camera's decoders for each pixel: 12.6 of H.264 with its reference pictures, 4.3 of FFV1,
measured at 1280x1280."""

_KEPT_BYTES: Final = 4
"""Of the current picture and what is measured in it, kept for each pixel for other pairs."""

FRAMES_BYTES: Final = 500_000_000
"""Memory for further frames of a shuffle group's open scenes, where several samples show one."""

_FRAME_BYTES: Final = 6
"""Of a further frame for each pixel: the picture, stored depth and where it is measured."""


class OpenVideosWarning(UserWarning):
    """More videos are needed at a time than this process may open: some are opened repeatedly."""


class RepeatedDecodingWarning(UserWarning):
    """Several processes read the same shuffle group, so each of them decodes its videos."""


def videos_to_keep(
    plan: Plan, rule: OrderRule, *, streams: frozenset[Stream], processes: int
) -> int:
    """Return how many videos one of so many processes keeps open for its share of an epoch.

    A process reads every shuffle group of which it gets batches, each with its open scenes. A
    warning says what to do if the process may not open so many files, or if several processes
    decode the same videos and more groups would avoid it.
    """
    lengths = plan.runs.lengths
    groups = rule.groups_of(lengths)
    _warn_of_repeated_decoding(rule, lengths=lengths, processes=processes)
    scenes = groups // math.gcd(groups, processes) * rule.most_open(lengths)
    wanted = max(OPEN_STREAMS, scenes * videos_per_scene(plan, streams))
    allowed = max(OPEN_STREAMS, _most_files() - SPARE_FILES)
    if wanted > allowed:
        warnings.warn(
            f"up to {wanted} videos would be open at a time, and this process may open {allowed}: "
            "they will be closed and opened again, which is slow. Raise the limit (`ulimit -n "
            f"{wanted + SPARE_FILES}`), use more workers, or fewer open_scenes than "
            f"{rule.open_scenes}.",
            OpenVideosWarning,
            stacklevel=5,
        )
    return min(wanted, allowed)


def _warn_of_repeated_decoding(rule: OrderRule, *, lengths: Numbers, processes: int) -> None:
    together = processes // math.gcd(rule.shuffle_groups, processes)
    spared = replace(rule, shuffle_groups=math.lcm(rule.shuffle_groups, processes)).groups_of(
        lengths
    )
    if together > 1 and lengths.max() > 1 and spared % processes == 0:
        warnings.warn(
            f"every video is decoded by {together} processes, as {processes} (ranks times workers) "
            f"read {rule.shuffle_groups} shuffle groups: give shuffle_groups={processes}, or a "
            "multiple of it. This is another order of the epoch; each group has its own open "
            "scenes.",
            RepeatedDecodingWarning,
            stacklevel=6,
        )


def fitting_rule(
    rule: OrderRule, index: SceneIndex, plan: Plan, *, open_scenes: int | None
) -> OrderRule:
    """Return a rule with as many open scenes and frames as fit into the memory of a shuffle group.

    They depend on the selected pairs and the stored size of their pictures alone, not on fields,
    ranks or workers: so does the order.

    Args:
        rule: The rule without them.
        index: The scenes.
        plan: The selection.
        open_scenes: How many scenes the user asks for; None for as many as fit.
    """
    shares_moments = bool((plan.runs.pairs > 1).any())
    of_cameras = _camera_pixels(index, plan)
    scene_bytes = open_scene_bytes(index, plan)
    fitting = max(2, GROUP_BYTES // max(1, scene_bytes))
    if open_scenes is None:
        open_scenes = min(max(OPEN_SCENES, rule.batch_size), fitting)
    rule = replace(rule, open_scenes=open_scenes)
    frames = 1
    if shares_moments:
        further = FRAMES_BYTES // max(1, open_scenes * of_cameras * _FRAME_BYTES)
        frames = max(1, min(1 + further, -(-rule.batch_size // open_scenes)))
    return replace(
        rule,
        shuffle_groups=SHUFFLE_GROUPS if fitting >= OPEN_SCENES else GROUPS_OF_LARGE,
        open_frames=frames,
    )


def open_scene_bytes(index: SceneIndex, plan: Plan) -> int:
    """Return about how much memory the decoders of an open scene take, at the most."""
    shares_moments = bool((plan.runs.pairs > 1).any())
    return _camera_pixels(index, plan) * (_DECODER_BYTES + (_KEPT_BYTES if shares_moments else 0))


def _camera_pixels(index: SceneIndex, plan: Plan) -> int:
    """Return how many pixels the pictures of the needed cameras have, at the most."""
    rows = plan.scene_rows
    pixels = (index.column("image_width_px")[rows] * index.column("image_height_px")[rows]).max()
    return int(pixels) * videos_per_scene(plan, frozenset({"source_rgb", "target_rgb"}))


def _most_files() -> int:
    """Return how many files this process may open; 512 where the system does not say."""
    try:
        import resource
    except ImportError:
        return 512
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def videos_per_scene(plan: Plan, streams: frozenset[Stream]) -> int:
    """Return how many videos the samples of one scene are made from, at the most."""
    pairs = plan.pairs
    scene = np.repeat(np.arange(len(plan.scene_rows)), np.diff(plan.first_pair))
    used = np.zeros((len(plan.scene_rows), 2, CAMERA_COUNT), dtype=bool)
    for kind, suffix in enumerate(("rgb", "depth")):
        if f"source_{suffix}" in streams:
            used[scene, kind, pairs.source] = True
        if f"target_{suffix}" in streams:
            for targets in pairs.targets.T:
                there = targets >= 0
                used[scene[there], kind, targets[there]] = True
    return int(used.sum(axis=(1, 2)).max())
