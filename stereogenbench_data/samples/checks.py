"""Checks before the first sample: missing videos, lossy depth, unusual rigs and units."""

import multiprocessing
import warnings
from typing import Any

import numpy as np

from stereogenbench_data.errors import MediaError, StorageError, text_without_secrets
from stereogenbench_data.geometry.rig import RECTIFIED_PX
from stereogenbench_data.index.open_tree import MOST_LEFT_OUT
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import EnlargedSizeWarning, Request, warn_if_swapped
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import CAMERA_COUNT, DEFAULT_DEPTH_UNIT_M, depth_name
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.plan import Plan


class OddSceneWarning(UserWarning):
    """Selected scenes differ from what the release promises: the message says how and which."""


def without_odd_scenes(index: SceneIndex, plan: Plan, request: Request) -> Plan:
    """Return a plan without the few scenes that cannot give what is requested.

    These lack a video that others have, or a field of them is held up by what is not understood.
    `OddSceneWarning` counts them and names the first.

    Raises:
        StorageError: If they are more than a few; it names the field, the first scene and why.
    """
    reasons: dict[int, str] = {}
    selected = set(plan.scene_rows.tolist())
    for name in request.fields:
        for about in request.known[name].stopped_by:
            for row in selected.intersection(index.remarked(about).tolist()):
                text = index.indexed_scene(row).remark(about).rstrip(".")
                reasons.setdefault(row, f"{name!r} needs {text}")
    for row in selected.intersection(index.remarked("videos").tolist()):
        if _missing_videos(index, plan, request, int(np.searchsorted(plan.scene_rows, row))):
            reasons.setdefault(row, index.indexed_scene(row).remark("videos"))
    if not reasons:
        return plan
    first = min(reasons)
    told = (
        f"{index.where}: {counted(len(reasons), 'selected scene')} of {len(selected)} cannot give "
        f"what is asked for. The first: {index.column('key')[first]}: {reasons[first]}."
    )
    if len(reasons) == len(selected) or len(reasons) > max(1, MOST_LEFT_OUT * len(selected)):
        raise StorageError(
            f"{told} Leave out that field, choose other pairs or scenes, or mend the files."
        )
    if multiprocessing.parent_process() is None:
        message = f"{told} Left out: {', '.join(index.column('key')[sorted(reasons)[:3]])}."
        warnings.warn(text_without_secrets(message), OddSceneWarning, stacklevel=5)
    return plan.without(index, sorted(reasons))


