"""Work that goes into a folder item by item, and goes on where a stopped run ended.

    FOLDER/export.json      the settings that all of the folder was made with; others are refused
    FOLDER/.export.lock     locked by the process that works on the folder
    FOLDER/...              items; each appears whole or not at all

The lock is taken before the settings are read or written. So of two runs that begin at once, one is
refused, and neither writes into the work of the other. Clips, views, inputs of methods and scores
are such work; its items are written on one engine or another (`engine`). Synthetic scenes go into
one tree from many requests, so each part of a request has a lock of its own there (`synthesis`).
"""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypedDict, TypeVar

import av

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import (
    MediaError,
    StereoGenBenchError,
    StorageError,
    describe_os_error,
)
from stereogenbench_data.sources.files import try_locked, write_atomic

Work = TypeVar("Work")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class JobKind:
    """What files and messages call the work in a folder.

    Attributes:
        noun: What a folder holds, for messages: "an export".
        settings: The file of the settings.
        lock: The file that the working process locks.
        error: What a folder of other work raises.
    """

    noun: str
    settings: str
    lock: str
    error: type[StereoGenBenchError] = StorageError


EXPORT: Final = JobKind("an export", "export.json", ".export.lock")


@contextmanager
def job_folder(
    root: Path, settings: Mapping[str, Any], *, kind: JobKind = EXPORT
) -> Iterator[None]:
    """Hold a folder for one run while the block lasts.

    Args:
        root: A new or empty folder, or one of a run with the same settings. A run that ended before
            its first item leaves a folder that others may take.
        settings: All that the items depend on, as JSON holds it.
        kind: What the work is called.

    Raises:
        StorageError: If another process works on the folder, or it cannot be written.
        StereoGenBenchError: The kind's own error, if the folder holds something else, naming the
            first setting that differs.
    """
    stated = root / kind.settings

    def refuse_other_work() -> None:
        if not stated.exists() and _has_items(root, kind):
            raise kind.error(
                f"{root}: is not empty and holds no {kind.settings}: choose a new folder."
            )

    with ExitStack() as held:
        with named_errors(root):
            root.mkdir(parents=True, exist_ok=True)
            # Nothing is left behind in a folder of something else. A job writes its lock first:
            # where its files are seen, so is the lock.
            if not (root / kind.lock).exists():
                refuse_other_work()
            if not held.enter_context(try_locked(root / kind.lock)):
                raise StorageError(
                    f"{root}: another process works on this folder. Wait for it, or choose another "
                    "folder."
                )
            refuse_other_work()
            if stated.exists() and _has_items(root, kind):
                asked = json.loads(json_bytes(settings))
                for name, theirs, ours in differing(read_json(stated), asked):
                    raise kind.error(
                        f"{root}: holds {kind.noun} of other {name}: {theirs!r}, where {ours!r} is "
                        f"asked for. Choose another folder, or remove it."
                    )
            else:
                write_atomic(stated, json_bytes(settings))
        yield


def _has_items(root: Path, kind: JobKind) -> bool:
    """Return whether a folder holds any file but those of the job itself."""
    own = {root / kind.settings, root / kind.lock}
    return any(path not in own and not path.is_dir() for path in root.rglob("*"))


def differing(theirs: Any, ours: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the name of each setting that differs, with both values; None where it is not there."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in dict.fromkeys([*ours, *theirs]):
            inner = f"{name}.{key}" if name else key
            yield from differing(theirs.get(key), ours.get(key), inner)
    elif theirs != ours:
        yield name, theirs, ours


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder to write into, which takes its place when the block ends well.

    Only the process that holds the job's folder may do so: the place beside it is always the same,
    so that the next run removes what a killed one left.
    """
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        yield unfinished
        unfinished.replace(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


@contextmanager
def named_errors(place: Path) -> Iterator[None]:
    """Turn errors of the operating system into a `StorageError` that names the place."""
    try:
        yield
    except (OSError, av.FFmpegError) as error:
        # PyAV says only that writing to the file object failed; why is what it came upon.
        cause = error if isinstance(error, OSError) else error.__context__
        if isinstance(error, StereoGenBenchError):
            raise
        if not isinstance(cause, OSError):
            raise MediaError(f"{place}: cannot be encoded ({error}).") from error
        what = f"{cause.filename or place}: cannot be written"
        raise StorageError(describe_os_error(what, cause, "Choose another folder.")) from error


def json_bytes(value: object) -> bytes:
    """Return a value as the JSON files of jobs hold it."""
    return (json.dumps(value, ensure_ascii=False, indent=1) + "\n").encode()


def read_json(path: Path, *, cure: str = "Remove it.") -> dict[str, Any]:
    """Return the object in a JSON file of a job.

    Raises:
        StorageError: If it is not a JSON object.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise StorageError(f"{path}: is not JSON ({error}). {cure}") from error
    if not isinstance(found, dict):
        raise StorageError(f"{path}: is not a JSON object. {cure}")
    return found


class WorkOptions(TypedDict, total=False):
    """How the items of a job are done; the result does not depend on it.

    Attributes:
        workers: How many processes, None for one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called with how much is done by now, and how much there is.
    """

    workers: int | None
    engine: Engine
    progress: Progress | None


WORK_DEFAULTS: Final = WorkOptions(workers=None, engine=LOCAL, progress=None)


def do_items(  # noqa: PLR0913 - what to do, how, and what is told of it
    task: Callable[[Work, Advance], Result],
    works: Sequence[Work],
    *,
    name: Callable[[Work], str],
    keep: Callable[[Result], object] = lambda result: None,
    options: WorkOptions,
    done: int = 0,
    total: int,
) -> None:
    """Do a task for every item that is still missing.

    Args:
        task: Does one item, whole or not at all.
        works: What is still to be done; it can be pickled.
        name: Returns what errors call an item.
        keep: Called in this process with each result as it comes.
        options: How they are done.
        done: How much was there before.
        total: How much there is in all.
    """
    advance = advance_of(options.get("progress"), done=done, total=total)
    advance(0)
    engine, workers = options.get("engine", WORK_DEFAULTS["engine"]), options.get("workers")
    made = engine.map(task, works, name=name, workers=workers, advance=advance)
    with closing(made) as results:
        for result in results:
            keep(result)
            advance(0)
    advance(total)  # never more than all is reported
