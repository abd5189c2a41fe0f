"""Map-style datasets: a sample by its number, for torch's own `DataLoader`."""

import copy
import multiprocessing
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final, Literal, Self, TypedDict, Unpack, get_args

import numpy as np
from torch.utils.data import Dataset, get_worker_info

from stereogenbench_data.datasets.batch_buffers import BatchMemory, Buffers, to_tensors
from stereogenbench_data.datasets.batch_parts import BatchPart, MadePart, make_part, memory_of
from stereogenbench_data.datasets.batches import (
    EpochBatch,
    EpochBatches,
    GlobalBatches,
    Passes,
)
from stereogenbench_data.datasets.division import WorkerShare, videos_allowed, warn_of_division
from stereogenbench_data.datasets.epoch_rule import EpochOptions, videos_per_scene
from stereogenbench_data.datasets.loader import (
    LOADER_DEFAULTS,
    LoaderOptions,
    PairsLoader,
    accelerates_epoch,
)
from stereogenbench_data.datasets.overview import in_one_line, pairs_table
from stereogenbench_data.datasets.shared import SharedEpoch
from stereogenbench_data.errors import (
    FieldError,
    MediaError,
    SelectionError,
    StorageError,
    text_without_secrets,
)
from stereogenbench_data.geometry.rig import RECTIFIED_PX
from stereogenbench_data.index.left_out import are_few
from stereogenbench_data.index.table import Rows, SceneIndex
from stereogenbench_data.media import depth
from stereogenbench_data.samples.fields import (
    DEFAULT_PAIR_FIELDS,
    DEFAULT_VIEW_FIELDS,
    Allocate,
    EnlargedSizeWarning,
    Layout,
    OddSceneWarning,
    Request,
    Sample,
    Transform,
    new_array,
    parse_request,
    require_importable,
    warn_if_swapped,
)
from stereogenbench_data.samples.load import OPEN_STREAMS, SampleDecoder, StreamStats, Work
from stereogenbench_data.schema.conventions import Conventions, depth_of
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT, DEFAULT_DEPTH_UNIT_M, depth_name
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.filters import SceneFilters, may_pass
from stereogenbench_data.selection.options import options_of, require_options, split_options
from stereogenbench_data.selection.plan import (
    SELECTION_DEFAULTS,
    Address,
    FramesSpec,
    Plan,
    Random,
    Selection,
    Step,
    plan_pairs,
    plan_views,
)
from stereogenbench_data.selection.signatures import list_options
from stereogenbench_data.sources.cache import ShardCache
from stereogenbench_data.sources.fetch_ahead import FETCH_AHEAD_BYTES, FetchAhead
from stereogenbench_data.sources.location import is_remote

if TYPE_CHECKING:
    import pandas

Data = str | Path | SceneIndex

Check = Literal["read", "opened", "metadata"]
"""Which videos are compared with their checksums: see `StereoPairs`."""


_CACHE_DIVISOR: Final = 16
"""The part of a cache that a process may fill ahead."""


class ReadOptions(TypedDict, total=False):
    """How the samples of a dataset are read.

    Attributes:
        size: (height, width) in pixels, or a text "WIDTHxHEIGHT", that pictures are scaled to while
            they are decoded; intrinsics and disparity follow. None keeps the stored size.
            `SwappedSizeWarning` is given where the two look exchanged.
        transform: What changes pictures and cameras together, such as `Compose`.
        depth: A depth encoding instead of the one that files and release state.
        conventions: Where quantities stand in the files and how they are read, as
            ``stereogenbench conventions`` writes it; see `SceneIndex.open`. ``depth`` counts more.
        seed: Seed of random frames, transforms and the balanced subsample; 0 if left out.
        cache: Where to keep on disk what is read from a URL; None fetches, each time, just the
            bytes that samples need.
        check: Which videos are compared whole with checksums of the index, if it has any, by each
            process that opens them: "opened" all; "read" (the default) where at least half the
            frames of a scene are asked for, so that it costs little beside decoding them;
            "metadata" none. Those on disk and in the cache are compared before a frame is given,
            those from a URL when their last byte has come. Metadata files are always compared. Of a
            folder `stereogenbench index --checksums` makes checksums.
        buffers: "reused", the default: the memory of a batch is used for a later one once nobody
            holds any part of it. "fresh": each batch has memory of its own, which costs speed.
        fetch_ahead_bytes: How many bytes each process fetches from a URL before they are needed,
            256 MB by default; 0 fetches only what the current sample needs. With a cache, what is
            fetched ahead fills it.
    """

    size: tuple[int, int] | str | None
    transform: Transform | None
    depth: DepthEncoding | None
    conventions: str | Path | Conventions | None
    seed: int
    cache: ShardCache | None
    check: Check
    buffers: Buffers
    fetch_ahead_bytes: int


