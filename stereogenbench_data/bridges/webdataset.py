"""A stage for ``webdataset`` pipelines: from a scene's bytes to stereo samples.

>>> import webdataset  # doctest: +SKIP
>>> from stereogenbench_data.bridges.webdataset import decode
>>> stage = decode(("left", "disparity"), pairs="all", frames="all")
>>> samples = webdataset.WebDataset(urls, shardshuffle=False).compose(stage)  # doctest: +SKIP
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Unpack

from stereogenbench_data.bridges.scene_bytes import SampleOptions, samples_of
from stereogenbench_data.errors import SelectionError, StorageError
from stereogenbench_data.samples.fields import DEFAULT_PAIR_FIELDS, Sample


class SceneDecoder:
    """Turns scenes as ``webdataset`` reads them into samples; see `decode`."""

    def __init__(self, fields: tuple[str, ...], options: SampleOptions) -> None:
        """Keep what the samples shall be."""
        self._fields = fields
        self._options = options
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Draw random frames and transforms anew, in pipelines that start from now on.

        Raises:
            SelectionError: If it is negative.
        """
        if epoch < 0:
            raise SelectionError(f"an epoch is a whole number from 0, got {epoch!r}.")
        self._epoch = epoch

    def __call__(self, scenes: Iterable[Mapping[str, Any]]) -> Iterator[Sample]:
        """Yield the samples of every scene.

        Raises:
            StorageError: If a scene has no key, or lacks a file.
            SchemaError: If a metadata file does not follow the format.
            MediaError: If a video does not decode to what its header says.
        """
        for scene in scenes:
            key = scene.get("__key__")
            if not isinstance(key, str):
                raise StorageError(
                    f"a scene has no __key__ (it has {', '.join(map(str, scene))}): put the stage "
                    "right after the reading of tars."
                )
            for sample in samples_of(
                key, scene, fields=self._fields, epoch=self._epoch, options=self._options
            ):
                if "__url__" in sample and "__url__" in scene:
                    sample["__url__"] = scene["__url__"]
                yield sample


def decode(
    fields: Iterable[str] = DEFAULT_PAIR_FIELDS, **options: Unpack[SampleOptions]
) -> SceneDecoder:
    """Return a stage that turns scenes into samples as `StereoPairs` makes them.

    A whole scene passes through memory and a temporary folder, whatever is asked of it;
    `StereoPairs` and `StereoPairStream` read only what samples need.

    Args:
        fields: Names of the fields wanted.
        **options: pairs, frames, direction, baseline_cm, size, transform, depth, seed, as
            `StereoPairs` takes them. Scenes without a pair of such a baseline give no sample.

    Raises:
        SelectionError: If there is no such option.
    """
    unknown = sorted(set(options) - set(SampleOptions.__annotations__))
    if unknown:
        raise SelectionError(
            f"there is no option {unknown[0]!r}; there are "
            f"{', '.join(SampleOptions.__annotations__)}. Choose scenes before the stage."
        )
    return SceneDecoder(tuple(fields), options)
