"""The index: one row per scene, with all that selection and loading need before opening a video.

On disk it is one Parquet file; in memory one Arrow table, sorted by key. Paths are relative to the
data's root and never lead out of it.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index import compute as pc
from stereogenbench_data.index.arrow import as_categories, as_numpy, one_array, table_digest
from stereogenbench_data.index.open import open_table
from stereogenbench_data.index.open_tree import Opened, Rows, opened_report, with_baselines
from stereogenbench_data.index.parquet import (
    IndexHead,
    read_seek_tables,
    seek_tables_of,
    table_of_scenes,
    write_index_file,
)
from stereogenbench_data.index.rows import SCHEMA, SEEK_COLUMN, scene_of
from stereogenbench_data.schema.conventions import Conventions, Shape, shape_of_text
from stereogenbench_data.schema.records import Scene, SceneId, ShardFacts
from stereogenbench_data.schema.release import VIDEO_FILES
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.retry import RetryPolicy

if TYPE_CHECKING:
    from stereogenbench_data.index.build import TreeReport

_OF_BASELINES: Final = frozenset(
    {
        "baselines_cm", "focal_mm", "sensor_width_mm", "sensor_height_mm", "principal_x_px",
        "principal_y_px", "lateral_m", "scene_label", "scene_index", "label_map_name", "map_path",
        "character", "animation", "aperture_fstop",
    }
)  # fmt: skip
"""Columns for which each ``baseline.json`` behind a URL is read."""


class SceneIndex:
    """The scenes of one root, by row; rows are sorted by key.

    Attributes:
        root: The folder or URL to which the members' paths are relative, with its login if it has
            one; `where` is the version for display.
        retry: How reading from a URL is retried; None for the defaults.
        incomplete: Key to reason, for scenes that were not finished when the index was made.
        broken: Key to what is wrong, for scenes that were left out because of it.
        shards: What is known of each shard, by its path below the root; empty for folders.
        is_part: Whether it was made of a part of the root on purpose.
        stale: How the root differs from the index, and the cure; empty if no difference was found.
            URLs are not checked.
        is_from_file: Whether it was read from an index file, so that scenes which it leaves out
            were left out on purpose.
        presumption: What reads the scenes whose rows are presumed; None where all were read.
    """

    def __init__(self, opened: Opened, *, retry: RetryPolicy | None = None) -> None:
        """Take a checked table; use `open` or `from_scenes` to make an index."""
        self._head = head = opened.head
        self.root = head.root
        self.retry = retry
        self.incomplete = head.incomplete
        self.broken = head.broken
        self.shards = head.shards
        self.is_part = head.is_part
        self.stale = opened.stale
        self.is_from_file = bool(head.digest)
        self._table = opened.table
        self._columns: dict[str, np.ndarray] = {}
        self._digest = head.digest
        self._seek_tables = opened.seek_tables
        self.presumption = opened.presumption

    @classmethod
    def open(
        cls,
        data: str | Path,
        *,
        root: str | Path | None = None,
        retry: RetryPolicy | None = None,
        wanted: Callable[[SceneId], bool] | None = None,
        conventions: str | Path | Conventions | None = None,
        rows: Rows = "presumed",
    ) -> "SceneIndex":
        """Open the index of some data.

        An index opens data beside itself: in its own folder, or in a folder below that. Any other
        root is your own word, ``root``, as the file may be a stranger's.

        Args:
            data: An index file; a folder with an ``index.parquet``, such as one of shards; the URL
                of either (``https://``, ``hf://datasets/``, ``s3://``, or others of fsspec),
                of which only the index is fetched; or a folder in the released layout.
            root: Where the data of an index file are, whatever the file says: any folder or URL
                that you trust.
            retry: How slow a server may be.
            wanted: Which scenes of a folder without an index are described, by their paths; None
                is all.
            conventions: Where quantities stand in the files and how they are read, as
                ``stereogenbench conventions`` writes it: a file's path, or what is in it. The rows
                keep it, so that an index or shards made of this one need not be told again. Rows of
                an index are not described again: files of some scenes are compared with them.
            rows: How many scenes (64 and more) of a folder without an index are opened. "read"
                describes them all, in minutes for the whole release. "presumed" lists their files,
                reads each ``baseline.json`` and describes a few; the others are presumed to be like
                these, and `scene` describes them when they are needed. What was found out is
                kept in the user's cache, for as long as the files stay as they are.

        Warns with `IncompleteSceneWarning` of scenes that were left out: it counts them and names
        the first; and with `AssumptionWarning` of what was taken for granted, where the files of a
        folder without an index are not as the paper prints them and no conventions are given.

        Raises:
            StorageError: If there are no such data, they hold no scene, the index is damaged or of
                another version, only you may name the place of its data, more than a few scenes
                of a tree are broken, or the data contradict the conventions.
            SchemaError: If the conventions are not understood.
        """
        stated = None if conventions is None else Conventions.read(conventions)
        opened = open_table(
            data, root=root, retry=retry, wanted=wanted, conventions=stated, rows=rows
        )
        return cls(opened, retry=retry)

    @classmethod
    def from_scenes(
        cls,
        scenes: Iterable[Scene],
        root: str | Path,
        *,
        shards: Mapping[str, ShardFacts] | None = None,
        retry: RetryPolicy | None = None,
    ) -> "SceneIndex":
        """Return the index of some scenes, in any order.

        Args:
            scenes: The scenes, with the places of their members.
            root: The folder to which these places are relative.
            shards: What is known of each shard, if the members are in shards.
            retry: As for `open`.

        Raises:
            StorageError: If two scenes have one key, or a path leaves the root.
        """
        scenes = tuple(scenes)
        table = table_of_scenes(scenes, where=shown(root))
        head = IndexHead(str(root), shards=dict(shards or {}))
        return cls(Opened(table, head, seek_tables=seek_tables_of(scenes)), retry=retry)

    def only(self, rows: Iterable[int]) -> "SceneIndex":
        """Return an index of a few rows, small enough to be sent to a process with its work."""
        scenes = [self.scene(row) for row in rows]
        return SceneIndex.from_scenes(scenes, self.root, shards=self.shards, retry=self.retry)

    @classmethod
    def from_report(cls, report: "TreeReport") -> "SceneIndex":
        """Return the index of the scenes that a walk found, and of those that it left out."""
        return cls(opened_report(report))

    def __repr__(self) -> str:
        """Return the root without secrets, and the number of scenes and shards."""
        shards = f", {len(self.shards)} shards" if self.shards else ""
        return f"<SceneIndex of {self.where!r}: {len(self)} scenes{shards}>"

    def write(self, path: str | Path) -> None:
        """Write the index as one Parquet file, whole or not at all.

        If the file is in the root itself, data and index can be moved together; else it records
        where the root is.

        Raises:
            StorageError: If the file cannot be written, or rows of it are presumed.
        """
        if self.presumption is not None:
            raise StorageError(
                f"{self.where}: most of its rows are presumed, and an index must not be. Run "
                f"`stereogenbench index {self.where}`, or open it with rows='read'."
            )
        self.load_seek_tables()
        tables = None if isinstance(self._seek_tables, Path) else self._seek_tables
        head = replace(
            self._head, digest=self.digest, incomplete=self.incomplete, broken=self.broken
        )
        write_index_file(Path(path), self._table, head, seek_tables=tables)

    @property
    def where(self) -> str:
        """The root for messages, reports and other files: without login and query."""
        return shown(self.root)

    def __len__(self) -> int:
        """The number of scenes."""
        return int(self._table.num_rows)

    def scene(self, row: int, *, videos: Collection[str] = VIDEO_FILES) -> Scene:
        """Return the scene of a row; where rows are presumed, as its files say.

        Args:
            row: The row.
            videos: The videos that are needed; others of a presumed scene behind a URL are not
                opened.

        Raises:
            StorageError: If there is no such row, or the scene is not as presumed.
        """
        scene = self.indexed_scene(row)
        return scene if self.presumption is None else self.presumption.described(scene, videos)

    def indexed_scene(self, row: int) -> Scene:
        """Return what the index says of the scene of a row, presumed or not.

        Raises:
            StorageError: If there is no such row.
        """
        if not 0 <= row < len(self):
            raise StorageError(f"{self.where}: there is no row {row}; the index has {len(self)}.")
        return scene_of(self._table.slice(int(row), 1).to_pylist()[0])

    def load_seek_tables(self) -> bool:
        """Read where packets lie, if the index file has that; return whether scenes have it.

        An index of data on this machine is opened without it.
        """
        if isinstance(self._seek_tables, Path):
            found = read_seek_tables(self._seek_tables)
            self._seek_tables = found if found is not None and len(found) == len(self) else None
        return self._seek_tables is not None and self._seek_tables.null_count < len(self)

    def seek_tables(self, row: int) -> bytes | None:
        """Return where the packets of a scene's videos lie, as `Scene.seek_tables`.

        None where that is not known, or before `load_seek_tables`.
        """
        if self._seek_tables is None or isinstance(self._seek_tables, Path):
            return None
        packed: bytes | None = self._seek_tables[row].as_py()
        return packed

    def column(self, name: str) -> np.ndarray:
        """Return a column as a read-only array; `rows.SCHEMA` names them.

        ``members``, ``key_frames`` and the PSNRs are not among them: see `scene`, `key_frames`.

        Returns:
            (n,) numbers (nan where unknown) or, for texts, objects (None where unknown); (n, 15)
            float64 for ``baselines_cm``, (n, 6) for the columns with one value per camera.

        Raises:
            StorageError: If there is no such column.
        """
        if name not in self._columns:
            if name in _OF_BASELINES and self.presumption is not None:
                self._table, self.presumption = with_baselines(self.presumption, self._table)
            columns = [field.name for field in SCHEMA if not pa.types.is_list(field.type)]
            if name not in columns:
                known = ", ".join(columns)
                raise StorageError(f"the index has no column {name!r}; it has {known}.")
            if name == "caption" and self.presumption is not None:
                captions = self.presumption.captions(self.column("key"))
                self._columns[name] = np.array(captions, dtype=object)
            else:
                self._columns[name] = as_numpy(self._table.column(name))
            self._columns[name].setflags(write=False)
        return self._columns[name]

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """What conventions state about its scenes; () where they were described without any."""
        return tuple(map(shape_of_text, self.categories("conventions")[0]))

    def categories(self, name: str) -> tuple[list[str], np.ndarray]:
        """Return the different values of a column of texts, and which each scene has.

        Returns:
            The values, and (n,) int32, or (n, 6) for the columns with one value per camera, the
            place of each scene's value among them; -1 where it is unknown.
        """
        return as_categories(self._table.column(name))

    def key_frames(self) -> tuple[list[tuple[int, ...]], np.ndarray]:
        """Return the different lists of key frames that scenes have, and which each scene has.

        Returns:
            The lists, and (n,) int64, for each row the place of its list among them.
        """
        lists = [tuple(each or (0,)) for each in self._table.column("key_frames").to_pylist()]
        kinds = [(0,), *sorted({*lists} - {(0,)}, key=lambda each: (len(each), each))]
        places = {each: place for place, each in enumerate(kinds)}
        return kinds, np.array([places[each] for each in lists], dtype=np.int64)

    def remarked(self, about: str) -> np.ndarray:
        """Return the rows of scenes with a remark about something, ascending (`REMARKS`)."""
        lists = one_array(self._table.column("remarks"))
        names = pc.struct_field(lists.flatten(), "about").to_pylist()
        rows = as_numpy(pc.list_parent_indices(lists)).astype(np.int64)
        return np.unique(rows[[name == about for name in names]])

    def video_counts(self) -> np.ndarray:
        """Return how many videos each scene has, (n,) int64: below 12 in a part of a release."""
        lists = one_array(self._table.column("members"))
        names = pc.struct_field(lists.flatten(), "name")
        is_video = as_numpy(pc.starts_with(names, "cam_"))
        rows = as_numpy(pc.list_parent_indices(lists))
        return np.bincount(rows[is_video], minlength=len(self))

    @property
    def is_derived(self) -> bool:
        """Whether scenes of it were derived for training, with an error; released ones were not."""
        released: int = self._table.column("training_quality").null_count
        return released < len(self)

    @property
    def derivation(self) -> str:
        """What derived data are, for messages: of training shards, their size and quality."""
        for row in np.flatnonzero(self.column("training_quality").astype(bool))[:1].tolist():
            scene = self.scene(row)
            if scene.training is not None:
                return (
                    f"training shards, derived at {scene.rig.image_width_px}x"
                    f"{scene.rig.image_height_px} (quality {scene.training.quality}, "
                    f"{scene.training.codec}) from the index {scene.training.source_digest[:12]}"
                )
        return "released data"

    def require_released(self, doing: str) -> None:
        """Refuse derived data where released data are needed.

        Args:
            doing: What needs them, such as "An evaluation".

        Raises:
            StorageError: If scenes were derived for training.
        """
        if self.is_derived:
            raise StorageError(
                f"{self.where}: holds {self.derivation}. {doing} needs the released pictures, and "
                f"these have an error. Pass the released data."
            )

    @property
    def digest(self) -> str:
        """A sha256 of the rows: the same on every machine and in every version."""
        if not self._digest:
            presumption = self.presumption
            if presumption is not None and presumption.is_remote:
                # Its rows change once baselines are read.
                self._digest = presumption.tree.stamp
            else:
                self._digest = table_digest(self._table)
        return self._digest

    def parted(self) -> tuple[pa.Table, dict[str, Any]]:
        """Return the rows, and the rest that `of_parts` needs, to share the rows."""
        rest = self.__getstate__()
        table = rest.pop("_table")
        if isinstance(self._seek_tables, pa.Array):
            table = table.append_column(SEEK_COLUMN, rest.pop("_seek_tables"))
        return table, rest

    @classmethod
    def of_parts(cls, table: pa.Table, rest: Mapping[str, Any]) -> "SceneIndex":
        """Return the index that was `parted`, over the same rows wherever they are."""
        index = cls.__new__(cls)
        index.__dict__.update(rest)
        if SEEK_COLUMN in table.column_names:
            index._seek_tables = one_array(table.column(SEEK_COLUMN))
            table = table.drop_columns([SEEK_COLUMN])
        index._table = table
        return index

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs."""
        return self.__dict__ | {"_columns": {}}
