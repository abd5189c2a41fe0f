"""Map-style datasets: a sample by its number, for torch's own `DataLoader`."""

import operator
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Unpack

import numpy as np
import torch
from torch.utils.data import Dataset

from stereogenbench_data.datasets.batches import EpochBatches
from stereogenbench_data.datasets.loader import LoaderOptions, PairsLoader, split_options
from stereogenbench_data.datasets.open_videos import videos_to_keep
from stereogenbench_data.datasets.tensors import to_tensors
from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.samples.derive import RECTIFIED_PX
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
from stereogenbench_data.storage.cache import ShardCache
from stereogenbench_data.storage.index import SceneIndex

LARGEST_SIDE_PX: Final = 16384

_CAMERAS: Final = frozenset(range(CAMERA_COUNT))

Data = str | Path | SceneIndex


class _MappedScenes(Dataset[Sample]):
    """Samples of a plan by number, loaded in whatever process asks."""

    def __init__(
        self, index: SceneIndex, plan: Plan, request: Request, *, cache: ShardCache | None = None
    ) -> None:
        require_whole_depth(index, plan, request)
        _warn_of_odd_scenes(index, plan, request)
        self.index = index
        self.plan = plan
        self._loader = SampleLoader(index, request, cache=cache)
        self._streams = request.streams
        self._access: Literal["random", "in order"] = "random"
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
        if not isinstance(epoch, int | np.integer) or not 0 <= epoch < 2**63:
            raise SelectionError(f"an epoch is a whole number from 0, got {epoch!r}.")
        self._epoch.fill_(int(epoch))

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
        number = operator.index(number)
        if not -len(self) <= number < len(self):
            raise IndexError(f"no sample {number}: there are {len(self)}")
        number %= len(self)
        address = self.plan.locate(number, epoch=self.epoch)
        seeds = np.random.SeedSequence((self.plan.seed, self.epoch, number))
        sample = self._loader.load(
            address,
            clip="clip" if self.plan.windows.is_clip else "frame",
            generator=np.random.default_rng(seeds),
        )
        if self._access == "in order" and self.plan.is_last_of_scene(number):
            self._loader.release(address.row)
        return to_tensors(sample)

    def __getitems__(self, numbers: Sequence[int]) -> list[Sample]:
        """Return several samples in the order asked, each stream read forwards on the way."""
        loaded = {number: self[number] for number in sorted(set(numbers))}
        return [loaded[number] for number in numbers]

    def loader(
        self, batch_size: int, *, num_workers: int = 0, **options: Unpack[LoaderOptions]
    ) -> PairsLoader:
        """Return a torch `DataLoader` whose order is the same whatever ranks and workers there are.

        Args:
            batch_size: Samples in a batch of one rank.
            num_workers: How many processes load; 0 loads in this one.
            **options: How the epoch is ordered and shared out (`EpochOptions`: seed, rank,
                world_size, tail, lanes, open_scenes, order); and what `DataLoader` takes.

        Raises:
            SelectionError: If an option is out of its range, or every batch would be dropped.
        """
        ordering, others = split_options(options)
        batches = EpochBatches(self, batch_size, **ordering)
        return PairsLoader(self, batches, num_workers=num_workers, **others)

    def keep_open(self, batches: EpochBatches, *, processes: int) -> None:
        """Read by these batches, in one of so many processes: each video is opened once.

        Videos are kept open for as many scenes as the batches interleave, and closed after a
        scene's last sample. ``loader`` does this.
        """
        if batches.rule.kind == "shuffled":
            videos = videos_to_keep(self.plan, batches, streams=self._streams, processes=processes)
            self._loader.keep_open(videos)
        self._access = "in order"

    def close(self) -> None:
        """Close the videos that this process holds open; the dataset can be used again."""
        self._loader.close()

    def __repr__(self) -> str:
        """Say what it holds."""
        scenes = len(self.plan.scene_rows)
        return f"<{type(self).__name__}: {len(self)} samples of {scenes} scenes, {self.index.root}>"


class OddSceneWarning(UserWarning):
    """Selected scenes are not what the release promises: the message says how and which."""


