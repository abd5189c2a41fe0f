"""A scene that another library has read into memory, as the samples of `StereoPairs`.

The files are laid out in a temporary folder as they were released, and read as any scene is: with
the same checks, the same errors and the same samples.
"""

import json
import shutil
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypedDict

from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.errors import SelectionError, StorageError
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import METADATA_FILES, PACKED_DEPTH_NAMES, VIDEO_FILES
from stereogenbench_data.selection.pairs import PairsSpec
from stereogenbench_data.selection.windows import FramesSpec

VIDEOS: Final = (*VIDEO_FILES, *PACKED_DEPTH_NAMES.values())
FILES: Final = (*METADATA_FILES, *VIDEOS)


class SampleOptions(TypedDict, total=False):
    """What `StereoPairs` takes beside data and fields, but for the filters on scenes."""

    pairs: PairsSpec
    frames: FramesSpec
    direction: Any
    baseline_cm: Any
    size: tuple[int, int] | None
    transform: Any
    depth: Any
    seed: int


def samples_of(
    key: str,
    files: Mapping[str, Any],
    *,
    fields: tuple[str, ...],
    epoch: int,
    options: SampleOptions,
) -> Iterator[Sample]:
    """Yield the samples of one scene; none where no pair of it has a baseline asked for.

    Args:
        key: The scene's key: its path.
        files: Name to content, as bytes; other names are ignored. JSON that was parsed and text
            that was decoded on the way are taken too.
        fields: Names of the fields wanted.
        epoch: For what is drawn at random.
        options: What the samples shall be.

    Raises:
        StorageError: If a file is missing, or the content of a video is not bytes.
        SchemaError: If the key or a metadata file does not follow the format.
        MediaError: If a video does not decode to what its header says.
        SelectionError: If a pair or frame does not exist.
    """
    parse_scene_key(key)
    with tempfile.TemporaryDirectory(prefix="stereogenbench-") as root:
        folder = Path(root, key)
        folder.mkdir(parents=True)
        _lay_out(key, files, folder)
        index = SceneIndex.from_scenes([describe_scene(root, key)], root)
        drawn: dict[str, Any] = dict(options) | {"seed": _seed(options.get("seed", 0), key)}
        try:
            pairs = StereoPairs(index, fields=fields, **drawn)
        except SelectionError:
            if options.get("baseline_cm") is None:
                raise
            return
        pairs.set_epoch(epoch)
        try:
            for number in range(len(pairs)):
                yield pairs[number]
        finally:
            pairs.close()


def _seed(seed: int, key: str) -> int:
    """Return a seed of the scene's own, so that scenes do not all draw the same numbers."""
    return (seed << 32 | zlib.crc32(key.encode())) % 2**63


def _lay_out(key: str, files: Mapping[str, Any], folder: Path) -> None:
    needed = shutil.disk_usage(folder)
    total = 0
    for name in FILES:
        if files.get(name) is None:
            continue
        content = _bytes(key, name, files[name])
        total += len(content)
        if total > needed.free:
            raise StorageError(
                f"{folder}: has room for {needed.free} bytes, and the files of {key} need more. "
                "Set TMPDIR to a larger place."
            )
        (folder / name).write_bytes(content)


def _bytes(key: str, name: str, content: Any) -> bytes:
    if isinstance(content, bytes):
        return content
    if isinstance(content, str):
        return content.encode()
    if name in VIDEOS:
        inner = content.get("bytes") if isinstance(content, dict) else None
        if isinstance(inner, bytes):
            return inner
        raise StorageError(
            f"{key}: {name} is a {type(content).__name__} and not bytes: a decoder took it before. "
            "Read the shards without decoding (webdataset: no .decode(); datasets: features())."
        )
    if isinstance(content, dict):
        return json.dumps(content).encode()
    raise StorageError(f"{key}: {name} is a {type(content).__name__}, and must be bytes.")
