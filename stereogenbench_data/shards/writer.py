"""One shard on disk, whole or absent: written beside its place, then renamed.

The manifest of a shard, ``OUT/.parts/<shard>.json``, is written just before the rename. A shard
under its final name is finished, and later runs keep it. Source files must be as they were when
the plan was made, and must not change while they are read.
"""

import base64
import hashlib
import io
import json
import os
import shutil
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from io import FileIO
from itertools import groupby
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import MediaError, ShardError, explain_os_errors
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.scene_folder import derived_scene, metadata_differences
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth_packing import packed_depth
from stereogenbench_data.media.seek_table import SeekTable, packed_tables, read_seek_table
from stereogenbench_data.schema.records import Member, Scene
from stereogenbench_data.schema.release import PACKED_DEPTH_NAMES, TRAINING_JSON, VIDEO_FILES
from stereogenbench_data.schema.training import parse_training
from stereogenbench_data.shards.plan import SCENE_TEXTS, PlannedMember, PlannedShard
from stereogenbench_data.shards.tar import (
    BLOCK_BYTES,
    END_OF_ARCHIVE,
    member_header,
    read_chunks,
)
from stereogenbench_data.shards.training import (
    Derivation,
    derive_scene,
    derived_names,
    source_bytes,
)
from stereogenbench_data.sources.files import copy_with_crc32, try_locked, write_atomic
from stereogenbench_data.sources.location import is_remote, shown
from stereogenbench_data.sources.ranged_file import FileSlice

TEMPORARY_SUFFIX: Final = ".tmp"

SEEKABLE: Final = frozenset({*VIDEO_FILES, *PACKED_DEPTH_NAMES.values()})
"""The files of a scene of which single frames are read."""

PARTS: Final = ".parts"
"""The folder beside the shards that holds their manifests and locks."""


@dataclass(frozen=True, slots=True)
class ShardTask:
    """A shard to pack, with all that another process needs for it."""

    shard: PlannedShard
    root: str
    out: str
    plan_digest: str
    derivation: Derivation | None = None

    @property
    def derived(self) -> Path:
        """The folder of its derived files until it is finished."""
        return self.target.parent / PARTS / f"{self.target.stem}.derived"

    @property
    def source_bytes(self) -> int:
        """The size of all files that it is made from."""
        if self.derivation is None:
            return sum(member.size for member in self.shard.members)
        settings = self.derivation.settings
        return sum(source_bytes(each, derived_names(each, settings)) for each in self.shard.scenes)

    @property
    def target(self) -> Path:
        """The path of the shard."""
        return Path(self.out, self.shard.name)

    @property
    def temporary(self) -> Path:
        """The path of the shard until it is finished."""
        return self.target.with_name(self.target.name + TEMPORARY_SUFFIX)

    @property
    def manifest(self) -> Path:
        """The path of its manifest."""
        return self.target.parent / PARTS / f"{self.target.stem}.json"


@dataclass(frozen=True, slots=True)
class ShardManifest:
    """A finished shard: its checksums and its members, in order.

    Attributes:
        plan: The digest of its plan.
        seek_tables: Each scene's key, with its `Scene.seek_tables` as base64.
    """

    name: str
    size: int
    sha256: str
    members: tuple[str, ...]
    offsets: tuple[int, ...]
    sizes: tuple[int, ...]
    crc32s: tuple[int, ...]
    plan: str
    seek_tables: dict[str, str] = field(default_factory=dict)

    @property
    def places(self) -> dict[str, Member]:
        """Where each member lies in the shard, by its whole name."""
        found = zip(self.members, self.offsets, self.sizes, self.crc32s, strict=True)
        return {name: Member(self.name, *place) for name, *place in found}


def open_shards(data: str | Path, root: str | Path | None) -> SceneIndex:
    """Return the index of shards on this machine.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, if the index file is elsewhere.

    Raises:
        StorageError: If there is no index of shards, or it cannot be opened.
    """
    if is_remote(data):
        raise ShardError(f"{shown(data)}: is remote. Download the shards, and pass their folder.")
    path = Path(data)
    if path.is_dir() and not (path / INDEX_NAME).is_file():
        cure = "Pass a folder that `stereogenbench pack` made."
        if (path / PARTS).is_dir():
            cure = "Packing was not finished: run `stereogenbench pack` again."
        raise ShardError(f"{path}: holds no {INDEX_NAME}. {cure}")
    index = SceneIndex.open(path, root=root)
    if not index.shards:
        raise ShardError(
            f"{path}: is the index of a released folder, not of shards. Pack it with "
            f"`stereogenbench pack`, or pass a folder of shards."
        )
    return index


def find_packed(task: ShardTask) -> ShardManifest | None:
    """Return the manifest of a finished shard; None if the shard is not there.

    Raises:
        ShardError: If a file has its name that this plan did not pack, or that was changed since.
    """
    try:
        size = task.target.stat().st_size
    except FileNotFoundError:
        return None
    try:
        found = json.loads(task.manifest.read_bytes())
        for name in ("members", "offsets", "sizes", "crc32s"):
            found[name] = tuple(found[name])
        manifest = ShardManifest(**found)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise not_of_plan(task.target) from error
    if (manifest.plan, manifest.name) != (task.plan_digest, task.shard.name):
        raise not_of_plan(task.target)
    if manifest.size != size:
        raise ShardError(
            f"{task.target}: has {size} bytes, and had {manifest.size} when it was packed. Remove "
            f"it, then run the same command again."
        )
    return manifest