READ_DEFAULTS: Final = ReadOptions(
    size=None, transform=None, depth=None, conventions=None, seed=0, cache=None, check="read",
    buffers="reused", fetch_ahead_bytes=FETCH_AHEAD_BYTES,
)  # fmt: skip
"""How samples are read unless somebody says otherwise."""


class PairsOptions(ReadOptions, Selection, total=False):
    """What `StereoPairs` takes, except data and fields."""


PAIRS_DEFAULTS: Final = {**SELECTION_DEFAULTS, **READ_DEFAULTS}


class ViewsOptions(ReadOptions, SceneFilters, total=False):
    """What `SceneViews` takes, except data, cameras, frames and fields."""


class SeekTableWarning(UserWarning):
    """The index of data behind a URL is of an earlier version, so reading is slow."""


class MixedSplitsWarning(UserWarning):
    """No split was chosen, so samples come from train and from eval scenes."""


class _MappedScenes(Dataset[Sample]):
    """Samples of a plan by number, loaded in the calling process.

    Attributes:
        left_out: How many scenes were selected and cannot give what is requested.
        is_random: Whether the samples of an epoch may differ from those of another.
        is_watched: Whether who reads an epoch a second time is warned.
        chosen: Split, pairs or cameras, and frames, as chosen or by default; for people.
    """

    chosen: Mapping[str, Any] = {}

    def __init__(
        self, index: SceneIndex, plan: Plan, request: Request, options: ReadOptions
    ) -> None:
        selected = len(plan.scene_rows)
        plan = _without_odd_scenes(index, plan, request)
        _require_videos(index, plan, request)
        if request.streams & {"source_depth", "target_depth"}:
            _require_whole_depth(index, plan, request)
        _warn_of_odd_scenes(index, plan, request)
        _warn_of_odd_size(index, plan, request)
        self.index = index
        self.plan = plan
        self.left_out = selected - len(plan.scene_rows)
        self.request = request
        cache = options["cache"]
        ahead = FetchAhead(limit_bytes=options["fetch_ahead_bytes"])
        if cache is not None:
            # Several processes fill it: what one fetches ahead must not evict what another needs.
            ahead.limit_bytes = min(ahead.limit_bytes, cache.limit_bytes // _CACHE_DIVISOR)
        # A scene that was not opened yet is opened with its seek tables.
        has_tables = index.unopened is not None or index.load_seek_tables()
        if is_remote(index.root) and not has_tables and cache is None:
            warnings.warn(
                f"{index.where} : its index does not say where the packets of videos lie, so a "
                f"frame takes several requests, one after another, and nothing is fetched ahead. "
                f"Make the index again where the data are: `stereogenbench index` for a released "
                f"tree, `stereogenbench unpack` and `pack` for shards.",
                SeekTableWarning,
                stacklevel=3,
            )
        self._loader = SampleDecoder(
            index,
            request,
            cache=cache,
            check=_check_of(options["check"], plan),
            frames="shared" if (np.diff(plan.first_pair) > 1).any() else "used once",
            ahead=ahead if is_remote(index.root) else None,
        )
        self.buffers = _require_one_of("buffers", options["buffers"], Buffers)
        self.shared_epoch = SharedEpoch()
        self.is_random = _is_random(plan, request)
        self.is_watched = self.is_random
        self._global_batches: GlobalBatches | None = None
        self._share, self._stop = WorkerShare(0, 1, 0, 1, "batches"), 0
        self._pass_read: int | None = None
        self._memory: BatchMemory | None = None
        self._idle_since_s = 0.0

    @property
    def epoch(self) -> int:
        """The epoch that random frames and transforms are drawn for.

        It is the one that was set; or the pass that Accelerate makes over this dataset, which it
        counts without telling.
        """
        accelerates = accelerates_epoch(self)
        return self.shared_epoch.value if accelerates is None else accelerates

    def set_epoch(self, epoch: int) -> None:
        """Draw random frames and transforms anew, in this process and in running workers.

        Loaders that were made before follow, unless an epoch of their own was set.

        Args:
            epoch: Number of the epoch, from 0.

        Raises:
            SelectionError: If it is negative.
        """
        self.shared_epoch.set(epoch)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.plan)

    def __getitem__(self, number: int) -> Sample:
        """Return a sample: a flat dict of tensors and texts (see the fields' table).

        Raises:
            IndexError: If there is no such sample.
            SelectionError: If it is a slice or several numbers.
            StorageError: If a file is missing or altered.
            MediaError: If a video does not decode to what the index says.
        """
        batch = EpochBatch([number], epoch=self.epoch)
        if get_worker_info() is not None:
            self._mark_drawn(batch)
        return to_tensors(self._sample(number, batch))

    def __getitems__(self, numbers: Sequence[int]) -> Any:
        """Return several samples in the order asked, each stream read forwards on the way.

        What `EpochBatches` gives is read as it comes: a stream that ends with what lies before its
        start goes back once.

        What `EpochBatches` gives is drawn for its own epoch, and has the field ``is_padding`` with
        ``drop_last="pad"``. Of our loader a `BatchPart` is given, and a `MadePart` returned.
        """
        if isinstance(numbers, BatchPart):
            return self._made(numbers)
        batch = (
            numbers if isinstance(numbers, EpochBatch) else EpochBatch(numbers, epoch=self.epoch)
        )
        places = list(range(len(batch)))
        if batch is not numbers:
            places.sort(key=batch.__getitem__)
        loaded = dict(zip(places, self.samples_of(batch, places), strict=True))
        return [loaded[place] for place in range(len(batch))]

    def _mark_drawn(self, batch: EpochBatch) -> None:
        """Warn once where torch's own `DataLoader` reads samples of an epoch again."""
        if self.is_watched:
            fills_up = batch.is_padding or [False] * len(batch)
            own = [number for number, is_again in zip(batch, fills_up, strict=True) if not is_again]
            self.shared_epoch.mark_drawn(own, epoch=batch.epoch, dataset=self)

    def samples_of(self, batch: EpochBatch, places: Sequence[int]) -> Iterator[Sample]:
        """Return samples of a batch one after another, by their places in it."""
        share = WorkerShare.of_this_process(self._share.rank, self._share.world_size)
        return map(to_tensors, self._load(batch, places, share))

    def _load(
        self,
        batch: EpochBatch,
        places: Sequence[int],
        share: WorkerShare,
        of_place: Callable[[int], Allocate] = lambda place: new_array,
    ) -> Iterator[Sample]:
        """Yield samples of a batch as arrays and texts, written into what is allocated for them."""
        self._mark_drawn(batch)
        self._keep_open(batch)
        reading = [batch[place] for place in places]
        if reading and not self._loader.is_next(self._address(reading[0], batch)):
            self._loader.expect(self.steps(batch, reading, share))
        for place in places:
            allocate = of_place(place)
            sample = self._sample(batch[place], batch, allocate)
            if batch.is_padding is not None:
                sample["is_padding"] = allocate("is_padding", (), np.bool_)
                sample["is_padding"][...] = batch.is_padding[place]
            yield sample

    def _made(self, task: BatchPart) -> MadePart:
        """Return what this process makes of its part of a batch."""
        began_s, batch = perf_counter(), task.batch
        memory = self._memory or memory_of(task)
        memory.layout = task.layout or memory.layout
        if not batch:
            return MadePart(task.key, [])
        is_worker = self._memory is not None
        if is_worker and self._pass_read != task.key[0]:
            # What an earlier pass has open is not wanted any more.
            self._loader.close()
            self._pass_read = task.key[0]
        load = partial(self._load, batch, range(len(batch)), self._share)
        made = make_part(task, memory, load)
        made.work = self._loader.take_work()
        if self._idle_since_s:
            made.work.waiting_s = began_s - self._idle_since_s
        if is_worker:
            self._idle_since_s = perf_counter()
        return made

    def begin_worker(self, worker: int, memory: BatchMemory) -> None:
        """Begin as a worker of a loader, whose batches lie in this memory."""
        self._share, self._memory = self._share._replace(worker=worker), memory

    def take_work(self) -> Work:
        """Return what this process has done for samples since this was asked before."""
        return self._loader.take_work()

    def _keep_open(self, batch: EpochBatch) -> None:
        """Keep as many videos open as this process has runs open."""
        if batch.number is not None:
            videos = max(OPEN_STREAMS, batch.open_runs * self._videos_per_scene)
            videos = min(videos, videos_allowed())
            self._loader.keep_open(videos, frames=batch.open_frames, scenes=batch.open_runs)

    def steps(
        self, batch: EpochBatch, reading: Sequence[int], share: WorkerShare
    ) -> Iterator[Step]:
        """Yield the samples of a batch, and of those that this process gets after it."""
        known, number, epoch = self._global_batches, batch.number, batch.epoch
        while True:
            for each in reading:
                if -len(self.plan) <= each < len(self.plan):
                    address = self._address(each, batch)
                    yield Step(address, each in batch.ends_of_runs)
            if number is None or known is None or number + share.batches_apart >= self._stop:
                return
            number += share.batches_apart
            batch = known.batch(number, epoch=epoch)
            if share.of == "streams":
                own = known.workers_of(batch, share) == share.worker
                batch = batch.at(np.flatnonzero(own).tolist())
            reading = batch

    def _address(self, number: int, batch: EpochBatch) -> Address:
        address = self.plan.locate(number % len(self.plan), epoch=batch.epoch, group=batch.group)
        return address._replace(run=0) if batch.number is None else address

    def _sample(self, number: int, batch: EpochBatch, allocate: Allocate = new_array) -> Sample:
        """Return a sample of a batch as arrays, written into what is allocated for them."""
        count = len(self.plan)
        if isinstance(number, slice | list | tuple | range):
            several = range(*number.indices(count)) if isinstance(number, slice) else number
            raise SelectionError(
                f"a sample is chosen by its number, got {number!r:.60}. For several of them: "
                f"torch.utils.data.Subset(pairs, {several!r:.60})."
            )
        number = operator.index(number)
        if not -count <= number < count:
            raise IndexError(f"no sample {number}: there are {count}")
        number %= count
        address = self._address(number, batch)
        sample = self._loader.load(
            address,
            clip="clip" if self.plan.windows.is_clip else "frame",
            seeds=(self.plan.seed, batch.epoch, number),
            allocate=allocate,
        )
        if number in batch.ends_of_runs:
            self._loader.release(address)
        return sample

    @list_options(LOADER_DEFAULTS)
    def loader(
        self, batch_size: int = 1, *, num_workers: int = 0, **options: Unpack[LoaderOptions]
    ) -> PairsLoader:
        """Return a torch `DataLoader` whose order never depends on its workers.

        Nor does it depend on ranks that divide the shuffle groups; for other ranks it follows their
        number at the first start, which a state keeps.

        Shuffled, as by default, samples that do not fill a batch of every rank are dropped at the
        end of an epoch (``drop_last=True``). With ``shuffle=False`` samples come in order and none
        is dropped: the last batch may be short, and ranks may differ by one batch
        (``drop_last=False``).

        Each pass is of the next epoch, also after a loop that was left; see `PairsLoader`.

        Args:
            batch_size: Samples in a batch of one rank.
            num_workers: How many processes load; 0 loads in this one.
            **options: How the epoch is ordered and shared out (`EpochOptions`: seed, rank,
                world_size, shuffle, drop_last, shuffle_groups, open_scenes); and what `DataLoader`
                takes.

        Returns:
            A loader with an epoch and open videos of its own: any number of them can be used side
            by side.

        Raises:
            SelectionError: If there is no such option, it is out of its range, or every batch would
                be dropped.
        """
        require_options(self.loader, options)
        ordering, others = split_options(options, EpochOptions)
        own = self.with_own_videos()
        own.is_watched = False  # a loader's passes are each of the next epoch
        batches = EpochBatches(own, batch_size, **ordering)
        repeats = batches.rule if batches.rule.shuffle or self.is_random else None
        batches.passes = Passes(self.shared_epoch, then="next epoch", watched=repeats)
        return PairsLoader(own, batches, num_workers=num_workers, **others)

    def with_own_videos(self, *, epoch: int | None = None) -> Self:
        """Return the same samples with open videos of their own.

        Args:
            epoch: An epoch of their own; None goes with this dataset.
        """
        twin = copy.copy(self)
        twin._loader = copy.copy(self._loader)
        if epoch is not None:
            twin.shared_epoch = SharedEpoch(epoch)
            twin.is_watched = False
        twin._global_batches = None
        return twin

    def read_by(self, batches: EpochBatches, share: WorkerShare) -> None:
        """Expect these batches, divided in this way: what comes next is fetched ahead."""
        self._global_batches, self._share, self._stop = batches.of_all_ranks, share, batches.end()
        order = batches.of_all_ranks.order(0)
        warn_of_division(order, share, videos_per_scene=self._videos_per_scene)

    @cached_property
    def _videos_per_scene(self) -> int:
        return videos_per_scene(self.plan, self.request.streams)

    def stop_fetching(self) -> None:
        """End the requests of this process for coming samples."""
        self._loader.stop_fetching()

    def stats(self) -> StreamStats:
        """Return how many videos this process has open for this dataset, and may have.

        A loader has its own videos: see its ``stats()``.
        """
        return self._loader.stats

    def close(self) -> None:
        """Close the videos that this process holds open; the dataset can be used again.

        A loader has its own videos, which its ``close()`` closes.
        """
        self._loader.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs.

        Raises:
            FieldError: If the copy is for a process that cannot import the transform.
        """
        require_importable(self.request.transform)
        return self.__dict__

    def __repr__(self) -> str:
        """Return a summary."""
        return in_one_line(type(self).__name__, self.index, self.plan, self.request, self.chosen)

    def to_pandas(self) -> "pandas.DataFrame":
        """Return the selected pairs as a table, a row each, with what the index says of them.

        Raises:
            ExtraError: If pandas is not installed.
        """
        return pairs_table(self.index, self.plan)


class StereoPairs(_MappedScenes):
    """Stereo pairs of StereoGenBench scenes, as a map-style torch dataset.

    Samples are numbered scene by scene, frame by frame, pair by pair. Each is a flat dict; which
    fields it has, their shapes, dtypes and units, are in `stereogenbench_data.PAIR_FIELDS`.

    >>> from stereogenbench_data import StereoPairs
    >>> pairs = StereoPairs(getfixture("small_release"), family="Uniform", pairs="all")
    >>> pairs[0]["disparity"].shape
    torch.Size([1, 64, 64])
    """

    @list_options(PAIRS_DEFAULTS)
    def __init__(
        self,
        data: Data,
        *,
        fields: Iterable[str] = DEFAULT_PAIR_FIELDS,
        **options: Unpack[PairsOptions],
    ) -> None:
        """Select the samples; no video is opened before the first sample is read.

        Args:
            data: A folder in the released layout; a folder of shards, or its URL; an index of
                either; or a `SceneIndex`.
            fields: Names of the fields wanted; only what they need is read and decoded.
            **options: Filters on scenes (`SceneFilters`); pairs, direction, baseline_cm, balance
                and limit (`PairOptions`); frames (`parse_frames`); and how samples are read: size,
                transform, depth, conventions, seed, cache, check, buffers and fetch_ahead_bytes
                (`ReadOptions`).

        Raises:
            SelectionError: If nothing matches, naming the filter that left nothing and what
                there is; or if a pair, frame or filter does not exist.
            FieldError: If a field does not exist, or a size is not one.
            StorageError: If the data are not there, or hold more than a few broken scenes.
            MediaError: If depth that a field needs cannot have been stored whole (8 bits, a lossy
                codec, chroma) and the depth encoding does not accept it.
        """
        require_options(StereoPairs, options, elsewhere={"loader": options_of(self.loader)})
        reading, selection = split_options({**READ_DEFAULTS, **options}, ReadOptions)
        index = opened(data, selection, reading["conventions"])
        plan = plan_pairs(index, seed=reading["seed"], **selection)
        _warn_of_mixed_splits(index, plan, selection)
        layout: Layout = "stacked" if str(selection.get("pairs")) == "sweep" else "single"
        request = parse_request("pairs", layout, fields=fields, options=reading)
        super().__init__(index, plan, request, reading)
        told = {"split": None, **SELECTION_DEFAULTS, **selection}
        self.chosen = {name: told[name] for name in ("split", "pairs", "frames")}


class SceneViews(_MappedScenes):
    """Several views of a moment, or each view by itself: for multi-view and monocular tasks.

    With cameras such as (0, 2, 5) a sample stacks these views: ``image`` (V, 3, H, W), ``depth``
    (V, 1, H, W), ``world_from_cam`` (V, 4, 4); in clips (V, T, ...). With ``cameras="each"`` every
    camera is a sample by itself, without that axis: monocular depth under varying focal length.
    The fields are in `stereogenbench_data.VIEW_FIELDS`.
    """

    @list_options(READ_DEFAULTS)
    def __init__(
        self,
        data: Data,
        *,
        cameras: Sequence[int] | Literal["all", "each"] = "all",
        frames: FramesSpec = "first",
        fields: Iterable[str] = DEFAULT_VIEW_FIELDS,
        **options: Unpack[ViewsOptions],
    ) -> None:
        """Select the samples; no video is opened before the first sample is read.

        Args:
            data: As for `StereoPairs`.
            cameras: Camera numbers to stack, "all" six, or "each" as a sample by itself.
            frames: As for `StereoPairs`.
            fields: Names of the fields wanted; only what they need is read and decoded.
            **options: Filters on scenes (`SceneFilters`), and how samples are read (`ReadOptions`).
                A transform that swaps the views of a pair is refused.

        Raises:
            SelectionError: If nothing matches, or a camera does not exist.
            FieldError: If a field does not exist, or the transform swaps views.
            StorageError: If the data are not there, or hold more than a few broken scenes.
        """
        require_options(SceneViews, options, elsewhere={"loader": options_of(self.loader)})
        reading, filters = split_options({**READ_DEFAULTS, **options}, ReadOptions)
        layout: Layout = "single" if str(cameras) == "each" else "stacked"
        request = parse_request("views", layout, fields=fields, options=reading)
        index, seed = opened(data, filters, reading["conventions"]), reading["seed"]
        plan = plan_views(index, cameras=cameras, frames=frames, seed=seed, filters=filters)
        _warn_of_mixed_splits(index, plan, filters)
        super().__init__(index, plan, request, reading)
        self.chosen = {"split": filters.get("split"), "cameras": cameras, "frames": frames}


def opened(
    data: Data,
    filters: Mapping[str, Any],
    conventions: str | Path | Conventions | None,
    *,
    rows: Rows = "settled",
) -> SceneIndex:
    """Return the index of some data; of a folder without one, of the scenes that may be chosen.

    Raises:
        FieldError: If conventions are given beside an index, which was opened without them.
    """
    if isinstance(data, SceneIndex):
        if conventions is not None:
            raise FieldError(
                "conventions concern the opening of data, and an index is open already: pass them "
                "to SceneIndex.open(..., conventions=...)."
            )
        return data
    return SceneIndex.open(data, wanted=may_pass(filters), conventions=conventions, rows=rows)


def _warn_of_mixed_splits(index: SceneIndex, plan: Plan, filters: SceneFilters) -> None:
    """Tell that no split was chosen where there are both: in the user's process, not in workers."""
    if filters.get("split") is not None or filters.get("scenes") is not None:
        return
    splits, counts = np.unique(
        index.column("split")[plan.scene_rows].astype(str), return_counts=True
    )
    if len(splits) < 2 or multiprocessing.parent_process() is not None:
        return
    each = " and ".join(f"{n} {split}" for split, n in zip(splits, counts, strict=True))
    message = text_without_secrets(
        f"{index.where}: no split was chosen, so {each} scenes come together. Give split='train' "
        "to train and split='eval' to score; split=('train', 'eval') takes both without a word."
    )
    warnings.warn(message, MixedSplitsWarning, stacklevel=3)


