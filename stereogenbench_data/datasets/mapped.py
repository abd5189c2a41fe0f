"""Map-style datasets: a sample by its number, for torch's own `DataLoader`."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Unpack

import numpy as np
import torch
from torch.utils.data import Dataset

from stereogenbench_data.datasets.tensors import to_tensors
from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.samples.fields import (
    DEFAULT_PAIR_FIELDS,
    DEFAULT_VIEW_FIELDS,
    PAIR_FIELDS,
    VIEW_FIELDS,
    require_fields,
)
from stereogenbench_data.samples.load import (
    Request,
    Sample,
    SampleLoader,
    Transform,
    require_whole_depth,
)
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.filters import SceneFilters
from stereogenbench_data.selection.plan import Plan, Selection, plan_pairs, plan_views
from stereogenbench_data.selection.windows import FramesSpec
from stereogenbench_data.storage.index import SceneIndex

LARGEST_SIDE_PX: Final = 16384

Data = str | Path | SceneIndex


class _MappedScenes(Dataset[Sample]):
    """Samples of a plan by number, loaded in whatever process asks."""

    def __init__(self, index: SceneIndex, plan: Plan, request: Request) -> None:
        require_whole_depth(index, plan, request)
        self.index = index
        self.plan = plan
        self._loader = SampleLoader(index, request)
        # A shared tensor, because workers that persist over epochs hold copies of the dataset.
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # type: ignore[no-untyped-call]

    @property
    def epoch(self) -> int:
        """The epoch that random frames and transforms are drawn for."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Draw random frames and transforms anew, in this process and in running workers.

        Args:
            epoch: Number of the epoch, from 0.

        Raises:
            SelectionError: If it is negative.
        """
        if epoch < 0:
            raise SelectionError(f"an epoch is a number from 0, got {epoch}.")
        self._epoch.fill_(epoch)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.plan)

    def __getitem__(self, number: int) -> Sample:
        """Return a sample: a flat dict of tensors and texts (see the fields' table).

        Raises:
            IndexError: If there is no such sample.
            StorageError: If a file is missing or altered.
            MediaError: If a video does not decode to what the index says.
        """
        number = int(number)
        if number < 0:
            number += len(self)
        address = self.plan.locate(number, epoch=self.epoch)
        seeds = np.random.SeedSequence((self.plan.seed, self.epoch, number))
        sample = self._loader.load(
            address,
            clip="clip" if self.plan.windows.is_clip else "frame",
            generator=np.random.default_rng(seeds),
        )
        return to_tensors(sample)

    def __getitems__(self, numbers: Sequence[int]) -> list[Sample]:
        """Return several samples in the order asked, each stream read forwards on the way."""
        loaded = {number: self[number] for number in sorted(set(numbers))}
        return [loaded[number] for number in numbers]

    def close(self) -> None:
        """Close the videos that this process holds open; the dataset can be used again."""
        self._loader.close()


class StereoPairs(_MappedScenes):
    """Stereo pairs of StereoGenBench scenes, as a map-style torch dataset.

    Samples are numbered scene by scene, frame by frame, pair by pair. Each is a flat dict; which
    fields it has, their shapes, dtypes and units, are in `stereogenbench_data.PAIR_FIELDS`.

    >>> from stereogenbench_data import StereoPairs
    >>> pairs = StereoPairs(getfixture("small_release"), family="Uniform", pairs="all")
    >>> pairs[0]["disparity"].shape
    torch.Size([1, 64, 64])
    """

    def __init__(
        self,
        data: Data,
        *,
        fields: Iterable[str] = DEFAULT_PAIR_FIELDS,
        size: tuple[int, int] | None = None,
        transform: Transform | None = None,
        depth: DepthEncoding | None = None,
        seed: int = 0,
        **selection: Unpack[Selection],
    ) -> None:
        """Select the samples; no video is opened before the first sample is asked for.

        Args:
            data: A folder in the released layout, an index made of one, or a `SceneIndex`.
            fields: Names of the fields wanted; only what they need is read and decoded.
            size: (height, width) in pixels that pictures are scaled to while they are decoded;
                intrinsics and disparity follow. None keeps the stored size.
            transform: What changes pictures and cameras together, such as `Compose`.
            depth: A depth contract instead of the one that files and release state.
            seed: Seed of random frames, transforms and the balanced subsample.
            **selection: Filters on scenes (`SceneFilters`), pairs, direction, baseline_cm,
                balance and limit (`PairOptions`), and frames (`parse_frames`).

        Raises:
            SelectionError: If nothing matches, naming the filter that left nothing and what
                there is; or if a pair, frame or filter does not exist.
            FieldError: If a field does not exist, or a size is not one.
            StorageError: If the data are not there, or hold broken scenes (all are named).
            MediaError: If depth that a field needs cannot have been stored whole (8 bits, a lossy
                codec, chroma) and the depth contract does not accept it.
        """
        index = open_index(data)
        plan = plan_pairs(index, seed=require_seed(seed), **selection)
        request = Request(
            kind="pairs",
            fields=require_fields(fields, known=PAIR_FIELDS),
            layout="stacked" if selection.get("pairs") == "sweep" else "single",
            size=require_size(size),
            depth=depth,
            transform=transform,
        )
        super().__init__(index, plan, request)


class SceneViews(_MappedScenes):
    """Several views of a moment, or each view by itself: for multi-view and monocular tasks.

    With cameras such as (0, 2, 5) a sample stacks these views: ``image`` (V, 3, H, W), ``depth``
    (V, 1, H, W), ``world_from_cam`` (V, 4, 4); in clips (V, T, ...). With ``cameras="each"`` every
    camera is a sample by itself, without that axis: monocular depth under varying focal length.
    The fields are in `stereogenbench_data.VIEW_FIELDS`.
    """

    def __init__(  # noqa: PLR0913 - each names one thing that a user chooses
        self,
        data: Data,
        *,
        cameras: Sequence[int] | Literal["all", "each"] = "all",
        frames: FramesSpec = "first",
        fields: Iterable[str] = DEFAULT_VIEW_FIELDS,
        size: tuple[int, int] | None = None,
        transform: Transform | None = None,
        depth: DepthEncoding | None = None,
        seed: int = 0,
        **filters: Unpack[SceneFilters],
    ) -> None:
        """Select the samples; no video is opened before the first sample is asked for.

        Args:
            data: As for `StereoPairs`.
            cameras: Camera numbers to stack, "all" six, or "each" as a sample by itself.
            frames: As for `StereoPairs`.
            fields: Names of the fields wanted; only what they need is read and decoded.
            size: (height, width) in pixels, as for `StereoPairs`.
            transform: As for `StereoPairs`; a flip, which swaps the views of a pair, is refused.
            depth: A depth contract instead of the one that files and release state.
            seed: Seed of random frames and transforms.
            **filters: Filters on scenes (`SceneFilters`).

        Raises:
            SelectionError: If nothing matches, or a camera does not exist.
            FieldError: If a field does not exist, or the transform swaps views.
            StorageError: If the data are not there, or hold broken scenes (all are named).
        """
        if transform is not None and transform.swaps_views:
            raise FieldError("SceneViews takes no flip: it swaps the two views of a pair.")
        index = open_index(data)
        plan = plan_views(
            index,
            cameras="each" if cameras == "each" else require_cameras(cameras),
            frames=frames,
            seed=require_seed(seed),
            filters=filters,
        )
        request = Request(
            kind="views",
            fields=require_fields(fields, known=VIEW_FIELDS),
            layout="single" if cameras == "each" else "stacked",
            size=require_size(size),
            depth=depth,
            transform=transform,
        )
        super().__init__(index, plan, request)


def open_index(data: Data) -> SceneIndex:
    """Return the index of a folder, an index file, or an index as it is."""
    return data if isinstance(data, SceneIndex) else SceneIndex.open(data)


def require_size(size: Any) -> tuple[int, int] | None:
    """Return a (height, width) in pixels, or None.

    Raises:
        FieldError: If it is not two whole numbers of 1 to 16384.
    """
    if size is None:
        return None
    try:
        height, width = (int(side) for side in size)
        whole = (height, width) == tuple(size)
    except (TypeError, ValueError):
        whole = False
    if not whole or not (0 < height <= LARGEST_SIDE_PX and 0 < width <= LARGEST_SIDE_PX):
        raise FieldError(
            f"size must be (height, width) of 1 to {LARGEST_SIDE_PX} pixels, got {size!r}."
        )
    return height, width


def require_seed(seed: Any) -> int:
    """Return a seed.

    Raises:
        SelectionError: If it is not a whole number from 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise SelectionError(f"seed must be a whole number from 0, got {seed!r}.")
    return int(seed)


def require_cameras(cameras: Any) -> tuple[int, ...]:
    """Return camera numbers, in the order given.

    Raises:
        SelectionError: If one is not of 0 to 5 or is given twice, or there is none.
    """
    if cameras == "all":
        return tuple(range(CAMERA_COUNT))
    found = tuple(cameras) if isinstance(cameras, Sequence | np.ndarray) else (cameras,)
    if not found or len(set(found)) < len(found) or not set(found) <= set(range(CAMERA_COUNT)):
        raise SelectionError(
            f"cameras must be 'all', 'each' or different numbers of 0 to {CAMERA_COUNT - 1}, "
            f"got {cameras!r}."
        )
    return tuple(int(camera) for camera in found)
