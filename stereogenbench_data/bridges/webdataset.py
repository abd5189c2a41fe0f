"""A stage for ``webdataset`` pipelines that turns scenes into stereo samples.

>>> import webdataset  # doctest: +SKIP
>>> from stereogenbench_data.bridges.webdataset import decode
>>> stage = decode(("left", "disparity"), pairs="all", frames="all")
>>> samples = webdataset.WebDataset(urls, shardshuffle=False).compose(stage)  # doctest: +SKIP
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Unpack

from stereogenbench_data.bridges.in_memory import Decoder, SampleOptions
from stereogenbench_data.samples.fields import DEFAULT_PAIR_FIELDS, Sample
from stereogenbench_data.selection.filters import SceneFilters
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import SELECTION_DEFAULTS
from stereogenbench_data.selection.signatures import list_options


class SceneDecoder(Decoder):
    """Turns the scenes that ``webdataset`` reads into samples; see `decode`.

    ``set_epoch`` is for iterations that start after it.
    """

    def __call__(self, scenes: Iterable[Mapping[str, Any]]) -> Iterator[Sample]:
        """Yield the samples of every scene.

        Raises:
            StorageError: If a scene lacks a file.
            SchemaError: If a metadata file does not follow the format.
            MediaError: If a video does not decode to what its header says.
        """
        epoch = self._epoch.value
        for scene in scenes:
            for sample in self._samples_of(scene["__key__"], scene, epoch=epoch):
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