def _is_random(plan: Plan, request: Request) -> bool:
    """Return whether the samples of an epoch may differ from those of another."""
    transform = request.transform
    if transform is None:
        return isinstance(plan.windows, Random)
    from stereogenbench_data.samples.transforms import Compose, Crop, Letterbox, Resize

    steps = transform.steps() if isinstance(transform, Compose) else [transform]
    fixed = (Crop, Letterbox, Resize)
    return isinstance(plan.windows, Random) or not all(isinstance(step, fixed) for step in steps)


def _require_one_of(name: str, value: Any, kinds: Any) -> Any:
    """Return what is one of the words of an option.

    Raises:
        SelectionError: If it is none of them.
    """
    if value not in get_args(kinds):
        known = ", ".join(map(repr, get_args(kinds)))
        raise SelectionError(f"{name} must be one of {known}, got {value!r}.")
    return value


def _check_of(check: Check, plan: Plan) -> Literal["opened", "metadata"]:
    """Return when videos are compared with their checksums.

    Raises:
        SelectionError: If there is no such check.
    """
    _require_one_of("check", check, Check)
    if check != "read":
        return check
    frames = int(plan.frame_counts[0])
    clip = len(plan.windows.window(0, frames=frames, draw=(0,)))
    return "opened" if 2 * clip * plan.windows.count(frames) >= frames else "metadata"