def pack_task(
    task: ShardTask, after_bytes: Advance
) -> tuple[ShardManifest, Literal["packed", "kept"]]:
    """Pack one shard into its folder, unless it is finished; a worker process calls this.

    Raises:
        ShardError: If a source is missing, unreadable, changes meanwhile or contradicts the index;
            the disk is full; another file has its name; or another process is packing it.
    """
    done = find_packed(task)
    if done is not None:
        return done, "kept"
    with _named_errors(task), _open_exclusive(task.temporary) as file:
        done = find_packed(task)
        if done is not None:
            return done, "kept"
        if task.derivation is None:
            return _pack(task, file, after_bytes), "packed"
        derived = _with_derived_files(task, task.derivation, after_bytes)
        # What is copied from now on was counted when it was derived.
        packed = _pack(derived, file, lambda count: after_bytes(0))
        shutil.rmtree(task.derived, ignore_errors=True)
        return packed, "packed"


def derive_task(work: tuple[ShardTask, Scene], after_bytes: Advance) -> None:
    """Derive the files of one scene of a shard, unless they are there; a worker calls this.

    Raises:
        ShardError: As `pack_task` says.
    """
    task, scene = work
    with _named_errors(task):
        _derive(task, scene, after_bytes)


def _named_errors(task: ShardTask) -> AbstractContextManager[None]:
    """Turn errors of the system about a shard into a ShardError that names it."""
    what = f"{task.target}: cannot be written"
    return explain_os_errors(what, "Pack into another folder.", kind=ShardError)


@contextmanager
def _open_exclusive(path: Path) -> Iterator[FileIO]:
    """Open a new, empty shard for this process alone; it is removed unless it was renamed.

    The lock is a file in ``.parts``, which stays. On a file system without locks nothing keeps two
    processes from writing one file; one of them will find it altered or gone.

    Raises:
        ShardError: If another process has it.
    """
    lock = path.parent / PARTS / f"{path.name}.lock"
    lock.parent.mkdir(parents=True, exist_ok=True)
    with try_locked(lock) as is_ours:
        if not is_ours:
            raise ShardError(
                f"{path}: another process is packing this shard. Give each process a part of its "
                f"own (--part I/N), or wait for that one."
            )
        try:
            with FileIO(path, "w+") as file:
                yield file
        finally:
            path.unlink(missing_ok=True)


def _derive(task: ShardTask, scene: Scene, after_bytes: Advance) -> None:
    """Derive the files of a scene, in this process alone."""
    if task.derivation is None:
        return
    folder = task.derived / scene.id.key
    folder.parent.mkdir(parents=True, exist_ok=True)
    with try_locked(folder.with_name(f".{folder.name}.lock")) as is_ours:
        if not is_ours:
            raise ShardError(
                f"{folder}: another process is deriving this scene. Give each process a part of "
                f"its own (--part I/N), or wait for that one."
            )
        derive_scene(task.derivation, scene, folder, advance=after_bytes)


def _with_derived_files(task: ShardTask, derivation: Derivation, after_bytes: Advance) -> ShardTask:
    """Derive the files of a shard's scenes; return the task that packs them as they are."""
    members = []
    for scene in task.shard.scenes:
        key = scene.id.key
        _derive(task, scene, after_bytes)
        members += [
            PlannedMember(
                f"{key}.{name}", f"{key}/{name}", (task.derived / key / name).stat().st_size
            )
            for name in derived_names(scene, derivation.settings)
        ]
    shard = replace(task.shard, members=tuple(members))
    return replace(task, shard=shard, root=str(task.derived))


def _pack(task: ShardTask, file: FileIO, after_bytes: Advance) -> ShardManifest:
    manifest = _write_shard(task, file, after_bytes)
    tables = _seek_tables(task, manifest)
    encoded = {key: base64.b64encode(packed).decode() for key, packed in tables.items()}
    manifest = replace(manifest, seek_tables=encoded)
    write_atomic(task.manifest, json.dumps(asdict(manifest)).encode())
    task.temporary.replace(task.target)
    return manifest


def not_of_plan(path: Path) -> ShardError:
    """Return the error about a file in the folder of shards that this plan did not pack."""
    return ShardError(
        f"{path}: already exists and was not packed by this plan. Move it away, or pack into an "
        f"empty folder."
    )


