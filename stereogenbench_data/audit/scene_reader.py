"""What pictures of a scene are made from: read for one pair and frame, from any thread."""

import threading
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import UInt8

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.samples.request import Request
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.pairs import require_pairs
from stereogenbench_data.selection.plan import Address
from stereogenbench_data.sources.cache import ShardCache

OPEN_VIDEOS: Final = 6
"""How many videos each kind of reading keeps open: a scene's, of one kind."""

_CAMERAS: Final = tuple(range(CAMERA_COUNT))


class SceneReader:
    """Reads pictures and maps of one pair and one frame at a time.

    Readings of the same fields take turns and share open videos; readings of others go on beside
    them. Nothing but the last frame of each open video is kept.
    """

    def __init__(
        self,
        index: SceneIndex,
        *,
        depth: DepthEncoding | None = None,
        cache: ShardCache | None = None,
    ) -> None:
        """Prepare to read; nothing is opened yet.

        Args:
            index: Of the data.
            depth: A depth contract instead of the one that files and release state.
            cache: Where to keep what comes from a URL, or None.
        """
        self.index = index
        self.depth = depth
        self._cache = cache
        self._lock = threading.Lock()
        self._loaders: dict[tuple[str, ...], tuple[SampleLoader, threading.Lock]] = {}

    def pair(
        self, row: int, *, pair: tuple[int, int], frame: int, fields: tuple[str, ...]
    ) -> Sample:
        """Return fields (of `PAIR_FIELDS`) of a pair at a frame, as numpy arrays.

        Raises:
            SelectionError: If there is no such pair or frame.
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
        """
        left, right = require_pairs([pair])[0]
        return self._read("pairs", fields, Address(row, left, (right,), (frame,)))

    def views(self, row: int, *, frame: int) -> UInt8[np.ndarray, "6 3 h w"]:
        """Return the pictures of all six cameras at a frame.

        Raises:
            SelectionError: If there is no such frame.
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
        """
        address = Address(row, _CAMERAS[0], _CAMERAS[1:], (frame,))
        pictures: UInt8[np.ndarray, "6 3 h w"] = self._read("views", ("image",), address)["image"]
        return pictures

    def close(self) -> None:
        """Close what is open; the reader can be used again."""
        with self._lock:
            loaders = list(self._loaders.values())
        for loader, turn in loaders:
            with turn:
                loader.close()

    def _read(
        self, kind: Literal["pairs", "views"], fields: tuple[str, ...], address: Address
    ) -> Sample:
        require_frame(self.index.scene(address.row), address.frames[0])
        with self._lock:
            if fields not in self._loaders:
                self._loaders[fields] = (self._loader(kind, fields), threading.Lock())
            loader, turn = self._loaders[fields]
        with turn:
            return loader.load(address, clip="frame", generator=np.random.default_rng(0))

    def _loader(self, kind: Any, fields: tuple[str, ...]) -> SampleLoader:
        layout: Literal["single", "stacked"] = "stacked" if kind == "views" else "single"
        request = Request(kind=kind, fields=fields, layout=layout, depth=self.depth)
        loader = SampleLoader(self.index, request, cache=self._cache)
        loader.keep_open(OPEN_VIDEOS)
        return loader


def require_frame(scene: Scene, frame: int) -> None:
    """Raise SelectionError unless a scene has a frame."""
    if not 0 <= frame < scene.frames:
        raise SelectionError(
            f"{scene.id.key} has no frame {frame}: its {scene.frames} are 0 to {scene.frames - 1}."
        )