def _without_odd_scenes(index: SceneIndex, plan: Plan, request: Request) -> Plan:
    """Return a plan without the few scenes that cannot give what is requested.

    These lack a video that others have, or a field of them is held up by what is not understood.
    `OddSceneWarning` counts them and names the first, unless opening the data told them all.

    Raises:
        StorageError: If they are more than a few; it names the field, the first scene and why.
    """
    reasons: dict[int, str] = {}
    selected = set(plan.scene_rows.tolist())
    for name in request.fields:
        for about in request.known[name].stopped_by:
            for row in selected.intersection(index.remarked(about).tolist()):
                text = index.indexed_scene(row).remark(about).rstrip(".")
                reasons.setdefault(row, f"{name!r} needs {text}")
    for row in selected.intersection(index.remarked("videos").tolist()):
        if _missing_videos(index, plan, request, int(np.searchsorted(plan.scene_rows, row))):
            reasons.setdefault(row, index.indexed_scene(row).remark("videos").rstrip("."))
    if not reasons:
        return plan
    first = min(reasons)
    told = (
        f"{index.where}: {counted(len(reasons), 'selected scene')} of {len(selected)} cannot give "
        f"what is asked for. The first: {index.column('key')[first]}: {reasons[first]}."
    )
    if len(reasons) == len(selected) or not are_few(len(reasons), of=len(selected)):
        raise StorageError(
            f"{told} Leave out that field, choose other pairs or scenes, mend the files, or state "
            f"how they are read in a file of conventions (`stereogenbench conventions` proposes "
            f"one)."
        )
    keys = index.column("key")
    if multiprocessing.parent_process() is None and not index.lacking.issuperset(keys[[*reasons]]):
        message = f"{told} Left out: {', '.join(keys[sorted(reasons)[:3]])}."
        warnings.warn(text_without_secrets(message), OddSceneWarning, stacklevel=4)
    return plan.without(index, sorted(reasons))


