"""What every export to files shares: its folder, the scenes that go into it, and its processes.

    OUT/export.json     the settings that all of OUT was written with; others are refused
    OUT/.export.lock    locked by the process that writes

The lock is taken before the settings are read or written. So of two exports that begin at once, one
is refused, and neither writes into the work of the other.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import av

from stereogenbench_data.engine import LOCAL, Advance, Progress, advance_of
from stereogenbench_data.errors import (
    MediaError,
    SelectionError,
    StorageError,
    describe_os_error,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes
from stereogenbench_data.sources.files import try_locked, write_atomic

Work = TypeVar("Work")

EXPORT_JSON: Final = "export.json"
_LOCK: Final = ".export.lock"


def scene_filters(selection: Mapping[str, Any]) -> SceneFilters:
    """Return the filters on scenes among the options of a selection."""
    names = SceneFilters.__annotations__
    return cast("SceneFilters", {name: selection[name] for name in names if name in selection})


def training_selection(
    index: SceneIndex, selection: Mapping[str, Any]
) -> tuple[dict[str, Any], int]:
    """Return a selection without evaluation scenes, and how many were left out.

    A selection whose ``split`` is given stays as it is: a model that was trained on evaluation
    scenes cannot be evaluated on them, so they are taken only if they are asked for.

    Raises:
        SelectionError: If no scene matches, or only evaluation scenes do.
    """
    if selection.get("split") is not None:
        return dict(selection), 0
    rows = filter_scenes(index, scene_filters(selection))
    evaluation = int((index.column("split")[rows] == "eval").sum())
    if evaluation == len(rows):
        raise SelectionError(
            f"{index.where}: only evaluation scenes ({evaluation}) match, and training data are "
            "made of these only if you say so: split='eval', on the command line --split eval."
        )
    return {**selection, "split": "train"}, evaluation


@contextmanager
def export_folder(root: Path, settings: Mapping[str, Any]) -> Iterator[None]:
    """Hold a folder for one export while the block runs.

    Args:
        root: A new or empty folder, or one of an export with the same settings.
        settings: What all of the folder has in common, as JSON holds it.

    Raises:
        StorageError: If the folder holds something else, another process exports into it, or it
            cannot be written.
    """
    lock, stated = root / _LOCK, root / EXPORT_JSON
    with named_errors(root):
        root.mkdir(parents=True, exist_ok=True)
        names = {each.name for each in root.iterdir()}
        if names and not names & {_LOCK, EXPORT_JSON}:
            raise StorageError(f"{root}: is not empty and holds no export: choose a new folder.")
        with try_locked(lock) as is_ours:
            if not is_ours:
                raise StorageError(
                    f"{root}: another process exports into this folder. Wait for it, or choose "
                    "another folder."
                )
            if stated.exists():
                _require_same(stated, settings)
            else:
                write_atomic(stated, json_bytes(settings))
            yield


def _require_same(stated: Path, settings: Mapping[str, Any]) -> None:
    there = read_json(stated)
    for name, wanted in json.loads(json_bytes(settings)).items():
        if there.get(name) != wanted:
            raise StorageError(
                f"{stated.parent}: holds an export of other {name}: {there.get(name)!r}, where "
                f"{wanted!r} is asked for. Choose another folder, or remove it."
            )


@contextmanager
def named_errors(place: Path) -> Iterator[None]:
    """Turn errors of the operating system into a `StorageError` that names the place."""
    try:
        yield
    except (OSError, av.FFmpegError) as error:
        # PyAV says only that writing to the file object failed; why is what it came upon.
        cause = error if isinstance(error, OSError) else error.__context__
        if isinstance(error, StorageError):
            raise
        if not isinstance(cause, OSError):
            raise MediaError(f"{place}: cannot be encoded ({error}).") from error
        what = f"{cause.filename or place}: cannot be written"
        raise StorageError(describe_os_error(what, cause, "Choose another folder.")) from error


def json_bytes(value: object) -> bytes:
    """Return a value as the JSON files of exports hold it."""
    return (json.dumps(value, ensure_ascii=False, indent=1) + "\n").encode()


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file of an export.

    Raises:
        StorageError: If it is not a JSON object.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise StorageError(f"{path}: is not JSON ({error}). Remove it.") from error
    if not isinstance(found, dict):
        raise StorageError(f"{path}: is not a JSON object. Remove it.")
    return found


def alone(index: SceneIndex, row: int) -> SceneIndex:
    """Return an index of one scene, small enough to be sent to a process with its work."""
    scene = index.scene(row)
    return SceneIndex.from_scenes([scene], index.root, shards=index.shards, retry=index.retry)


def write_all(  # noqa: PLR0913 - what to do, how, and what is told of it
    write: Callable[[Work, Advance], None],
    works: Sequence[Work],
    *,
    name: Callable[[Work], str],
    workers: int | None,
    progress: Progress | None,
    done: int,
    total: int,
) -> None:
    """Write every piece of an export, in this process or in several.

    Args:
        write: Writes one piece, whole or not at all.
        works: What is still to be written; it can be pickled.
        name: Returns what errors call a piece.
        workers: How many processes, None for one a core.
        progress: Called with (done, total).
        done: How much was there before.
        total: How much there is in all.
    """
    advance = advance_of(progress, done=done, total=total)
    advance(0)
    with closing(LOCAL.map(write, works, name=name, workers=workers, advance=advance)) as written:
        for _ in written:
            advance(0)