class _Output:
    """A shard while it is written, with what its manifest lists of each member."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self.sha256 = hashlib.sha256()
        self.size = 0
        self.members: list[tuple[int, int, int]] = []

    def write(self, content: bytes) -> None:
        self.sha256.update(content)
        self.size += len(content)
        left = memoryview(content)
        while left:
            left = left[self._file.write(left) :]

    def end_member(self, size: int, crc32: int) -> None:
        """Pad the member whose last byte was just written, and note its place."""
        self.members.append((self.size - size, size, crc32))
        self.write(bytes(-self.size % BLOCK_BYTES))

    def write_member(self, name: str, content: bytes) -> None:
        self.write(member_header(name, len(content)))
        self.write(content)
        self.end_member(len(content), zlib.crc32(content))


def _write_shard(task: ShardTask, file: FileIO, after_bytes: Advance) -> ShardManifest:
    output = _Output(file)
    scenes = {scene.id.key: scene for scene in task.shard.scenes}
    for key, members in groupby(task.shard.members, key=lambda each: each.name.partition(".")[0]):
        _write_scene(task, members, output, scene=scenes.get(key), after_bytes=after_bytes)
    output.write(END_OF_ARCHIVE)
    os.fsync(file.fileno())
    offsets, sizes, crc32s = zip(*output.members, strict=True)
    return ShardManifest(
        name=task.shard.name,
        size=output.size,
        sha256=output.sha256.hexdigest(),
        members=tuple(member.name for member in task.shard.members),
        offsets=offsets,
        sizes=sizes,
        crc32s=crc32s,
        plan=task.plan_digest,
    )


def _write_scene(
    task: ShardTask,
    members: Iterable[PlannedMember],
    output: _Output,
    *,
    scene: Scene | None,
    after_bytes: Advance,
) -> None:
    """Write a scene's files, whose metadata must be what the index was made from."""
    texts: dict[str, bytes] = {}
    for member in members:
        name = member.name.partition(".")[2]
        chunks = _source_chunks(Path(task.root, member.source), member.size, after_bytes)
        if name in SCENE_TEXTS:
            texts[name] = b"".join(chunks)
            output.write_member(member.name, texts[name])
        elif member.form == "released" or scene is None:
            output.write(member_header(member.name, member.size))
            output.end_member(member.size, copy_with_crc32(chunks, output.write))
        else:
            content = _packed_depth(task, member, frames=scene.frames, after_bytes=after_bytes)
            output.write_member(member.name, content)
    if scene is None or not texts:
        return
    if task.derivation is not None:
        where = f"{scene.id.key}/{TRAINING_JSON}"
        document = parse_training(texts[TRAINING_JSON], where=where)
        scene = replace(derived_scene(scene, document), members={})
    for name, difference in metadata_differences(scene, texts)[:1]:
        raise ShardError(
            f"{Path(task.root, scene.id.key, name)}: {difference}. The index is older than the "
            f"file: run `stereogenbench index` on the release again, then the same command."
        )


def _seek_tables(task: ShardTask, manifest: ShardManifest) -> dict[str, bytes]:
    """Return each scene's `Scene.seek_tables`, from the shard before it has its final name.

    A video that cannot be read has none; whoever reads it is told why.
    """
    tables: dict[str, dict[str, SeekTable]] = {key: {} for key in task.shard.keys}
    for member, place in manifest.places.items():
        key, _, name = member.partition(".")
        if key not in tables or name not in SEEKABLE:
            continue
        with suppress(MediaError), FileSlice(task.temporary, place) as video:
            table = read_seek_table(video, name=name)
            if table is not None:
                tables[key][name] = table
    return {key: packed_tables(found) for key, found in tables.items()}


def _source_chunks(source: Path, size: int, after_bytes: Advance) -> Iterator[bytes]:
    """Yield all bytes of a released file of the planned size.

    Raises:
        ShardError: If it is missing, unreadable, has another size or changes meanwhile.
    """
    cure = "Fetch it again, then run the same command again."
    with explain_os_errors(f"{source}: cannot be read", cure, kind=ShardError):
        if not stat.S_ISREG(source.stat().st_mode):
            raise ShardError(f"{source}: is not a file. Put the release's own file in its place.")
        with FileIO(source) as file:
            before = os.fstat(file.fileno())
            if before.st_size != size:
                raise ShardError(
                    f"{source}: has {before.st_size} bytes, and had {size} when the plan was made. "
                    f"Let nothing write to the release; run `stereogenbench index` again if it has "
                    f"an index."
                )
            yield from read_chunks(file, size, after_bytes=after_bytes)
            after = source.stat()
            found = (after.st_size, after.st_mtime_ns)
            if found != (size, before.st_mtime_ns) or not os.path.samestat(after, before):
                raise ShardError(
                    f"{source}: was changed while it was packed. Let nothing write to the release, "
                    f"then run the same command again."
                )


def _packed_depth(
    task: ShardTask, member: PlannedMember, *, frames: int, after_bytes: Advance
) -> bytes:
    """Return a released depth video as blosc2's frames.

    Raises:
        ShardError: If it cannot be read, or not be packed bit for bit.
    """
    source = Path(task.root, member.source)
    video = io.BytesIO(b"".join(_source_chunks(source, member.size, lambda count: after_bytes(0))))
    try:
        content = packed_depth(video, name=str(source), frames=frames)
    except MediaError as error:
        raise ShardError(str(error)) from error
    after_bytes(member.size)
    return content
