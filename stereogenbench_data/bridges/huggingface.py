"""Stereo samples as a Hugging Face ``datasets.IterableDataset``, and the features of raw shards."""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self, Unpack

from stereogenbench_data.bridges.in_memory import Decoder, SampleOptions, columns, to_arrays
from stereogenbench_data.datasets.mapped import Data, StereoPairs
from stereogenbench_data.errors import (
    FieldError,
    SelectionError,
    StorageError,
    needs_extra,
)
from stereogenbench_data.samples.fields import DEFAULT_PAIR_FIELDS, Sample
from stereogenbench_data.samples.transforms import (
    ColorJitter,
    Compose,
    Crop,
    Eraser,
    HorizontalFlip,
    Letterbox,
    RandomCrop,
    Resize,
)
from stereogenbench_data.schema.release import (
    PACKED_DEPTH_NAMES,
    TRAINING_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.selection.plan import SELECTION_DEFAULTS
from stereogenbench_data.selection.signatures import list_options

_DEPTH_NAMES: Final[dict[str, Mapping[str, str]]] = {"mkv": {}, "b2frame": PACKED_DEPTH_NAMES}
"""Suffix of depth members to their names in shards, by released name."""

_library = partial(needs_extra, "Hugging Face datasets", "huggingface")

if TYPE_CHECKING:
    from datasets import Features

    from stereogenbench_data.bridges.huggingface_iterable import SampleIterable


def iterable(data: Data, **options: Any) -> "SampleIterable":
    """Return the samples of `StereoPairs` as an iterable dataset of Hugging Face ``datasets``.

    The dataset has `sample_features` where all samples are of one size. So ``interleave_datasets``,
    ``concatenate_datasets``, ``cast_column`` and ``to_parquet`` keep dtypes: pictures stay uint8.

    Every scene is one shard of the dataset. So ``split_dataset_by_node``, worker processes,
    ``shuffle`` and ``state_dict`` work on scenes. Samples are flat dicts of numpy arrays with the
    dtypes of the table of fields. Do not set a format: ``with_format("numpy")`` and
    ``with_format("torch")`` turn uint8 into int64 and float64 into float32. torch's default
    collate function makes tensors.

    ``shuffle(seed=0, buffer_size=1)`` shuffles the scenes; a larger shuffle buffer holds whole
    samples in memory. The loader of `StereoPairs` mixes scenes without a shuffle buffer, and
    resumes without decoding samples a second time. ``set_epoch`` draws new random frames and
    transforms, also on datasets derived from this one.

    Args:
        data: As for `StereoPairs`.
        **options: As for `StereoPairs`.

    Raises:
        ExtraError: If ``datasets`` is not installed.
        StereoGenBenchError: As `StereoPairs` does.
    """
    with _library():
        from stereogenbench_data.bridges.huggingface_iterable import SampleIterable
    pairs = StereoPairs(data, **options)
    return SampleIterable.of(pairs, _features_of(pairs))


def sample_features(pairs: StereoPairs) -> "Features":
    """Return the features of the samples of a dataset, for ``map(decode(...), features=...)``.

    A field of two to five axes is an ``Array2D`` to ``Array5D`` of its dtype, one of one axis a
    ``List`` of fixed length.

    Args:
        pairs: The dataset; it is not read.

    Raises:
        FieldError: If its samples differ in size, or a transform is not one of this package's.
        ExtraError: If ``datasets`` is not installed.
    """
    features = _features_of(pairs)
    if features is None:
        raise FieldError(
            f"{pairs!r}: samples have no fixed features: their pictures or their number of views "
            "differ, or a transform may change the size. Give size=(height, width), or end the "
            "transform with Resize, Letterbox, Crop or RandomCrop."
        )
    return features


def _features_of(pairs: StereoPairs) -> "Features | None":
    """Return the features of samples, None where they differ or cannot be foreseen."""
    with _library():
        from datasets import Features
    request = pairs.request
    size, targets = _size_of(pairs), set((pairs.plan.pairs.targets >= 0).sum(axis=1).tolist())
    is_stacked = request.layout == "stacked"
    if size is None or (is_stacked and len(targets) > 1):
        return None
    frames = pairs.plan.windows.window(0, frames=int(pairs.plan.frame_counts[0]), draw=(0,))
    features: dict[str, Any] = {}
    for name in request.fields:
        known = request.known[name]
        sides = {"H": size[0], "W": size[1]}
        shape = [
            sides.get(word) or int(word) for word in known.shape.strip("()").split(",") if word
        ]
        if known.per_frame and pairs.plan.windows.is_clip:
            shape = [len(frames), *shape]
        if known.per_target and is_stacked:
            shape = [*targets, *shape]
        features[name] = _feature("string" if known.dtype == "str" else known.dtype, tuple(shape))
    return Features(features)


def _size_of(pairs: StereoPairs) -> tuple[int, int] | None:
    """Return (height, width) of all samples, None where they differ or cannot be foreseen."""
    rows, column = pairs.plan.scene_rows, pairs.index.column
    stored = set(
        zip(
            column("image_height_px")[rows].tolist(),
            column("image_width_px")[rows].tolist(),
            strict=True,
        )
    )
    size = pairs.request.size or (stored.pop() if len(stored) == 1 else None)
    transform = pairs.request.transform
    for step in transform.steps() if isinstance(transform, Compose) else [transform]:
        if isinstance(step, Resize | Letterbox | Crop | RandomCrop):
            size = (step.height, step.width)
        elif step is not None and not isinstance(step, ColorJitter | Eraser | HorizontalFlip):
            size = None
    return size


def _feature(dtype: str, shape: tuple[int, ...]) -> Any:
    """Return the feature of a field."""
    import datasets

    if len(shape) < 2:
        value = datasets.Value(dtype)
        return datasets.List(value, length=shape[0]) if shape else value
    return getattr(datasets, f"Array{len(shape)}D")(shape=shape, dtype=dtype)


def features(*, depth_suffix: str = "mkv") -> "Features":
    """Return the features of raw shards, for ``load_dataset("webdataset", features=...)``.

    Without them, ``datasets`` infers features from the first scenes, decodes videos to 8 bits,
    which destroys depth, and reduces the precision of numbers in JSON. With them, a row has every
    file of a scene: JSON parsed, other files as bytes.

    Args:
        depth_suffix: The suffix of depth members: "mkv" as released, "b2frame" in shards packed
            with ``--depth-codec blosc2`` and in training shards; a row then also has
            ``training.json``, None in the former.

    Raises:
        SelectionError: If ``depth_suffix`` is neither.
        ExtraError: If ``datasets`` is not installed.
    """
    names = _DEPTH_NAMES.get(depth_suffix)
    if names is None:
        raise SelectionError(
            f"depth_suffix must be {' or '.join(map(repr, _DEPTH_NAMES))}, got {depth_suffix!r}."
        )
    with _library():
        from datasets import Features, Json, Value
    kinds = columns((names.get(name, name) for name in VIDEO_FILES), of_training=bool(names))
    return Features(
        {name: Json() if kind == "json" else Value(kind) for name, kind in kinds.items()}
    )


class RowDecoder(Decoder):
    """Turns rows of raw shards into samples; see `decode`.

    ``set_epoch`` is seen by datasets that hold this function.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return this one: ``datasets`` copies functions where it concatenates or interleaves."""
        return self

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Return the sample of a row; of rows in columns, as ``batched=True`` gives, all samples.

        Raises:
            SelectionError: If a single row gives another number of samples than one.
            StorageError: If a scene lacks a file.
            SchemaError: If a metadata file does not follow the format.
            MediaError: If a video does not decode to what its header says.
        """
        if isinstance(row["__key__"], str):
            samples = self._samples(row)
            if len(samples) != 1:
                raise SelectionError(
                    f"{row['__key__']}: the scene gives {len(samples)} samples, but map takes one "
                    "per row. Pass batched=True, batch_size=1."
                )
            return samples[0]
        rows = [dict(zip(row, values, strict=True)) for values in zip(*row.values(), strict=True)]
        found = [sample for each in rows for sample in self._samples(each)]
        return {name: [sample[name] for sample in found] for name in self._fields}

    def _samples(self, row: dict[str, Any]) -> list[Sample]:
        absent = [name for name in VIDEO_FILES if name in row and row[name] is None]
        if absent and row.get(TRAINING_JSON) is None:
            raise StorageError(
                f"{row['__key__']}: the shard has no {', '.join(absent)}. If it was packed with "
                '--depth-codec blosc2, read it with features(depth_suffix="b2frame").'
            )
        found = self._samples_of(row["__key__"], row, epoch=self._epoch.value)
        return [to_arrays(sample) for sample in found]


@list_options(SELECTION_DEFAULTS, {"seed": 0})
def decode(
    fields: Iterable[str] = DEFAULT_PAIR_FIELDS, **options: Unpack[SampleOptions]
) -> RowDecoder:
    """Return a function for ``map`` that turns rows of raw shards into samples.

    If every scene gives one sample, use ``dataset.map(decode(...), remove_columns=...)``. If a
    scene gives several, use ``map(..., batched=True, batch_size=1)``. All samples of a scene are
    then in memory at once, so prefer `iterable` for many frames or pairs.

    Random frames and transforms are those of epoch 0 until its ``set_epoch`` is called; that of the
    dataset does not reach a function. What ``map`` has stored of a ``Dataset`` does not change.

    Args:
        fields: Names of the fields to return.
        **options: pairs, frames, direction, baseline_cm, size, transform, depth, seed, as
            for `StereoPairs`.
    """
    return RowDecoder(tuple(fields), options)
