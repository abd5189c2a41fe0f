"""One sample: decoded, transformed, written; read and decoded only as far as the fields need."""

import copy
from collections.abc import Iterator
from typing import Literal

import numpy as np

from stereogenbench_data.errors import MediaError, SchemaError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.decoder import SampleDecoder
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.request import Clip, Request
from stereogenbench_data.samples.streams import StreamStats
from stereogenbench_data.samples.writer import Allocate, SampleWriter, new_array
from stereogenbench_data.selection.plan import Address
from stereogenbench_data.sources.cache import ShardCache
from stereogenbench_data.sources.members import MemberSource


class SampleLoader:
    """Loads samples as flat dicts of numpy arrays and texts; open files stay in this process."""

    def __init__(
        self,
        index: SceneIndex,
        request: Request,
        *,
        cache: ShardCache | None = None,
        check: Literal["opened", "metadata"] = "metadata",
        frames: Literal["shared", "used once"] = "shared",
    ) -> None:
        """Prepare to load what is requested from the index's data; nothing is opened yet.

        Args:
            index: The scenes.
            request: What to load of them.
            cache: Where to keep what comes from a URL, or None.
            check: What is compared with its checksum, as `MemberSource` says.
            frames: Whether several samples may show a frame of a camera, which is kept for them.
        """
        self._request = request
        source = MemberSource(
            index.root,
            shards=index.shards,
            revision=index.digest,
            cache=cache,
            check=check,
            retry=index.retry,
        )
        self._decoder = SampleDecoder(index, request, source=source, frames=frames)

    def load(
        self,
        address: Address,
        *,
        clip: Clip,
        generator: np.random.Generator,
        allocate: Allocate = new_array,
    ) -> Sample:
        """Return one sample.

        Args:
            address: Where it comes from.
            clip: "clip" where the fields have a time axis, else "frame".
            generator: The random numbers of the transform.
            allocate: Returns the array that a field is written into; called once for each.

        Raises:
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
            SchemaError: If the trajectory does not follow the format.
        """
        decoder, request = self._decoder, self._request
        scene = decoder.scene(address.row)
        size = request.size or (scene.rig.image_height_px, scene.rig.image_width_px)
        writer = SampleWriter(request, address, clip=clip, allocate=allocate)
        try:
            for frames in self._steps(address):
                out = writer.pictures(frames, size=size) if decoder.decodes_in_place else None
                views, facts = decoder.decode(address, frames=frames, out=out)
                if request.transform is not None:
                    views = request.transform(views, generator)
                writer.write(views, facts, frames)
        except (StorageError, MediaError, SchemaError) as error:
            raise type(error)(f"{scene.id.key}, frames {address.frames}: {error}") from error
        return {name: writer.sample[name] for name in request.fields}

    def _steps(self, address: Address) -> Iterator[slice]:
        """Yield what is decoded at a time: one frame, or all that a transform treats alike."""
        count = len(address.frames)
        step = count if self._request.transform is not None else 1
        for start in range(0, count, step):
            yield slice(start, start + step)

    @property
    def stats(self) -> StreamStats:
        """What this process has open."""
        return self._decoder.stats

    def copy(self) -> "SampleLoader":
        """Return a loader of the same samples with open videos of its own."""
        twin = copy.copy(self)
        twin._decoder = self._decoder.copy()
        return twin

    def keep_open(self, videos: int, *, frames: int = 1) -> None:
        """Keep up to so many videos open, and so many frames of each, as `SampleDecoder` does."""
        self._decoder.keep_open(videos, frames=frames)

    def release(self, address: Address) -> None:
        """Close the videos of a run that has been read to its end."""
        self._decoder.release(address)

    def close(self) -> None:
        """Close the videos that are open in this process."""
        self._decoder.close()
