"""The rule of an epoch's order: what users ask for, and as many open scenes as fit into memory."""

from dataclasses import replace
from typing import Any, Final, TypedDict

import numpy as np

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Stream
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.order import (
    DropLast,
    OrderRule,
    groups_for,
    open_runs_for,
    usual_groups,
)
from stereogenbench_data.selection.plan import Plan
from stereogenbench_data.selection.signatures import Told

RANK_BYTES: Final = 3_600_000_000
"""Memory for the open scenes of a rank, where nobody asks for a number of them."""

_DECODER_BYTES: Final = 17
"""Of a camera's decoders for each pixel: 12.6 of H.264 with its reference pictures, 4.3 of FFV1,
measured at 1280x1280."""

_KEPT_BYTES: Final = 4
"""Of the current picture and what is measured in it, kept for each pixel for other pairs."""

FRAMES_BYTES: Final = 2_000_000_000
"""Memory for further frames of a rank's open scenes, where several samples show one."""

_FRAME_BYTES: Final = 6
"""Of a further frame for each pixel: the picture, stored depth and where it is measured."""


class EpochOptions(TypedDict, total=False):
    """How an epoch is ordered and divided among ranks.

    Attributes:
        seed: The seed of the order, the same on all ranks; that of the dataset if left out.
        rank: Whose batches these are, from 0. By default torch.distributed's rank, or 0 where it is
            not initialised.
        world_size: How many ranks there are. By default torch.distributed's world size, or 1.
        shuffle: Whether samples are shuffled, by default; False gives them by their numbers.
        drop_last: What happens to the epoch's last batches. True, the default of a shuffled order:
            each rank gets as many batches, all of them full; what is left over is dropped (see
            `EpochBatches.left_out`). False, the default otherwise: every sample exactly once; the
            last batch may be short, and ranks may differ by one batch. "pad": each rank gets as
            many full batches and no sample is left out; samples from the epoch's start fill up,
            marked in the field ``is_padding`` (batch,) bool.
        shuffle_groups: How many groups of scenes are shuffled separately, for ranks: batch n is of
            group n mod shuffle_groups. If left out 8, or fewer with larger batches, pictures or
            fewer scenes, raised to a multiple of the ranks; a state keeps it, and goes on with it
            under other ranks. A number that is given counts.
        open_scenes: The shuffle buffer, counted in scenes: how many each group interleaves. If left
            out, about 64 of all groups together, or a batch where that is more (with few scenes a
            few more), but of large pictures no more than about 3.6 GB of decoders hold: of
            1280x1280 pixels 64 with one pair a scene, and 17 with all pairs. Fewer take less memory
            and shuffle less well. A rank has those of its groups open, shared out among its
            workers.
        open_frames: How many neighbouring frames of each open scene are interleaved, where several
            samples show a frame (all pairs). A batch then shows more moments, and their pictures
            and depth stay in memory. If left out, as many as a batch has samples of an open scene,
            within 2 GB: 2 with all pairs of 1280x1280 pixels and a batch of 32, 1 with one pair a
            scene.
    """

    seed: int
    rank: int
    world_size: int
    shuffle: bool
    drop_last: DropLast
    shuffle_groups: int
    open_scenes: int
    open_frames: int


EPOCH_DEFAULTS: Final[dict[str, Any]] = {
    "seed": Told("the dataset's"),
    "rank": Told("torch.distributed's, or 0"),
    "world_size": Told("torch.distributed's, or 1"),
    "shuffle": True,
    "drop_last": Told("as shuffle"),
    "shuffle_groups": Told("at most 8, a multiple of the ranks"),
    "open_scenes": Told("about 64 of all groups"),
    "open_frames": Told("as fit into 2 GB"),
}
"""What is taken for options that are left out; `fitting_rule` computes the last ones."""


def fitting_rule(
    index: SceneIndex, plan: Plan, batch_size: int, options: EpochOptions, *, world_size: int
) -> OrderRule:
    """Return a rule with as many open scenes and frames as fit into the memory of a rank.

    They depend on the selected pairs and the stored size of their pictures alone, not on fields or
    workers, and on ranks only in that they share the groups out. What a user asks for counts
    instead.

    Raises:
        SelectionError: If an option is out of its range.
    """
    rule = OrderRule(
        batch_size,
        seed=options.get("seed", plan.seed),
        shuffle=options.get("shuffle", EPOCH_DEFAULTS["shuffle"]),
    )
    rows, runs = plan.scene_rows, plan.runs
    shares_moments = bool((runs.pairs > 1).any())
    pixels = (index.column("image_width_px")[rows] * index.column("image_height_px")[rows]).max()
    of_cameras = int(pixels) * videos_per_scene(plan, frozenset({"source_rgb", "target_rgb"}))
    # About what the decoders of an open scene take, at the most.
    scene_bytes = of_cameras * (_DECODER_BYTES + (_KEPT_BYTES if shares_moments else 0))
    size, fitting = rule.batch_size, max(2, RANK_BYTES // max(1, scene_bytes))
    usual = groups_for(runs, batch_size=size, fitting=fitting, world_size=world_size)
    rule = replace(
        rule,
        shuffle_groups=options.get("shuffle_groups", usual),
        open_scenes=options.get("open_scenes", size),
    )
    groups = rule.groups_of(runs.lengths)
    if "open_scenes" not in options:
        wanted = open_runs_for(runs, batch_size=size, fitting=fitting, groups=groups)
        rule = replace(rule, open_scenes=wanted)
    frames = 1
    if shares_moments:
        of_rank = min(groups, usual_groups(batch_size=size, fitting=fitting))
        further = FRAMES_BYTES // max(1, of_rank * rule.open_scenes * of_cameras * _FRAME_BYTES)
        frames = max(1, min(1 + further, -(-size // rule.open_scenes)))
    return replace(rule, open_frames=options.get("open_frames", frames))


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
