"""A stage for ``webdataset`` pipelines that turns scenes into stereo samples.

>>> import webdataset  # doctest: +SKIP
>>> from stereogenbench_data.bridges.webdataset import decode
>>> stage = decode(("left", "disparity"), pairs="all", frames="all")
>>> samples = webdataset.WebDataset(urls, shardshuffle=False).compose(stage)  # doctest: +SKIP
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Unpack

from stereogenbench_data.bridges.in_memory import SampleOptions, samples_of
from stereogenbench_data.datasets.shared import SharedEpoch
from stereogenbench_data.samples.fields import DEFAULT_PAIR_FIELDS, Sample
from stereogenbench_data.selection.filters import SceneFilters
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import SELECTION_DEFAULTS
from stereogenbench_data.selection.signatures import list_options


class SceneDecoder:
    """Turns the scenes that ``webdataset`` reads into samples; see `decode`."""

    def __init__(self, fields: tuple[str, ...], options: SampleOptions) -> None:
        """Keep the fields and the options of the samples."""
        self._fields = fields
        self._options = options
        self._epoch = SharedEpoch()

    def set_epoch(self, epoch: int) -> None:
        """Draw new random frames and transforms in iterations that start after this call.

        Running workers see it, too.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        self._epoch.set(epoch)

    def __call__(self, scenes: Iterable[Mapping[str, Any]]) -> Iterator[Sample]:
        """Yield the samples of every scene.

        Raises:
            StorageError: If a scene lacks a file.
            SchemaError: If a metadata file does not follow the format.
            MediaError: If a video does not decode to what its header says.
        """
        epoch = self._epoch.value
        for scene in scenes:
            for sample in samples_of(
                scene["__key__"],
                scene,
                fields=self._fields,
                epoch=epoch,
                options=self._options,
            ):
                if "__url__" in sample and "__url__" in scene:
                    sample["__url__"] = scene["__url__"]
                yield sample


@list_options(SELECTION_DEFAULTS, {"seed": 0})
def decode(
    fields: Iterable[str] = DEFAULT_PAIR_FIELDS, **options: Unpack[SampleOptions]
) -> SceneDecoder:
    """Return a stage that turns scenes into the samples of `StereoPairs`.

    Every scene passes whole through memory and a temporary folder. `StereoPairs` and
    `StereoPairStream` read only the bytes that the samples need.

    Args:
        fields: Names of the fields to return.
        **options: pairs, frames, direction, baseline_cm, size, transform, depth, seed, as
            for `StereoPairs`. A scene without a pair within ``baseline_cm`` gives no sample.

    Raises:
        SelectionError: If an option is unknown.
    """
    require_options(decode, options, elsewhere={"an earlier stage": SceneFilters.__annotations__})
    return SceneDecoder(tuple(fields), options)
