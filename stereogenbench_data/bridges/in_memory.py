"""Samples from a scene whose files another library holds in memory, and samples as numpy arrays.

The files are written to a temporary folder in the released layout and read from there. So checks,
errors and samples are those of `StereoPairs`.
"""

import json
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final, TypedDict

from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.datasets.shared import SharedEpoch
from stereogenbench_data.errors import SelectionError, StorageError, explain_os_errors
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import (
    DESCRIPTION_TXT,
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    TRAINING_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.selection.filters import PairsSpec
from stereogenbench_data.selection.plan import FramesSpec

_VIDEOS: Final = (*VIDEO_FILES, *PACKED_DEPTH_NAMES.values())
_FILES: Final = (*METADATA_FILES, TRAINING_JSON, *_VIDEOS)


def columns(videos: Iterable[str], *, of_training: bool) -> dict[str, str]:
    """Return the columns of raw shards as `datasets` reads them, each with its kind."""
    kinds = {name: "string" if name == DESCRIPTION_TXT else "json" for name in METADATA_FILES}
    kinds |= {TRAINING_JSON: "json"} if of_training else {}
    return kinds | dict.fromkeys(videos, "binary") | {"__key__": "string", "__url__": "string"}


class SampleOptions(TypedDict, total=False):
    """The options of `StereoPairs`, except data, fields and the filters on scenes."""

    pairs: PairsSpec
    frames: FramesSpec
    direction: Any
    baseline_cm: Any
    size: tuple[int, int] | None
    transform: Any
    depth: Any
    seed: int


class Decoder:
    """Turns scenes whose files are in memory into samples."""

    def __init__(self, fields: tuple[str, ...], options: SampleOptions) -> None:
        """Keep the fields and the options of the samples."""
        self._fields, self._options, self._epoch = fields, options, SharedEpoch()

    def set_epoch(self, epoch: int) -> None:
        """Draw new random frames and transforms from now on; running workers see it, too.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        self._epoch.set(epoch)

    def _samples_of(self, key: str, files: Mapping[str, Any], *, epoch: int) -> Iterator[Sample]:
        """Yield the samples of one scene; none if no pair's baseline is within ``baseline_cm``.

        Args:
            key: The scene's key: its path.
            files: File name to content in bytes; parsed JSON and decoded text are accepted too.
                Unknown names are ignored.
            epoch: Seeds random frames and transforms, with the seed.

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
            _write_files(key, files, folder)
            index = SceneIndex.from_scenes([describe_scene(root, key)], root)
            # Scenes draw different random numbers.
            seed = (self._options.get("seed", 0) << 32 | zlib.crc32(key.encode())) % 2**63
            seeded: dict[str, Any] = dict(self._options) | {"seed": seed}
            try:
                pairs = StereoPairs(index, fields=self._fields, **seeded)
            except SelectionError:
                if self._options.get("baseline_cm") is None:
                    raise
                return
            pairs.set_epoch(epoch)
            with closing(pairs):
                for number in range(len(pairs)):
                    yield pairs[number]


def _write_files(key: str, files: Mapping[str, Any], folder: Path) -> None:
    contents = {
        name: _bytes(key, name, files[name]) for name in _FILES if files.get(name) is not None
    }
    with explain_os_errors(
        f"{folder}: the files of {key} cannot be written",
        "Set TMPDIR to a folder on a larger disk.",
    ):
        for name, content in contents.items():
            (folder / name).write_bytes(content)


def _bytes(key: str, name: str, content: Any) -> bytes:
    if isinstance(content, bytes):
        return content
    if isinstance(content, str):
        return content.encode()
    if isinstance(content, dict):
        if name not in _VIDEOS:
            return json.dumps(content).encode()
        if isinstance(content.get("bytes"), bytes):
            return bytes(content["bytes"])
    raise StorageError(
        f"{key}: {name} must be bytes, found {type(content).__name__}: it is already decoded. "
        "Read the shards without decoding (webdataset: no .decode(); datasets: features())."
    )


def to_arrays(sample: Sample) -> Sample:
    """Return a sample with numpy arrays of the same dtypes instead of tensors; texts stay."""
    return {
        name: value if isinstance(value, str) else value.numpy() for name, value in sample.items()
    }
