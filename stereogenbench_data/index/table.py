"""The index: one row per scene, with all that selection and loading need before opening a video.

On disk it is one Parquet file; in memory one Arrow table, sorted by key. Paths are relative to the
data's root and never lead out of it. `SceneIndex.open` makes one of any data:

    a file ─────────────────────┬─ read ── root of its data ── digest ── is it stale?
    a folder with an index file ┘
    a URL ──────── fetched ─────── read ────────────────────── digest
    a folder or URL without one ── its scenes: all opened where they are few, some where many

An index file may come from a stranger: it opens data beside itself, and any other root is the
user's own word. Conventions that are given for an index are compared with its rows
(`_with_conventions`).
An index is old if its folder holds other scenes or shards (`_stale_message`): the names of folders
tell, as copies and unpacked archives change dates; 7 ms for 8,493 scenes. What was read of a tree
is kept in the user's cache, and what was taken for granted of it is told in one line.
"""

import copy
import gc
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import numpy as np
import pyarrow as pa

from stereogenbench_data.errors import (
    SchemaError,
    StorageError,
    explain_os_errors,
    text_without_secrets,
)
from stereogenbench_data.index import compute as pc
from stereogenbench_data.index.arrow import as_categories, as_numpy, one_array, table_digest
from stereogenbench_data.index.left_out import are_few, listed, reasons_told
from stereogenbench_data.index.parquet import (
    INDEX_NAME,
    IndexHead,
    made_again,
    read_index_file,
    read_seek_tables,
    seek_tables_of,
    table_of_scenes,
    write_index_file,
)
from stereogenbench_data.index.rows import SCHEMA, SEEK_COLUMN, scene_of
from stereogenbench_data.schema.conventions import Conventions, declaration_of_text
from stereogenbench_data.schema.declaration import Declaration
from stereogenbench_data.schema.records import Scene, SceneId, ShardFacts, remarks_told
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    COMPLETE_JSON,
    DEFAULT_DEPTH_UNIT_M,
    TRAJECTORY_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.sources.location import is_remote, joined, local_path, shown, split_name
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import MissingObject, RetryPolicy

if TYPE_CHECKING:
    from stereogenbench_data.index.build import Outcome, Tree, TreeReport
    from stereogenbench_data.index.unopened import Baselines, UnopenedScenes

MAX_INDEX_BYTES: Final = 256 * 2**20
"""The largest index that is fetched. One of 8,493 scenes has a few megabytes."""
FEW_REMOTE: Final = 8
"""Fewer scenes behind a URL are all opened."""
MOST_REMOTE_SCENES: Final = 64
"""The most scenes behind a URL that are described when a tree without an index is opened."""
_LOOKED_AT: Final = 64
"""How many scenes tell what opening a tree takes for granted."""
_READ_AGAIN: Final = 3
"""How many scenes' files are read again by the conventions."""
_NAMED: Final = 3
_OF_BASELINES: Final = frozenset(
    {
        "baselines_cm", "focal_mm", "sensor_width_mm", "sensor_height_mm", "principal_x_px",
        "principal_y_px", "lateral_m", "scene_label", "scene_index", "label_map_name", "map_path",
        "character", "animation", "aperture_fstop",
    }
)  # fmt: skip
"""Columns that only each ``baseline.json`` tells."""
_REQUESTS_A_MINUTE: Final = 600
"""The Hub answers 3,000 requests in five minutes."""


class IncompleteSceneWarning(UserWarning):
    """Some scenes of the data cannot be used; the message names them and the reasons."""


class StaleIndexWarning(UserWarning):
    """A folder holds scenes or shards that its index lacks, or lacks some that it lists."""


class AssumptionWarning(UserWarning):
    """Something was taken for granted: of scenes that were not opened, or of odd files."""


Rows = Literal["settled", "read"]
"""Whether some of many scenes settle what the others have, or all are read (`index.unopened`)."""