def _warn_of_odd_scenes(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Warn where rigs are not rectified, or where a scene's cameras state several depth units."""
    needs = {request.known[name].needs_poses for name in request.fields}
    rows = plan.scene_rows
    if "unless rectified" in needs:
        residuals_px = index.column("rig_residual_px")[rows]
        _warn(
            index, rows[residuals_px > RECTIFIED_PX],
            f"are not rectified (by up to {residuals_px.max(initial=0):.3g} px): their pixels are "
            "projected through the poses, and no field holds what that moves up or down",
        )  # fmt: skip
    if request.streams & {"source_depth", "target_depth"} and not (
        request.depth and request.depth.unit_m
    ):
        units_m = index.column("depth_unit_m")[rows]
        _warn(
            index, rows[(units_m != units_m[:, :1]).any(axis=1)],
            "state other units of depth for some cameras than for others: if a tag is missing or "
            "wrong, pass DepthEncoding(unit_m=...)",
        )  # fmt: skip


def _warn(index: SceneIndex, rows: Any, what: str) -> None:
    if len(rows):
        keys = ", ".join(index.column("key")[rows[:3]])
        text = f"{index.root}: {len(rows)} selected scenes {what}. The first: {keys}."
        warnings.warn(text, OddSceneWarning, stacklevel=5)


class StereoPairs(_MappedScenes):
    """Stereo pairs of StereoGenBench scenes, as a map-style torch dataset.

    Samples are numbered scene by scene, frame by frame, pair by pair. Each is a flat dict; which
    fields it has, their shapes, dtypes and units, are in `stereogenbench_data.PAIR_FIELDS`.

    >>> from stereogenbench_data import StereoPairs
    >>> pairs = StereoPairs(getfixture("small_release"), family="Uniform", pairs="all")
    >>> pairs[0]["disparity"].shape
    torch.Size([1, 64, 64])
    """

    def __init__(  # noqa: PLR0913 - each names one thing that a user chooses
        self,
        data: Data,
        *,
        fields: Iterable[str] = DEFAULT_PAIR_FIELDS,
        size: tuple[int, int] | None = None,
        transform: Transform | None = None,
        depth: DepthEncoding | None = None,
        seed: int = 0,
        cache: ShardCache | None = None,
        **selection: Unpack[Selection],
    ) -> None:
        """Select the samples; no video is opened before the first sample is asked for.

        Args:
            data: A folder in the released layout; a folder of shards, or its URL; an index of
                either; or a `SceneIndex`.
            fields: Names of the fields wanted; only what they need is read and decoded.
            size: (height, width) in pixels that pictures are scaled to while they are decoded;
                intrinsics and disparity follow. None keeps the stored size.
            transform: What changes pictures and cameras together, such as `Compose`.
            depth: A depth contract instead of the one that files and release state.
            seed: Seed of random frames, transforms and the balanced subsample.
            cache: Where to keep on disk what is read from a URL; None fetches, each time, just the
                bytes that samples need.
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
            depth=require_depth(depth),
            transform=require_transform(transform),
        )
        super().__init__(index, plan, request, cache=cache)


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
        cache: ShardCache | None = None,
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
            cache: As for `StereoPairs`.
            **filters: Filters on scenes (`SceneFilters`).

        Raises:
            SelectionError: If nothing matches, or a camera does not exist.
            FieldError: If a field does not exist, or the transform swaps views.
            StorageError: If the data are not there, or hold broken scenes (all are named).
        """
        transform = require_transform(transform)
        if transform is not None and transform.swaps_views:
            raise FieldError("SceneViews takes no flip: it swaps the two views of a pair.")
        index = open_index(data)
        each = isinstance(cameras, str) and cameras == "each"
        plan = plan_views(
            index,
            cameras="each" if each else require_cameras(cameras),
            frames=frames,
            seed=require_seed(seed),
            filters=filters,
        )
        request = Request(
            kind="views",
            fields=require_fields(fields, known=VIEW_FIELDS),
            layout="single" if each else "stacked",
            size=require_size(size),
            depth=require_depth(depth),
            transform=require_transform(transform),
        )
        super().__init__(index, plan, request, cache=cache)


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


def require_transform(transform: Any) -> Transform | None:
    """Return a transform, or None.

    Raises:
        FieldError: If it cannot be called, or does not say whether it swaps the views.
    """
    says = isinstance(getattr(transform, "swaps_views", None), bool)
    if transform is None or (says and callable(transform) and not isinstance(transform, type)):
        return transform
    raise FieldError(
        f"a transform is called with (views, generator) and has an attribute swaps_views, True or "
        f"False; got {transform!r}."
    )


def require_depth(depth: Any) -> DepthEncoding | None:
    """Return a depth contract, or None.

    Raises:
        FieldError: If it is something else.
    """
    if depth is not None and not isinstance(depth, DepthEncoding):
        raise FieldError(f"depth must be a DepthEncoding(...), got {depth!r}.")
    return depth


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
    if isinstance(cameras, str) and cameras == "all":
        return tuple(range(CAMERA_COUNT))
    found: tuple[Any, ...] = (cameras,)
    if isinstance(cameras, Sequence | np.ndarray):
        found = tuple(np.asarray(cameras, dtype=object).tolist())
    whole = all(isinstance(camera, int | np.integer) for camera in found)
    if not (whole and found and len(set(found)) == len(found) and set(found) <= _CAMERAS):
        raise SelectionError(
            f"cameras must be 'all', 'each' or different numbers of 0 to {CAMERA_COUNT - 1}, "
            f"got {cameras!r}."
        )
    return tuple(int(camera) for camera in found)
