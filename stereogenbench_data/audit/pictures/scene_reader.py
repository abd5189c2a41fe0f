"""Reads pictures and maps of one pair and frame, from any thread."""

import threading
from typing import Final, Literal

import numpy as np
from jaxtyping import UInt8

from stereogenbench_data.errors import MediaError, SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth import DEPTH_CURES, NO_DEPTH_UNIT
from stereogenbench_data.samples.fields import Request, Sample
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.filters import require_pairs
from stereogenbench_data.selection.plan import Address

OPEN_VIDEOS: Final = 6
"""How many videos the reading of one set of fields keeps open: those of a scene of one kind."""


class SceneReader:
    """Reads pictures and maps of one pair and one frame at a time.

    Reads of the same fields take turns and share open videos; reads of other fields run in
    parallel. Only the last frame of each open video is kept.
    """

    def __init__(self, index: SceneIndex) -> None:
        """Prepare to read the data of an index; nothing is opened yet."""
        self.index = index
        self._lock = threading.Lock()
        self._loaders: dict[tuple[str, ...], tuple[SampleLoader, threading.Lock, bool]] = {}

    def pair(
        self, row: int, *, pair: tuple[int, int], frame: int, fields: tuple[str, ...]
    ) -> Sample:
        """Return fields (of `PAIR_FIELDS`) of a pair at a frame, as numpy arrays.

        Raises:
            SelectionError: If there is no such pair or frame.
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says, or the unit of depth that
                a field needs is not known.
        """
        left, right = require_pairs([pair])[0]
        return self._read("pairs", fields, Address(row, left, (right,), (frame,)))

    def views(self, row: int, *, frame: int) -> UInt8[np.ndarray, "6 3 h w"]:
        """Return the pictures of all six cameras at a frame; raises as `pair` does."""
        address = Address(row, 0, tuple(range(1, CAMERA_COUNT)), (frame,))
        pictures: UInt8[np.ndarray, "6 3 h w"] = self._read("views", ("image",), address)["image"]
        return pictures

    def close(self) -> None:
        """Close open videos; the reader can be used again."""
        with self._lock:
            loaders = list(self._loaders.values())
        for loader, turn, _ in loaders:
            with turn:
                loader.close()

    def _read(
        self, kind: Literal["pairs", "views"], fields: tuple[str, ...], address: Address
    ) -> Sample:
        scene, frame = self.index.scene(address.row), address.frames[0]
        if not 0 <= frame < scene.frames:
            raise SelectionError(
                f"{scene.id.key} has no frame {frame}: its {scene.frames} are 0 to "
                f"{scene.frames - 1}. Choose one of them."
            )
        with self._lock:
            if fields not in self._loaders:
                layout: Literal["single", "stacked"] = "stacked" if kind == "views" else "single"
                request = Request(kind=kind, fields=fields, layout=layout)
                loader = SampleLoader(self.index, request)
                loader.keep_open(OPEN_VIDEOS)
                needs_depth = not request.streams.isdisjoint({"source_depth", "target_depth"})
                self._loaders[fields] = (loader, threading.Lock(), needs_depth)
            loader, turn, needs_depth = self._loaders[fields]
        encodings = (
            scene.depth_encoding(camera, depth_of(scene))
            for camera in (address.source, *address.targets)
        )
        if needs_depth and any(encoding.unit_m is None for encoding in encodings):
            raise MediaError(
                scene.remark("depth") or f"{scene.id.key}: {NO_DEPTH_UNIT}. {DEPTH_CURES}"
            )
        with turn:
            return loader.load(address, clip="frame")
