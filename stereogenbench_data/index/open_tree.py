"""Opening a tree: scenes without an index, read whole where they are few, presumed where many.

What was read is kept in the user's cache. What was taken for granted about the files of a tree is
told in one line (`assumptions`).
"""

import gc
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import pyarrow as pa

from stereogenbench_data.errors import (
    StorageError,
)
from stereogenbench_data.index import compute as pc
from stereogenbench_data.index.arrow import table_digest
from stereogenbench_data.index.parquet import (
    INDEX_NAME,
    IndexHead,
    seek_tables_of,
    table_of_scenes,
)
from stereogenbench_data.index.rows import scene_of
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.records import Scene, SceneId, remarks_told
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.sources.location import (
    shown,
)
from stereogenbench_data.sources.retry import RetryPolicy

if TYPE_CHECKING:
    from stereogenbench_data.index.build import Tree, TreeReport
    from stereogenbench_data.index.presumed import Baselines, Presumption


MOST_REMOTE_SCENES: Final = 64
"""The most scenes behind a URL that are described when a tree without an index is opened."""


MOST_LEFT_OUT: Final = 0.05
"""The largest share of a tree's scenes that may be broken; one always may."""


_LONGEST_REASON: Final = 5000


_SHOWN: Final = 10


_LOOKED_AT: Final = 64
"""How many scenes tell what opening a tree takes for granted."""


class IncompleteSceneWarning(UserWarning):
    """Some scenes of the data cannot be used; the message names them and the reasons."""


Rows = Literal["presumed", "read"]
"""Whether the rows of many scenes without an index may be presumed; see `index.presumed`."""


SeekTables: TypeAlias = pa.BinaryArray | Path | None
"""The packed seek tables of scenes, a row each, or the index file that holds them; None where there
are none."""


class Opened(NamedTuple):
    """An index that was opened.

    Attributes:
        table: A checked table with one row per scene.
        head: What is known besides, with the root where the data are.
        stale: How the root differs from the index, with the cure; "" if it does not.
        seek_tables: Where the packets of the videos lie.
        assumed: What was taken for granted about the files of a tree; "" where nothing was.
        presumption: What describes the scenes of a table that is presumed; None for one that was
            read.
    """

    table: pa.Table
    head: IndexHead
    stale: str = ""
    seek_tables: SeekTables = None
    assumed: str = ""
    presumption: "Presumption | None" = None


def open_tree(
    root: str | Path,
    *,
    wanted: Callable[[SceneId], bool] | None,
    rows: Rows,
    conventions: Conventions | None,
    retry: RetryPolicy | None,
) -> Opened:
    """Return the scenes of a folder or URL in the released layout, without a few broken ones.

    Those of a large folder are kept in the user's cache, and presumed where that is possible.
    """
    # What describes files takes long to import, and an index needs none of it.
    from stereogenbench_data.index.build import POOL_FROM, find_tree, walk_tree
    from stereogenbench_data.index.presumed import FEW_REMOTE

    with _no_collection():
        tree = find_tree(root, wanted=wanted, if_none="all", conventions=conventions, retry=retry)
        is_large = len(tree.keys) >= (POOL_FROM if tree.remote is None else FEW_REMOTE)
        tree = tree.listed() if is_large else tree
    if is_large and rows == "presumed" and not (tree.stated and tree.stated.has):
        opened = _open_presumed(tree, "read" if tree.remote is None else "when needed")
        if opened is not None:
            return opened

    def read() -> Opened:
        if tree.remote is not None:
            _require_few(tree)
        # In this process: a script without `if __name__ == "__main__"` could start no others.
        return _of_report(walk_tree(tree, workers=1))

    return (_once(tree, "read", read) if is_large else None) or read()


def _open_presumed(tree: "Tree", baselines: "Baselines") -> Opened | None:
    """Return the scenes of a tree, most of them presumed; None where nothing can be presumed."""
    from stereogenbench_data.index.presumed import Presumption, presumed_report

    def presumed() -> Opened | None:
        with _no_collection():
            report = presumed_report(tree, baselines)
            return None if report is None else _of_report(report)

    opened = _once(tree, "presumed" if baselines == "read" else "listed", presumed)
    if opened is None:
        return None
    forms = opened.table.column("pose_form").drop_null().to_pylist()
    presumption = Presumption(tree, forms=forms, baselines=baselines)
    return opened._replace(presumption=presumption)


def _once(tree: "Tree", name: str, find: Callable[[], Opened | None]) -> Opened | None:
    """Return the rows of a tree that an earlier opening has kept, or find and keep them."""
    name = f"{name}-{tree.stamp}"
    kept = tree.cache.table(name)
    if kept is not None:
        table, head, tables = kept
        # Without a digest: the user has made no index file.
        head = replace(head, root=str(tree.root), digest="")
        return Opened(table, head, seek_tables=tables, assumed=_assumed_of(table, where=head.root))
    found = find()
    if found is not None and not isinstance(found.seek_tables, Path):
        head = replace(found.head, digest=table_digest(found.table))
        tree.cache.keep_table(name, found.table, head, found.seek_tables)
    return found


