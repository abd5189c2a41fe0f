"""The audit of a data set: the paper's geometry table and quality checks, scene by scene."""

import hashlib
import json
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np
from jaxtyping import Int64

from stereogenbench_data.audit.geometry.records import (
    AuditReport,
    Finding,
    SceneAudit,
    broken_finding,
    findings_of,
    untested_of,
)
from stereogenbench_data.audit.geometry.scene_audit import AuditTask, audit_scene
from stereogenbench_data.audit.geometry.table import table_rows
from stereogenbench_data.audit.scene_access import source_of, spread
from stereogenbench_data.errors import SchemaError, SelectionError, StorageError
from stereogenbench_data.index.build import walk
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.rows import row_of
from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex
from stereogenbench_data.index.tree import SceneFolder
from stereogenbench_data.index.tree_cache import TreeCache
from stereogenbench_data.jobs import WORK_DEFAULTS, WorkOptions, do_items
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes, may_pass
from stereogenbench_data.selection.options import require_options, split_options
from stereogenbench_data.selection.signatures import list_options
from stereogenbench_data.sources.location import is_remote, joined, local_path
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import MissingObject

DEFAULT_FRAMES: Final = 5
_FORMAT: Final = 10


class AuditOptions(WorkOptions, SceneFilters, total=False):
    """How an audit is run (`WorkOptions`), and of which scenes (`SceneFilters`)."""


@list_options(WORK_DEFAULTS)
def open_for_audit(
    data: str | Path,
    *,
    root: str | Path | None = None,
    conventions: str | Path | Conventions | None = None,
    **options: Unpack[AuditOptions],
) -> SceneIndex:
    """Return the index of data in which scenes may be broken; the index lists those scenes.

    Args:
        data: Whatever `SceneIndex.open` opens.
        root: Where the data of an index file are, if the user says so.
        conventions: As for `SceneIndex.open`.
        **options: How a tree without an index is read (progress is in scenes); scenes of it whose
            paths do not match are not read.

    Raises:
        StorageError: If there is no such data, or it has no such scene.
    """
    if root is None and _is_plain_tree(data):
        work, filters = split_options(options, WorkOptions)
        report = walk(
            data if is_remote(data) else local_path(data),
            **work,
            wanted=may_pass(filters),
            conventions=None if conventions is None else Conventions.read(conventions),
        )
        return SceneIndex.from_report(report)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IncompleteSceneWarning)
        return SceneIndex.open(data, root=root, conventions=conventions)


def _is_plain_tree(data: str | Path) -> bool:
    """Return whether data are a folder without an index, here or behind a URL."""
    if not is_remote(data):
        path = local_path(data)
        return path.is_dir() and not (path / INDEX_NAME).is_file()
    if str(data).endswith(".parquet"):
        return False
    try:
        RemoteObject(joined(str(data).rstrip("/"), INDEX_NAME)).size()
    except MissingObject:
        return True
    return False