SeekTables: TypeAlias = pa.BinaryArray | Path | None
"""The packed seek tables of scenes, a row each, or the index file that holds them; None where there
are none."""


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
        unopened: What opens the scenes that were not opened yet; None where all were.
        others: The scenes of a folder without an index that were not wanted when it was opened.
        lacking: The keys of scenes that were told to lack a file when a folder was opened.
    """

    def __init__(
        self,
        table: pa.Table,
        head: IndexHead,
        *,
        seek_tables: SeekTables = None,
        retry: RetryPolicy | None = None,
    ) -> None:
        """Take a checked table; use `open` or `from_scenes` to make an index."""
        self._head = head
        self.root = head.root
        self.retry = retry
        self.incomplete = head.incomplete
        self.broken = head.broken
        self.shards = head.shards
        self.is_part = head.is_part
        self.stale = ""
        self.is_from_file = bool(head.digest)
        self._table = table
        self._columns: dict[str, np.ndarray] = {}
        self._digest = head.digest
        self._seek_tables = seek_tables
        self.unopened: UnopenedScenes | None = None
        self.others: tuple[SceneId, ...] = ()
        self.lacking: frozenset[str] = frozenset()
        self.has_captions = True

    @classmethod
    def open(
        cls,
        data: str | Path,
        *,
        root: str | Path | None = None,
        retry: RetryPolicy | None = None,
        wanted: Callable[[SceneId], bool] | None = None,
        conventions: str | Path | Conventions | None = None,
        rows: Rows = "settled",
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
                opens all, in minutes for the whole release. "settled" opens some 20 of all scenes;
                frames, picture size, depth and poses of the others are taken to be as most of these
                have them, and compared when `scene` opens them. On a disk each ``baseline.json`` is
                read, behind a URL none (see `with_baselines`). What was found out is kept in the
                user's cache, for as long as the files stay as they are.

        Warns with `IncompleteSceneWarning` of scenes that were left out, or will be where the file
        is needed that they lack: it counts them and names the first; and with `AssumptionWarning`
        of what was taken for granted: of scenes that were not opened, and where files are not as
        the paper prints them and no conventions are given.

        Raises:
            StorageError: If there are no such data, they hold no scene, the index is damaged or of
                another version, only you may name the place of its data, more than a few scenes
                of a tree are broken, or the data contradict the conventions.
            SchemaError: If the conventions are not understood.
        """
        stated = None if conventions is None else Conventions.read(conventions)
        named_root = None if root is None else _require_root(root)
        if is_remote(data):
            place: str | Path = str(data).rstrip("/")
            index, where = _index_of_url(str(data), root=named_root, retry=retry), shown(data)
        else:
            place = local_path(data)
            index, where = _index_of_path(place, root=named_root), str(place)
        if index is None:
            if named_root is not None:
                raise StorageError(
                    f"{shown(place)}: has no {INDEX_NAME}, and a root was named for the data of "
                    f"one. Leave root out, or pass the index file."
                )
            index = _open_tree(place, wanted=wanted, conventions=stated, rows=rows, retry=retry)
        index.retry = retry
        if stated is not None:
            table = _with_conventions(index._table, index._head, stated, retry=retry)
            if table is not index._table:
                index._table, index._digest = table, table_digest(table)
        lacking = {} if index.is_from_file else _lacking(index)
        index.lacking = frozenset(lacking)
        left_out = index.incomplete | index.broken
        if left_out or lacking:
            told = [listed(left_out)] if left_out else []
            if lacking:
                what = f"{counted(len(lacking), 'scene')} left out where a file is needed"
                told.append(f"{what}:\n  {reasons_told(lacking)}")
            message = text_without_secrets(f"{where}: {'; '.join(told)}")
            warnings.warn(message, IncompleteSceneWarning, stacklevel=2)
        if index.stale:
            warnings.warn(index.stale, StaleIndexWarning, stacklevel=2)
        if not index.is_from_file and (assumed := _assumed_of(index)):
            warnings.warn(assumed, AssumptionWarning, stacklevel=2)
        return index

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
        head = IndexHead(str(root), shards=dict(shards or {}))
        table = table_of_scenes(scenes, where=shown(root))
        return cls(table, head, seek_tables=seek_tables_of(scenes), retry=retry)

    def only(self, rows: Iterable[int]) -> "SceneIndex":
        """Return an index of a few rows, small enough to be sent to a process with its work."""
        scenes = [self.scene(row) for row in rows]
        return SceneIndex.from_scenes(scenes, self.root, shards=self.shards, retry=self.retry)

    @classmethod
    def from_report(cls, report: "TreeReport") -> "SceneIndex":
        """Return the index of the scenes that a walk found, and of those that it left out."""
        head = IndexHead(
            report.root,
            incomplete=report.incomplete,
            broken=report.broken,
            is_part=report.is_part,
        )
        table = table_of_scenes(report.scenes, where=shown(report.root))
        return cls(table, head, seek_tables=seek_tables_of(report.scenes))

    def __repr__(self) -> str:
        """Return the root without secrets, and how many scenes, shards and unopened scenes."""
        shards = f", {len(self.shards)} shards" if self.shards else ""
        unopened = f"; {self.not_opened}" if self.unopened is not None else ""
        return f"<SceneIndex of {self.where!r}: {len(self)} scenes{shards}{unopened}>"

    @property
    def not_opened(self) -> str:
        """How many scenes were not opened yet, and what is taken for granted of them."""
        if self.unopened is None:
            return ""
        return self.unopened.told(self.indexed_scene(0), self.column("key").tolist())

    def with_baselines(self) -> "SceneIndex":
        """Return the index with what each ``baseline.json`` says: baselines, lenses and labels.

        Of a tree behind a URL that takes a request a scene; of other data nothing is to be done.

        Raises:
            StorageError: If more than a few of them cannot be used.
        """
        unopened = self.unopened
        if unopened is None or unopened.baselines == "read":
            return self
        index = _open_settled(unopened.tree, unopened.outcomes, "read")
        assert index is not None  # training shards were told apart when the tree was opened
        index.retry, index.others, index.lacking = self.retry, self.others, self.lacking
        if new := {key: why for key, why in index.broken.items() if key not in self.broken}:
            told = text_without_secrets(f"{self.where}: {listed(new)}")
            warnings.warn(told, IncompleteSceneWarning, stacklevel=2)
        return index

    def with_captions(
        self, file: str | None = None, *, scene: str = "$.scene", caption: str = "$.caption"
    ) -> "SceneIndex":
        """Return the index with the caption of each scene.

        Args:
            file: A file of JSON lines below the root that holds the captions of all scenes, such as
                the merged summary that the paper names; None reads the description of each scene
                that was not opened.
            scene: Where a record has the path of its scene.
            caption: Where a record has the caption.

        Raises:
            StorageError: If the file cannot be read, or a scene has no record.
            SchemaError: If the file is not of JSON lines, or a place is none.
        """
        keys = self.column("key").tolist()
        if file is not None:
            from stereogenbench_data.index.captions import captions_of_file  # slow to import

            places = {"scene": scene, "caption": caption}
            found = captions_of_file(self.root, file, **places, retry=self.retry)
            if lacking := [key for key in keys if key not in found]:
                raise StorageError(
                    f"{self.where}/{file}: has no record of {counted(len(lacking), 'scene')} of "
                    f"{len(keys)}, such as {lacking[0]}; it has {len(found)}, such as "
                    f"{shortened(next(iter(found), 'none'))}. Check the place {scene!r}."
                )
            captions = [found[key] for key in keys]
        elif self.unopened is not None:
            captions = self.unopened.captions(keys)
        else:
            return self
        index = copy.copy(self)
        # What was not opened has the digest of its listing or files, and other rows a new one.
        index._digest = "" if self.unopened is None else self.digest
        index._columns = {}
        column = SCHEMA.get_field_index("caption"), SCHEMA.field("caption")
        index._table = self._table.set_column(*column, pa.array(captions, type=pa.string()))
        index.has_captions = True
        return index

    def write(self, path: str | Path) -> None:
        """Write the index as one Parquet file, whole or not at all.

        If the file is in the root itself, data and index can be moved together; else it records
        where the root is.

        Raises:
            StorageError: If the file cannot be written, or scenes of it were not opened.
        """
        if self.unopened is not None:
            raise StorageError(
                f"{self.where}: most of its scenes were not opened, and an index holds opened "
                f"ones. Run `stereogenbench index {self.where}`, or open it with rows='read'."
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
        """Return the scene of a row, as its files say if it was not opened yet.

        Args:
            row: The row.
            videos: The videos that are needed; others of such a scene behind a URL are not opened.

        Raises:
            StorageError: If there is no such row, or the scene is not as its row says.
        """
        scene = self.indexed_scene(row)
        return scene if self.unopened is None else self.unopened.scene(scene, videos)

    def indexed_scene(self, row: int) -> Scene:
        """Return what the index says of the scene of a row, opened or not.

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
            StorageError: If there is no such column, or it is of files behind a URL that were not
                read.
        """
        if name not in self._columns:
            self._require_read(name)
            columns = [field.name for field in SCHEMA if not pa.types.is_list(field.type)]
            if name not in columns:
                known = ", ".join(columns)
                raise StorageError(f"the index has no column {name!r}; it has {known}.")
            if name == "caption" and not self.has_captions and self.unopened is not None:
                captions = self.unopened.captions(self.column("key"))
                self._columns[name] = np.array(captions, dtype=object)
            else:
                self._columns[name] = as_numpy(self._table.column(name))
            self._columns[name].setflags(write=False)
        return self._columns[name]

    def _require_read(self, name: str) -> None:
        """Refuse a column of files behind a URL that opening the tree did not read."""
        unopened, call = self.unopened, ""
        if unopened is not None and unopened.is_remote:
            if name == "caption" and not self.has_captions:
                call = "with_captions"
            elif name in _OF_BASELINES and unopened.baselines != "read":
                call = "with_baselines"
        if call:
            what = "description" if name == "caption" else "baseline.json"
            minutes = -(-len(self) // _REQUESTS_A_MINUTE)
            raise StorageError(
                f"{self.where}: {name} stands in the {what} of each of {len(self):,} scenes, which "
                f"were not read: that is {len(self):,} requests, on the Hub without a login some "
                f"{counted(minutes, 'minute')}. Run `stereogenbench index {self.where} -o "
                f"index.parquet` once and open that; or read them now: "
                f"SceneIndex.open({self.where!r}).{call}()."
            )

    @property
    def shapes(self) -> tuple[Declaration, ...]:
        """What conventions state about its scenes; () where they were described without any."""
        return tuple(map(declaration_of_text, self.categories("conventions")[0]))

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

    def seen_maps_called_unseen(self) -> dict[str, str]:
        """Return the scenes of unseen_map whose maps scenes of train have, too: key to map."""
        maps, subsets = self.column("map_name"), self.column("subset")
        of_train = {*maps[self.column("split") == "train"].tolist()}
        rows = [row for row in np.flatnonzero(subsets == "unseen_map") if maps[row] in of_train]
        return dict(zip(self.column("key")[rows].tolist(), maps[rows].tolist(), strict=True))

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
            unopened = self.unopened
            if unopened is not None and unopened.is_remote:
                # Its rows change once baselines are read.
                self._digest = unopened.tree.stamp
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


# Opening an index.


def _index_of_path(path: Path, *, root: str | None) -> SceneIndex | None:
    """Return the index in a file or folder; None of a folder without one.

    The user or, within limits, the file names its data's root.

    Raises:
        StorageError: If it is damaged or not an index of this version, or only the user may name
            the place of its data.
    """
    with explain_os_errors(f"{path}: cannot be looked at"):
        is_folder, is_file = path.is_dir(), path.is_file()
        is_tree = is_folder and not (path / INDEX_NAME).is_file()
    if is_tree:
        return None
    if not (is_folder or is_file):
        raise StorageError(
            f"{path}: does not exist; expected an index file, a folder with {INDEX_NAME} or a "
            f"folder in the released layout."
        )
    file = path / INDEX_NAME if is_folder else path
    table, head = read_index_file(file, where=str(file))
    head = replace(head, root=_recorded_root(file, head, table) if root is None else root)
    index = SceneIndex(table, head, seek_tables=file)
    if not is_remote(head.root):
        index.stale = _stale_message(table, head, index_file=file)
    return index


def _index_of_url(url: str, *, root: str | None, retry: RetryPolicy | None) -> SceneIndex | None:
    """Return the index at a URL, fetched; None of a folder without one.

    Its data are beside it, unless the user names another root.
    """
    beside, name = split_name(url)
    is_folder = not name.endswith(".parquet")
    if is_folder:
        beside, url = url.rstrip("/"), joined(url.rstrip("/"), INDEX_NAME)
    remote = RemoteObject(url, retry=retry)
    try:
        size = remote.size()
    except MissingObject:
        if is_folder:
            return None
        raise
    if size > MAX_INDEX_BYTES:
        raise StorageError(
            f"{remote.where}: an index may have {MAX_INDEX_BYTES:,} bytes, this one has "
            f"{size:,}. It was not read. Check that the URL is that of an {INDEX_NAME}."
        )
    content = pa.BufferReader(remote.read(0, size))
    table, head = read_index_file(content, where=remote.where)
    head = replace(head, root=root or beside)
    content.seek(0)
    return SceneIndex(table, head, seek_tables=read_seek_tables(content))


def _require_root(root: str | Path) -> str:
    """Return the root that the user named: any URL, or a folder."""
    if is_remote(root):
        return str(root)
    folder = local_path(root)
    if not str(root) or not folder.is_dir():
        raise StorageError(
            f"{str(root)!r}: not a folder, and was named as the root of an index's data. Name the "
            f"folder or URL to which the paths in the index are relative."
        )
    return str(folder)


def _recorded_root(path: Path, head: IndexHead, table: pa.Table) -> str:
    """Return the data's root: the index's own folder, or a recorded folder below it.

    Raises:
        StorageError: If the user must name the root, or it is not a folder.
    """
    beside, recorded = path.parent, head.root
    if recorded == "." or not table.num_rows:
        return str(beside)
    if any((beside / file["path"]).exists() for file in table.column("members")[0].as_py()):
        return str(beside)
    folder = None
    with suppress(OSError, ValueError, RuntimeError):  # not a path
        is_url = recorded[:5].lower() == "file:"
        place = local_path(recorded) if is_url else Path(recorded)
        folder = None if is_remote(recorded) else (beside / place).resolve()
    if folder is None or not folder.is_relative_to(beside.resolve()):
        raise StorageError(
            f"{path}: its data are not beside it, and it records their root as "
            f"{shortened(repr(shown(recorded)), 300)}. An index opens data beside itself; any "
            f"other root is your own word: SceneIndex.open({str(path)!r}, root=...), or --root "
            f"with a command. Or move the index into that root."
        )
    if not folder.is_dir():
        raise StorageError(
            f"{path}: its data were at {folder}, which is not a folder now. Move the index into "
            f"the data's root, or run `stereogenbench index` again."
        )
    return str(folder)


_OF_DEPTH: Final = ("key", "depth_unit_m", "depth_unit_source")


def _with_conventions(
    table: pa.Table, head: IndexHead, conventions: Conventions, *, retry: RetryPolicy | None
) -> pa.Table:
    """Return the rows of an index with conventions, which must be those of its scenes.

    Raises:
        StorageError: If the rows were described by other conventions, or files contradict these.
    """
    from stereogenbench_data.index.row_check import compared_with_files
    from stereogenbench_data.sources.members import MemberSource

    texts = [shape.text() for shape in conventions.shapes]
    if {*table.column("conventions").to_pylist()} <= {*texts}:
        return table
    where, shape = shown(head.root), conventions.shapes[0]
    if shape.has:
        raise StorageError(
            f"{where}: which of the {len(texts)} shapes of {conventions.where} a scene has is not "
            f"in its index. Name the conventions where it is made: `stereogenbench index ROOT "
            f"--conventions FILE`, and pack again."
        )
    source = MemberSource(head.root, shards=head.shards, revision=head.digest, retry=retry)
    rows = np.unique(np.linspace(0, table.num_rows - 1, _READ_AGAIN).astype(int))
    for row in rows.tolist():
        scene = replace(scene_of(table.slice(row, 1).to_pylist()[0]), conventions=texts[0])
        videos = [name for name in VIDEO_FILES if scene.held_name(name) in scene.members][:1]
        _, found = compared_with_files(scene, source, videos=videos)
        for name, difference in found[:1]:
            by = f"; so it is by {conventions.where}. Correct the conventions" if name else ""
            raise StorageError(
                f"{where}: {scene.id.key}/{name}: {difference}{by}. If the index is wrong: "
                f"{made_again(where)}"
            )
    replaced: dict[str, Any] = {"conventions": texts[0]}
    encoding = None if shape.depth is None else shape.depth.encoding
    if shape.depth is not None and encoding is not None and encoding.unit_m is not None:
        columns = (table.column(name).to_pylist() for name in _OF_DEPTH)
        for key, units_m, sources in zip(*columns, strict=True):
            for unit_m, source in zip(units_m, sources, strict=True):
                if source not in ("default", "unreadable"):
                    shape.depth.require(unit_m, where=f"{where}: {key}")
        offset_m = encoding.offset_m
        replaced["depth_unit_m"] = [encoding.unit_m] * CAMERA_COUNT
        replaced["depth_unit_source"] = ["conventions"] * CAMERA_COUNT
        replaced["depth_offset_m"] = [offset_m] * CAMERA_COUNT if offset_m else None
    for name, value in replaced.items():
        column = pa.array([value] * table.num_rows, type=SCHEMA.field(name).type)
        table = table.set_column(SCHEMA.get_field_index(name), SCHEMA.field(name), column)
    return table.combine_chunks()


def _stale_message(table: pa.Table, head: IndexHead, *, index_file: Path) -> str:
    """Return how an index differs from its root, and the cure; "" if it does not.

    Folders of the tree that may not be listed are ignored. An index without any of its data is not
    called old.

    Args:
        table: The rows of the index.
        head: What is known besides them; its root is a folder of this machine.
        index_file: Where the index is.
    """
    root, shards = Path(head.root), set(head.shards)
    if shards:
        what, known = "shard", shards
        new = {path.name for path in root.glob("*.tar") if path.name[0] != "."} - shards
        gone = {path for path in shards if not (root / path).exists()}
        cure = (
            "Fetch the index that belongs to these shards, move away what is not of it, or pack "
            "all scenes into an empty folder."
        )
    else:
        from stereogenbench_data.index.tree import SPLITS, search  # slow to import

        members = one_array(table.column("members"))
        first = pc.struct_field(members.values, "path").take(members.offsets[:-1])
        # Folders of scenes may have other names than the scenes' keys.
        known = {path.rpartition("/")[0] for path in first.to_pylist()}
        what, placed = "scene", {*search(root, SPLITS)[0]}
        left_out = head.broken.keys() - head.incomplete.keys()
        added = set() if head.is_part else placed - known - left_out
        new = {key for key in added if _is_finished(root, key)}
        gone = known - placed
        place = "" if index_file.parent == root else f" --out {index_file}"
        cure = f"Run `stereogenbench index {root}{place}`."
        if head.is_part:
            cure = "It is of a part of the folder: make it again."
    found = [
        f"{counted(len(names), what)} {why} "
        f"({', '.join(sorted(names)[:_NAMED])}{', ...' if len(names) > _NAMED else ''})"
        for names, why in (
            (new, "not in the index"),
            (set() if gone == known else gone, "of the index, and not there"),
        )
        if names
    ]
    return (
        f"{index_file}: is older than the folder {root}: {'; '.join(found)}. {cure}"
        if found
        else ""
    )


def _is_finished(root: Path, key: str) -> bool:
    """Return whether a folder is a scene that an index would hold, by its names."""
    from stereogenbench_data.schema.parse import parse_scene_key  # slow to import

    try:
        parse_scene_key(key)
        names = {path.name for path in (root / key).iterdir()}
    except (SchemaError, OSError):
        return False
    return COMPLETE_JSON in names and not names.isdisjoint(VIDEO_FILES)


# Opening a tree without an index.


def _open_tree(
    root: str | Path,
    *,
    wanted: Callable[[SceneId], bool] | None,
    rows: Rows,
    conventions: Conventions | None,
    retry: RetryPolicy | None,
) -> SceneIndex:
    """Return the scenes of a folder or URL in the released layout, without a few broken ones.

    Of a large one some scenes are opened.
    """
    # What describes files takes long to import, and an index needs none of it.
    from stereogenbench_data.index.build import POOL_FROM, find_tree, settle, walk_tree

    with _no_collection():
        tree = find_tree(root, wanted=wanted, if_none="all", conventions=conventions, retry=retry)
        is_large = len(tree.ids) >= (POOL_FROM if tree.remote is None else FEW_REMOTE)
        is_near = tree.remote is None
        is_settled = is_large and rows == "settled" and not (tree.stated and tree.stated.has)
        if is_settled or not is_near:
            tree = tree.listed(by="folders")

    def read() -> SceneIndex:
        if not is_near:
            _require_few(tree)
        # In this process: a script without `if __name__ == "__main__"` could start no others.
        return _of_report(walk_tree(tree, workers=1))

    index = None
    if is_settled:
        settled, opened = settle(tree, videos="all" if is_near else "of one camera")
        index = _open_settled(settled, opened, "read" if is_near else "not read")
    if index is None and is_large:
        tree = tree.listed() if is_near else tree
        index = _cached_or_built(tree, "read", read)
    index = index or read()
    wanted_keys = set(tree.keys)
    index.others = tuple(each for key, each in tree.ids.items() if key not in wanted_keys)
    return index


def _open_settled(
    tree: "Tree", opened: "Mapping[str, Outcome]", baselines: "Baselines"
) -> SceneIndex | None:
    """Return the scenes of a tree of which some were opened; None where all must be."""
    from stereogenbench_data.index.unopened import UnopenedScenes, unopened_report

    def settled() -> SceneIndex | None:
        with _no_collection():
            report = unopened_report(tree, opened, baselines)
            return None if report is None else _of_report(report)

    index = _cached_or_built(tree, "settled" if baselines == "read" else "listed", settled)
    if index is not None:
        index.unopened = UnopenedScenes(tree, opened, baselines=baselines)
        index.has_captions = False
    return index


def _cached_or_built(
    tree: "Tree", name: str, find: Callable[[], SceneIndex | None]
) -> SceneIndex | None:
    """Return the rows of a tree that an earlier opening has kept, or find and keep them."""
    name = f"{name}-{tree.stamp}"
    kept = tree.cache.table(name)
    if kept is not None:
        table, head, tables = kept
        # Without a digest: the user has made no index file.
        head = replace(head, root=str(tree.root), digest="")
        index = SceneIndex(table, head, seek_tables=tables)
        if tree.cache.read("odd", name) == _stamp_of_odd(tree, index):
            return index
    found = find()
    if found is not None and not isinstance(found._seek_tables, Path):
        head = replace(found._head, digest=table_digest(found._table))
        tree.cache.keep_table(name, found._table, head, found._seek_tables)
        tree.cache.keep("odd", name, _stamp_of_odd(tree, found))
    return found


def _stamp_of_odd(tree: "Tree", index: SceneIndex) -> bytes:
    """Return what changes with any file of the scenes that cannot be used, or lack a file."""
    lacking = np.union1d(index.remarked("videos"), index.remarked("poses"))
    odd = {*index.incomplete, *index.broken, *index.column("key")[lacking]}
    return "".join(map(tree.file_stamp, sorted(odd & tree.ids.keys()))).encode()


def _require_few(tree: "Tree") -> None:
    """Refuse to describe many scenes behind a URL each time they are opened."""
    count, where = len(tree.keys), shown(tree.root)
    if count > MOST_REMOTE_SCENES:
        raise StorageError(
            f"{where}: has no {INDEX_NAME}, all its scenes must be opened, and {count} "
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


def _of_report(report: "TreeReport") -> SceneIndex:
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
    if not are_few(len(report.broken), of=len(report.scenes) + len(report.broken)):
        raise StorageError(
            f"{where}: {listed(report.broken)}\nRepair or remove them; or leave them out on "
            f"purpose: `stereogenbench index {where}` makes an index without them."
        )
    return SceneIndex.from_report(report)


def _lacking(index: SceneIndex) -> dict[str, str]:
    """Return the scenes of a tree that lack a file which others have, and why."""
    found: dict[str, str] = {}
    for about in ("videos", "poses"):
        rows = index.remarked(about)
        if 2 * len(rows) < len(index):
            for row in rows.tolist():
                scene = index.indexed_scene(row)
                if about == "videos" or TRAJECTORY_JSON not in scene.members:
                    found.setdefault(scene.id.key, scene.remark(about))
    return found


def _assumed_of(index: SceneIndex) -> str:
    """Return what was taken for granted about the scenes of a tree; "" if nothing."""
    table, unopened = index._table, index.unopened
    told = [_depth_too_far(index)]
    if unopened is not None:
        all_opened = f"`stereogenbench index {index.where}` opens all."
        told = [f"{index.where}: {index.not_opened}. {all_opened}", *told]
        told += [assumptions(unopened.opened[:_LOOKED_AT], where=index.where)]
        return " ".join(filter(None, told))
    is_odd = pc.or_(pc.is_valid(table.column("pose_form")), pc.is_valid(table.column("remarks")))
    scenes = table.filter(is_odd).slice(0, _LOOKED_AT).to_pylist()
    told += [assumptions(map(scene_of, scenes), where=index.where)]
    return " ".join(filter(None, told))


def _depth_too_far(index: SceneIndex) -> str:
    """Return that depth by the release's default unit is farther than stereo shows; "" if not."""
    from stereogenbench_data.index.scene_folder import median_depth_m

    scene = index.indexed_scene(0)
    if is_remote(index.root) or scene.depth_unit_source[0] != "default":
        return ""
    far_m = median_depth_m(index.root, scene)
    if not far_m > _FAR_M:
        return ""
    return (
        f"{index.where}: nothing states the unit of depth, and by the release's default of "
        f"{DEFAULT_DEPTH_UNIT_M:g} m half of the pixels of {scene.id.key} are farther than "
        f"{far_m:,.0f} m. `stereogenbench doctor {index.where}` measures the unit; "
        f"DepthEncoding(unit_m=...), or unit_m below [depth] in a file of conventions, states it."
    )


_FAR_M: Final = 200.0
"""Scenes of stereo are nearer: 6 cm apart, cameras show half a pixel of that at 1,756 px."""


_ASSUMED: Final = ("size", "baselines", "marker", "world", "pixels")
"""Remarks that are told when a tree is opened without conventions."""
_OF_TIME: Final = ("frames", "rate")
"""Remarks that are told whenever a tree is opened."""


_PLAIN: Final = "unreal axes"


def assumptions(scenes: Iterable[Scene], *, where: str) -> str:
    """Return what was taken for granted about scenes and what was measured; "" if nothing."""
    scenes = list(scenes)
    of_time = remarks_told(scenes, _OF_TIME)
    scenes = [scene for scene in scenes if scene.conventions is None]
    forms = Counter(
        (scene.pose_form or _PLAIN).split("|")[0].partition(" @ ")[0]
        for scene in scenes if not scene.remark("world")
    )  # fmt: skip
    told = of_time + remarks_told(scenes, _ASSUMED) + [
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