def with_baselines(presumption: "Presumption", table: pa.Table) -> "tuple[pa.Table, Presumption]":
    """Return presumed rows once each ``baseline.json`` was read.

    Raises:
        StorageError: If one of them cannot be used, or read.
    """
    if presumption.baselines == "read":
        return table, presumption
    opened = _open_presumed(presumption.tree, "read")
    if opened is None or opened.presumption is None or opened.table["key"] != table["key"]:
        why = "" if opened is None else listed(opened.head.incomplete | opened.head.broken)
        raise StorageError(
            f"{shown(presumption.tree.root)}: not all scenes are as was presumed: {why}. "
            f"{presumption.cures()}"
        )
    return opened.table, opened.presumption


def _require_few(tree: "Tree") -> None:
    """Refuse to describe many scenes behind a URL each time they are opened."""
    count, where = len(tree.keys), shown(tree.root)
    if count > MOST_REMOTE_SCENES:
        raise StorageError(
            f"{where}: has no {INDEX_NAME}, its scenes cannot be presumed to be alike, and {count} "
            f"are too many to fetch their headers each time. Index it once, or the part you need: "
            f"`stereogenbench index {where} -o index.parquet --split eval`, and open that file "
            f"with --root {where}, or SceneIndex.open('index.parquet', root=...)."
        )


@contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage: beside torch's objects, the rows of thousands of scenes cost a third."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _of_report(report: "TreeReport") -> Opened:
    """Return the scenes that a walk found.

    Raises:
        StorageError: If no scene is whole, or more than a few are broken.
    """
    from stereogenbench_data.index.build import FORMAT_CURE

    where = shown(report.root)
    if not report.scenes:
        cure = f"\n{FORMAT_CURE.format(root=where)}" if report.broken else ""
        raise StorageError(
            f"{where}: no scene is complete: {listed(report.broken | report.incomplete)}{cure}"
        )
    found = len(report.scenes) + len(report.broken)
    if len(report.broken) > max(1, found * MOST_LEFT_OUT):
        raise StorageError(
            f"{where}: {listed(report.broken)}\nRepair or remove them; or leave them out on "
            f"purpose: `stereogenbench index {where}` makes an index without them."
        )
    opened = opened_report(report)
    return opened._replace(assumed=_assumed_of(opened.table, where=where))


def opened_report(report: "TreeReport") -> Opened:
    """Return the scenes that a walk found as an index."""
    table = table_of_scenes(report.scenes, where=shown(report.root))
    return Opened(table, report.head, seek_tables=seek_tables_of(report.scenes))


def _assumed_of(table: pa.Table, *, where: str) -> str:
    """Return what was taken for granted, by some of the scenes whose files were all read."""
    is_odd = pc.or_(pc.is_valid(table.column("pose_form")), pc.is_valid(table.column("remarks")))
    scenes = table.filter(is_odd).slice(0, _LOOKED_AT).to_pylist()
    return assumptions(map(scene_of, scenes), where=where)


def listed(left_out: Mapping[str, str]) -> str:
    """Return how many scenes are left out, and the first of them with the reasons."""
    lines = [
        shortened(reason if key in reason else f"{key}: {reason}", _LONGEST_REASON)
        for key, reason in sorted(left_out.items())[:_SHOWN]
    ]
    if len(left_out) > _SHOWN:
        lines.append(f"and {len(left_out) - _SHOWN} more")
    return "\n  ".join([f"{counted(len(left_out), 'scene')} cannot be used:", *lines])


_ASSUMED: Final = (
    "size", "stated", "baselines", "pair", "frames", "lens", "marker", "world", "pixels",
)  # fmt: skip
"""Remarks that are told when a tree is opened."""


_PLAIN: Final = "unreal axes"


class AssumptionWarning(UserWarning):
    """Files of a tree are not as the paper prints them, and something was taken for granted."""


def assumptions(scenes: Iterable[Scene], *, where: str) -> str:
    """Return what was taken for granted about scenes and what was measured; "" if nothing."""
    scenes = [scene for scene in scenes if scene.conventions is None]
    forms = Counter(
        (scene.pose_form or _PLAIN).split("|")[0].partition(" @ ")[0]
        for scene in scenes if not scene.remark("world")
    )  # fmt: skip
    told = remarks_told(scenes, _ASSUMED) + [
        f"poses are read as {shortened(form, 200)}: measured, the cameras' distances are the "
        f"baselines ({counted(count, 'scene')})"
        for form, count in forms.items() if _PLAIN not in form
    ]  # fmt: skip
    if not told:
        return ""
    return (
        f"{where}: {'; '.join(told)}. `stereogenbench conventions {where} -o conventions.toml` "
        f"writes down how its files are read, for conventions=."
    )