def _warn_of_odd_size(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Warn where height and width look exchanged, or exceed what training shards store."""
    if request.size is not None:
        rig = index.indexed_scene(int(plan.scene_rows[0])).rig
        stored = (rig.image_height_px, rig.image_width_px)
        warn_if_swapped(request.size, stored=stored)
        if index.is_derived and (request.size[0] > stored[0] or request.size[1] > stored[1]):
            warnings.warn(
                f"{index.where}: holds {index.derivation}, and size={request.size!r} (height, "
                f"width) is larger: pictures and depth are enlarged. Leave size out, or pass "
                f"released data.",
                EnlargedSizeWarning,
                stacklevel=4,
            )


def _require_videos(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Refuse samples of videos that the index lacks: some cameras alone were downloaded.

    Raises:
        StorageError: It names the first scene and the cameras.
    """
    partial = index.video_counts()[plan.scene_rows] < 2 * CAMERA_COUNT
    for place in np.flatnonzero(partial).tolist():
        missing = _missing_videos(index, plan, request, place)
        if missing:
            scene = index.indexed_scene(int(plan.scene_rows[place]))
            there = sorted({name[4:6] for name in scene.members if name.startswith("cam_")})
            raise StorageError(
                f"{index.where}: {scene.id.key} has no {', '.join(missing)}; videos of cameras "
                f"{', '.join(there) or 'none'} were fetched. Choose pairs of these, or download "
                "the others too."
            )


def _missing_videos(index: SceneIndex, plan: Plan, request: Request, place: int) -> list[str]:
    """Return the videos that the samples of a scene need and that are not there."""
    pairs = slice(plan.first_pair[place], plan.first_pair[place + 1])
    sources = set(plan.pairs.source[pairs].tolist())
    targets = set(plan.pairs.targets[pairs].ravel().tolist()) - {-1}
    needed = {
        f"cam_{camera:02d}_{stream.partition('_')[2]}"
        for stream in request.streams
        for camera in (sources if stream.startswith("source") else targets)
    }
    members = index.indexed_scene(int(plan.scene_rows[place])).members
    return sorted(needed - {name.partition(".")[0] for name in members})


def _require_whole_depth(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Refuse depth that its contract does not accept, or whose unit is not known.

    Files that are stored alike are one kind, of which the first is looked at.

    Raises:
        MediaError: It names the first file.
    """
    pairs = plan.pairs
    cameras = np.concatenate([pairs.source[:, None], pairs.targets], axis=1)
    if "source_depth" not in request.streams:
        cameras = cameras[:, 1:]
    if "target_depth" not in request.streams:
        cameras = cameras[:, :1]
    pair, place = np.nonzero(cameras >= 0)
    rows, cameras = pairs.row[pair], cameras[pair, place]
    kinds = index.categories("conventions")[1][rows].astype(np.int64)
    for name in ("depth_codec", "depth_pixel_format", "depth_unit_source"):
        values, value = index.categories(name)
        kinds = kinds * (len(values) + 1) + value[rows, cameras] + 1
    for first in np.sort(np.unique(kinds, return_index=True)[1]):
        scene, camera = index.indexed_scene(int(rows[first])), int(cameras[first])
        held = scene.held_name(depth_name(camera))
        name = scene.members[held].path
        if not name.endswith(held):
            name = f"{name}: {scene.id.key}.{held}"
        encoding = scene.depth_encoding(camera, request.depth or depth_of(scene))
        depth.require_depth_stream(
            codec=scene.depth_codec[camera],
            pixel_format=scene.depth_pixel_format[camera],
            encoding=encoding,
            name=name,
        )
        if encoding.unit_m is None:
            unknown = f"{name}: {depth.NO_DEPTH_UNIT}. {depth.DEPTH_CURES}"
            raise MediaError(scene.remark("depth") or unknown)


def _warn_of_odd_scenes(index: SceneIndex, plan: Plan, request: Request) -> None:
    needs = {request.known[name].needs_poses for name in request.fields}
    rows = plan.scene_rows
    if needs != {"never"}:
        residuals_px = index.column("rig_residual_px")[rows]
        _warn(
            index, rows[residuals_px > RECTIFIED_PX],
            f"are not rectified (by up to {residuals_px.max(initial=0):.3g} px): their pixels are "
            "projected through the poses, and no field holds what that moves up or down",
        )  # fmt: skip
        unknown = np.intersect1d(rows, index.remarked("poses"))
        unknown = unknown[[key not in index.lacking for key in index.column("key")[unknown]]]
        reason = index.indexed_scene(int(unknown[0])).remark("poses") if len(unknown) else ""
        _warn(
            index, unknown,
            f"have poses that are not understood, so their rigs are assumed rectified, with the "
            f"baselines of baseline.json ({reason}). `stereogenbench doctor` measures from the "
            f"pictures whether they are",
        )  # fmt: skip
    if request.streams & {"source_depth", "target_depth"} and not (
        request.depth and request.depth.unit_m
    ):
        units_m = index.column("depth_unit_m")[rows]
        defaults = (index.column("depth_unit_source")[rows] == "default").any(axis=1)
        _warn(
            index, rows[defaults],
            f"state no unit of depth, so the release's default of {DEFAULT_DEPTH_UNIT_M:g} m is "
            f"taken. `stereogenbench doctor {text_without_secrets(index.where)}` measures it from "
            f"the pictures; DepthEncoding(unit_m=...) sets it",
        )  # fmt: skip
        _warn(
            index, rows[(units_m != units_m[:, :1]).any(axis=1)],
            "state other units of depth for some cameras than for others: if a tag is missing or "
            "wrong, pass DepthEncoding(unit_m=...)",
        )  # fmt: skip


def _warn(index: SceneIndex, rows: Any, what: str) -> None:
    if len(rows):
        keys = ", ".join(index.column("key")[rows[:3]])
        text = f"{index.where}: {len(rows)} selected scenes {what}. The first: {keys}."
        warnings.warn(text, OddSceneWarning, stacklevel=5)
