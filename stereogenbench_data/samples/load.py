"""One sample: decoded, transformed, written; read and decoded only as far as the fields need."""

import numpy as np

from stereogenbench_data.errors import MediaError, SchemaError, StorageError
from stereogenbench_data.samples.decoder import SampleDecoder
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.request import Clip
from stereogenbench_data.samples.writer import Allocate, SampleWriter, new_array
from stereogenbench_data.selection.plan import Address


class SampleLoader(SampleDecoder):
    """A decoder whose views become samples: flat dicts of numpy arrays and texts."""

    def load(
        self,
        address: Address,
        *,
        clip: Clip,
        seeds: tuple[int, ...] = (0,),
        allocate: Allocate = new_array,
    ) -> Sample:
        """Return one sample.

        Args:
            address: Where it comes from.
            clip: "clip" where the fields have a time axis, else "frame".
            seeds: The seeds of the random numbers that a transform draws.
            allocate: Returns the array that a field is written into; called once for each.

        Raises:
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
            SchemaError: If the trajectory does not follow the format.
        """
        request, scene = self._request, self.scene(address)
        size = request.size or (scene.rig.image_height_px, scene.rig.image_width_px)
        writer = SampleWriter(request, address, clip=clip, allocate=allocate)
        # One frame at a time, or all that a transform treats alike.
        step = 1 if request.transform is None else len(address.frames)
        self.begin(address)
        try:
            for start in range(0, len(address.frames), step):
                frames = slice(start, start + step)
                out = writer.pictures(frames, size=size) if self.decodes_in_place else {}
                views, facts = self.decode(address, frames=frames, out=out)
                if request.transform is not None:
                    views = request.transform(views, np.random.default_rng(seeds))
                writer.write(views, facts, frames)
        except (StorageError, MediaError, SchemaError) as error:
            raise type(error)(f"{scene.id.key}, frames {address.frames}: {error}") from error
        finally:
            self.end(address)
        return {name: writer.sample[name] for name in request.fields}