def check_samples(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Check, by the index alone, that the samples of a plan can be made as requested.

    Warns with `OddSceneWarning` where rigs are not rectified, or where a scene's cameras state
    several units of depth, with `SwappedSizeWarning` where height and width look exchanged, and
    with `EnlargedSizeWarning` where a size is larger than training shards store.

    Raises:
        StorageError: If the index lacks a video that a sample needs; it names the first scene and
            the cameras.
        MediaError: If depth that a sample needs is stored by a codec or pixel format that loses
            depth, and the request's depth contract does not accept it; it names the first file.
    """
    _require_videos(index, plan, request)
    if request.streams & {"source_depth", "target_depth"}:
        _require_whole_depth(index, plan, request)
    _warn_of_odd_scenes(index, plan, request)
    if request.size is not None and len(plan.scene_rows):
        rig = index.indexed_scene(int(plan.scene_rows[0])).rig
        stored = (rig.image_height_px, rig.image_width_px)
        warn_if_swapped(request.size, stored=stored)
        if index.is_derived and (request.size[0] > stored[0] or request.size[1] > stored[1]):
            warnings.warn(
                f"{index.where}: holds {index.derivation}, and size={request.size!r} (height, "
                f"width) is larger: pictures and depth are enlarged. Leave size out, or pass "
                f"released data.",
                EnlargedSizeWarning,
                stacklevel=5,
            )


def _require_videos(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Refuse samples of videos that the index does not have: some cameras alone were downloaded."""
    partial = index.video_counts()[plan.scene_rows] < 2 * CAMERA_COUNT
    for place in np.flatnonzero(partial).tolist():
        missing = _missing_videos(index, plan, request, place)
        if missing:
            scene = index.indexed_scene(int(plan.scene_rows[place]))
            there = sorted({name[4:6] for name in scene.members if name.startswith("cam_")})
            raise StorageError(
                f"{index.where}: {scene.id.key} has no {', '.join(missing)}; videos of cameras "
                f"{', '.join(there) or 'none'} were fetched. Choose pairs of these, or download "
                "the others too."
            )


def _missing_videos(index: SceneIndex, plan: Plan, request: Request, place: int) -> list[str]:
    """Return the videos that the samples of a scene need and that are not there."""
    pairs = slice(plan.first_pair[place], plan.first_pair[place + 1])
    sources = set(plan.pairs.source[pairs].tolist())
    targets = set(plan.pairs.targets[pairs].ravel().tolist()) - {-1}
    needed = {
        f"cam_{camera:02d}_{stream.partition('_')[2]}"
        for stream in request.streams
        for camera in (sources if stream.startswith("source") else targets)
    }
    members = index.indexed_scene(int(plan.scene_rows[place])).members
    return sorted(needed - {name.partition(".")[0] for name in members})


def _require_whole_depth(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Refuse depth that its contract does not accept, or whose unit is not known.

    Files that are stored alike are one kind, of which the first is looked at.
    """
    pairs = plan.pairs
    cameras = np.concatenate([pairs.source[:, None], pairs.targets], axis=1)
    if "source_depth" not in request.streams:
        cameras = cameras[:, 1:]
    if "target_depth" not in request.streams:
        cameras = cameras[:, :1]
    pair, place = np.nonzero(cameras >= 0)
    rows, cameras = pairs.row[pair], cameras[pair, place]
    kinds = index.categories("conventions")[1][rows].astype(np.int64)
    for name in ("depth_codec", "depth_pixel_format", "depth_unit_source"):
        values, value = index.categories(name)
        kinds = kinds * (len(values) + 1) + value[rows, cameras] + 1
    for first in np.sort(np.unique(kinds, return_index=True)[1]):
        _require_whole(index.indexed_scene(int(rows[first])), int(cameras[first]), request.depth)


def _require_whole(scene: Scene, camera: int, contract: DepthEncoding | None) -> None:
    from stereogenbench_data.media import depth  # slow to import

    held = scene.held_name(depth_name(camera))
    name = scene.members[held].path
    if not name.endswith(held):
        name = f"{name}: {scene.id.key}.{held}"
    encoding = scene.depth_encoding(camera, contract or depth_of(scene))
    depth.require_depth_stream(
        codec=scene.depth_codec[camera],
        pixel_format=scene.depth_pixel_format[camera],
        encoding=encoding,
        name=name,
    )
    if encoding.unit_m is None:
        unknown = f"{name}: {depth.NO_DEPTH_UNIT}. {depth.DEPTH_CURES}"
        raise MediaError(scene.remark("depth") or unknown)


def _warn_of_odd_scenes(index: SceneIndex, plan: Plan, request: Request) -> None:
    needs = {request.known[name].needs_poses for name in request.fields}
    rows = plan.scene_rows
    if "unless rectified" in needs:
        residuals_px = index.column("rig_residual_px")[rows]
        _warn(
            index, rows[residuals_px > RECTIFIED_PX],
            f"are not rectified (by up to {residuals_px.max(initial=0):.3g} px): their pixels are "
            "projected through the poses, and no field holds what that moves up or down",
        )  # fmt: skip
        unknown = np.intersect1d(rows, index.remarked("poses"))
        reason = index.indexed_scene(int(unknown[0])).remark("poses") if len(unknown) else ""
        _warn(
            index, unknown,
            f"have poses that are not understood, so their rigs are assumed rectified, with the "
            f"baselines of baseline.json ({reason}). `stereogenbench doctor` measures from the "
            f"pictures whether they are",
        )  # fmt: skip
    if request.streams & {"source_depth", "target_depth"} and not (
        request.depth and request.depth.unit_m
    ):
        units_m = index.column("depth_unit_m")[rows]
        defaults = (index.column("depth_unit_source")[rows] == "default").any(axis=1)
        _warn(
            index, rows[defaults],
            f"state no unit of depth, so the release's default of {DEFAULT_DEPTH_UNIT_M:g} m is "
            f"taken. `stereogenbench doctor {text_without_secrets(index.where)}` measures it from "
            f"the pictures; DepthEncoding(unit_m=...) sets it",
        )  # fmt: skip
        _warn(
            index, rows[(units_m != units_m[:, :1]).any(axis=1)],
            "state other units of depth for some cameras than for others: if a tag is missing or "
            "wrong, pass DepthEncoding(unit_m=...)",
        )  # fmt: skip


def _warn(index: SceneIndex, rows: Any, what: str) -> None:
    if len(rows):
        keys = ", ".join(index.column("key")[rows[:3]])
        text = f"{index.where}: {len(rows)} selected scenes {what}. The first: {keys}."
        warnings.warn(text, OddSceneWarning, stacklevel=6)