@list_options(WORK_DEFAULTS)
def audit(
    data: str | Path | SceneIndex,
    *,
    sample: int | None = None,
    frames: int = DEFAULT_FRAMES,
    **options: Unpack[AuditOptions],
) -> AuditReport:
    """Measure whether data are right: the paper's geometry audit and its quality checks.

    `reprojection` defines the reprojection error. A broken scene does not stop the audit; it is
    a finding. The user's cache keeps the result of each scene until the audit ends, so that a
    stopped one goes on with the same number of frames; filters may differ.

    Args:
        data: A released tree, shards, an index file, the URL of either, or an index.
        sample: How many scenes, evenly spread; None for all.
        frames: How many frames of each scene, evenly spread; 0 for all, as in the paper.
        **options: How it is run, and of which scenes. Progress is in frames, before that in the
            scenes of a tree that are read.

    Raises:
        StorageError: If there are no such data, they were derived for training, or a worker
            process died.
        SelectionError: If no scene passes the filters.

    Source: the StereoGenBench paper, section on geometry conventions and sanity checks, and on
    quality control.
    """
    require_options(audit, options)
    work, filters = split_options(options, WorkOptions)
    index = data if isinstance(data, SceneIndex) else open_for_audit(data, **options)
    index.require_released("The audit")
    broken, incomplete = (_wanted(each, filters) for each in (index.broken, index.incomplete))
    rows = _chosen(index, sample, filters, left_out=broken | incomplete)
    scenes = [index.scene(int(row)) for row in rows]
    cache, kind = TreeCache(index.root), f"audit-{_FORMAT}-{frames}"
    names = {scene.id.key: _stamp(index, scene) for scene in scenes}
    found: dict[str, SceneAudit] = {}
    for key, name in names.items():
        with suppress(KeyError, TypeError, ValueError):  # there is none, or it is damaged
            found[key] = SceneAudit.revived(json.loads(cache.read(kind, name) or b""))
    tasks = [
        AuditTask(scene, source_of(index, scene), frames)
        for scene in scenes
        if scene.id.key not in found
    ]

    def keep(each: SceneAudit) -> None:
        found[each.key] = each
        cache.keep(kind, names[each.key], json.dumps(asdict(each)).encode())

    do_items(
        audit_scene,
        tasks,
        name=lambda task: task.scene.id.key,
        keep=keep,
        options=work,
        done=sum(len(known.audited_frames) for known in found.values()),
        total=sum(len(spread(scene.frames, frames)) for scene in scenes),
    )
    for name in names.values():
        cache.forget(kind, name)
    audited = [found[scene.id.key] for scene in scenes]
    findings = [broken_finding(key, text) for key, text in sorted(broken.items())]
    chosen = {scene.key for scene in audited}
    findings += [
        Finding(key, "", "subset", f"is of unseen_map, and train has scenes of its map {name}")
        for key, name in index.seen_maps_called_unseen().items() if key in chosen
    ]  # fmt: skip
    for scene in audited:
        findings += findings_of(scene)
    untested = [each for scene in audited for each in untested_of(scene)]
    return AuditReport(
        root=index.where,
        scenes_there=len(index) + len(index.broken) + len(index.incomplete),
        scenes_audited=len(audited),
        frames=frames,
        rows=table_rows(audited, findings),
        findings=tuple(findings),
        untested=tuple(untested),
        notes=tuple(f"incomplete, not audited: {text}" for text in incomplete.values()),
        scenes=tuple(audited),
    )


def _wanted(unusable: Mapping[str, str], filters: SceneFilters) -> dict[str, str]:
    """Return the scenes, among those that could not be indexed, whose paths pass the filters."""
    passes = may_pass(filters)
    wanted = {}
    for key, reason in unusable.items():
        with suppress(SchemaError):
            if passes is None or passes(parse_scene_key(key)):
                wanted[key] = reason
    return wanted


def _chosen(
    index: SceneIndex, sample: int | None, filters: SceneFilters, *, left_out: Mapping[str, str]
) -> Int64[np.ndarray, " n"]:
    """Return the rows to audit, ascending; none if every wanted scene was left out."""
    wanted = filters.get("scenes")
    if wanted is not None:
        keys = [wanted] if isinstance(wanted, str) else list(wanted)
        kept = [key for key in keys if key not in left_out]
        filters = {**filters, "scenes": kept or keys}
    try:
        rows = filter_scenes(index, filters)
    except SelectionError:
        if not left_out:
            raise
        return np.empty(0, dtype=np.int64)
    return rows[list(spread(len(rows), sample or 0))]


def _stamp(index: SceneIndex, scene: Scene) -> str:
    """Return a hash that changes when a scene's row or one of its local files does."""
    parts: list[Any] = [row_of(scene)]
    if not index.shards and not is_remote(index.root):
        try:
            parts.append(SceneFolder(index.root, scene.id.key).stamps())
        except StorageError as error:
            parts.append(str(error))
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]
