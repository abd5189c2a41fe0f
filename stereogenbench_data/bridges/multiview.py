"""Several views of a moment as DUSt3R and VGGT take them: datasets by themselves, or in theirs.

Both take camera axes as OpenCV has them, depth along the optical axis in metres with 0 where it is
not measured, and poses in float32; so the world's origin is put at the first view's camera. Their
axes of the world stay those of the scene.

>>> from stereogenbench_data.bridges.multiview import DUSt3RViews, VGGTViews
>>> views = DUSt3RViews(getfixture("small_release"), pairs="adjacent")
>>> sorted(views[0][0])[:4]
['camera_intrinsics', 'camera_pose', 'dataset', 'depthmap']
>>> record = VGGTViews(getfixture("small_release")).get_data(seq_index=0)
>>> record["frame_num"], record["world_points"][0].shape
(6, (64, 64, 3))
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, Literal, Unpack

import numpy as np
import torch
from PIL import Image
from torch.utils.data import Dataset

from stereogenbench_data.bridges.posed_images import (
    PAIR_FIELDS,
    VIEW_FIELDS,
    PosedImage,
    PosedImageReader,
    index_of,
    origin_at,
    posed_images,
    training_filters,
)
from stereogenbench_data.datasets.mapped import Data, SceneViews, StereoPairs
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.samples.checks import check_samples
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.filters import SceneFilters
from stereogenbench_data.selection.plan import plan_views
from stereogenbench_data.selection.windows import FramesSpec
from stereogenbench_data.sources.cache import ShardCache

DATASET: Final = "StereoGenBench"

DUST3R_CENTRE_PX: Final = 0.0
"""Where DUSt3R puts the centre of the top-left pixel: `depthmap_to_camera_coordinates`."""

View = dict[str, Any]


def dust3r_views(sample: Sample, *, dataset: str = DATASET) -> list[View]:
    """Return a sample's pictures as view dicts of DUSt3R and MASt3R.

    Args:
        sample: A pair or views of one frame, as `posed_images` takes them.
        dataset: What the dicts call the dataset.

    Returns:
        For each view ``img`` (PIL, RGB), ``depthmap`` (h, w) float32 in metres with 0 where it is
        not measured, ``camera_pose`` (4, 4) float32 from the camera to a world with its origin at
        the first view's camera, ``camera_intrinsics`` (3, 3) float32 with cx and cy half a pixel
        less than ours, and the texts ``dataset``, ``label`` (scene and frame), ``instance``
        (camera).

    Raises:
        FieldError: If a field is missing, or the sample is not of one frame.

    Source: naver/dust3r, dust3r/datasets/base/base_stereo_view_dataset.py, utils/geometry.py.
    """
    images = posed_images(sample)
    shift = origin_at(images[0])
    return [_dust3r_view(image.in_world(shift), dataset=dataset) for image in images]


def _dust3r_view(image: PosedImage, *, dataset: str) -> View:
    intrinsics = image.intrinsics_for(centre_px=DUST3R_CENTRE_PX)
    return {
        "img": Image.fromarray(image.rgb),
        "depthmap": np.ascontiguousarray(image.depth_m),
        "camera_pose": image.world_from_cam.astype(np.float32),
        "camera_intrinsics": intrinsics.astype(np.float32),
        "dataset": dataset,
        "label": f"{image.scene}/{image.frame:03d}",
        "instance": f"cam_{image.camera:02d}",
    }


class DUSt3RViews(Dataset[list[View]]):
    """Pairs, or several views of a moment, as lists of DUSt3R's view dicts; see `dust3r_views`.

    For DUSt3R's own training, which crops, scales and collates, put `DUSt3RMixin` in front of its
    base class.
    """

    def __init__(
        self,
        data: Data,
        *,
        cameras: Sequence[int] | Literal["all"] | None = None,
        dataset: str = DATASET,
        **options: Any,
    ) -> None:
        """Select the samples; no video is opened before the first one is asked for.

        Args:
            data: As for `StereoPairs`.
            cameras: None for pairs of views; else the cameras, or "all", whose views of a moment
                make one list.
            dataset: What the dicts call the dataset.
            **options: As for `StereoPairs`, or for `SceneViews` where ``cameras`` is given: frames,
                size, depth, filters, of pairs also pairs, direction and baseline_cm. ``split`` is
                "train" unless evaluation data are asked for in so many words.

        Raises:
            StereoGenBenchError: As `StereoPairs` or `SceneViews` does.
        """
        self._dataset = dataset
        index = index_of(data)
        options["split"] = training_filters(index, SceneFilters(split=options.get("split")))[
            "split"
        ]
        self.samples: StereoPairs | SceneViews
        if cameras is None:
            self.samples = StereoPairs(index, fields=PAIR_FIELDS, **options)
            self.num_views = 2
        else:
            self.samples = SceneViews(index, cameras=cameras, fields=VIEW_FIELDS, **options)
            self.num_views = 1 + int(self.samples.plan.pairs.targets.shape[1])

    def __len__(self) -> int:
        """Return the number of lists."""
        return len(self.samples)

    def __getitem__(self, number: int) -> list[View]:
        """Return the views of a pair or of a moment.

        Raises:
            IndexError: If there is none of that number.
            StorageError: If a file is missing or altered.
            MediaError: If a video does not decode to what the index says.
        """
        return dust3r_views(self.samples[number], dataset=self._dataset)


class DUSt3RMixin:
    """What stands in front of the base class of DUSt3R, MASt3R or CUT3R to train on these views.

    ``class StereoGenBench(DUSt3RMixin, BaseStereoViewDataset)`` is constructed with a
    `DUSt3RViews` and the base's own arguments:
    ``StereoGenBench(DUSt3RViews("shards/", pairs="all"), resolution=(512, 384), aug_crop=16)``.
    The bases are DUSt3R's ``BaseStereoViewDataset``, MASt3R's ``MASt3RBaseStereoViewDataset`` and
    CUT3R's ``BaseMultiViewDataset``, which is told its ``num_views`` and takes so many of a moment.

    Source: the files of these classes in naver/dust3r, naver/mast3r and CUT3R/CUT3R.
    """

    def __init__(self, views: DUSt3RViews, **base_options: Any) -> None:
        """Take the views; everything else is the base's.

        Args:
            views: The views.
            **base_options: Passed on: split, resolution, transform, aug_crop, seed, ...

        Raises:
            SelectionError: If ``num_views`` is more than there are.
        """
        super().__init__(**base_options)
        self.views = views
        self.num_views = int(base_options.get("num_views", views.num_views))
        if self.num_views > views.num_views:
            raise SelectionError(
                f"num_views={self.num_views}, but the views are lists of {views.num_views}: choose "
                "more cameras, or fewer views."
            )
        self.is_metric_scale = True  # MASt3R's name for depth in metres

    def __len__(self) -> int:
        """Return the number of lists of views."""
        return len(self.views)

    def _get_views(
        self, idx: int, resolution: tuple[int, int], rng: Any, num_views: int | None = None
    ) -> list[View]:
        """Return views cropped and scaled by the base to one of its resolutions."""
        base: Any = self
        views = self.views[idx]
        if num_views is not None:
            views = [views[place] for place in rng.permutation(len(views))[:num_views]]
        for number, view in enumerate(views):
            view["img"], view["depthmap"], intrinsics = base._crop_resize_if_necessary(
                view["img"],
                view["depthmap"],
                view["camera_intrinsics"],
                resolution,
                rng=rng,
                info=(idx, number),
            )
            view["camera_intrinsics"] = np.asarray(intrinsics, dtype=np.float32)
            if num_views is not None:
                shows, maps_rays = base.get_img_and_ray_masks(True, number, rng)  # noqa: FBT003
                view |= _OF_CUT3R | {"img_mask": shows, "ray_mask": maps_rays}
        return views


_OF_CUT3R: Final = {
    "is_metric": True, "is_video": False, "quantile": np.array(1.0, dtype=np.float32),
    "camera_only": False, "depth_only": False, "single_view": False, "reset": False,
}  # fmt: skip
"""What CUT3R's views say of themselves besides."""


Prepare = Callable[..., tuple[Any, ...]]
"""VGGT's ``process_one_image``: crops and scales a picture and computes its points."""


class VGGTViews:
    """Sequences of views as records of VGGT's ``get_data``.

    For VGGT's own training, which crops, scales and collates, put `VGGTMixin` in front of its
    ``BaseDataset``.
    """

    def __init__(  # noqa: PLR0913 - each names one thing that a user chooses
        self,
        data: Data,
        *,
        sequence: Literal["moment", "scene"] = "moment",
        cameras: Sequence[int] | Literal["all"] = "all",
        frames: FramesSpec = "first",
        size: tuple[int, int] | str | None = None,
        depth: DepthEncoding | None = None,
        pixel_centre_px: float | Literal["installed"] = "installed",
        cache: ShardCache | None = None,
        **filters: Unpack[SceneFilters],
    ) -> None:
        """Select the sequences; no video is opened before the first record is asked for.

        Args:
            data: As for `StereoPairs`.
            sequence: "moment": the views of one frame, in which nothing moves; "scene": those of
                all the chosen frames, in which characters move.
            cameras: Which cameras.
            frames: As for `StereoPairs`, but no clips.
            size: (height, width) in pixels, or a text WIDTHxHEIGHT; None for the stored size.
            depth: A depth contract instead of the one that files and release state.
            pixel_centre_px: Where the code that takes the records puts the centre of the top-left
                pixel: 0.0 or 0.5, which moves cx and cy. "installed" asks the installed ``vggt``,
                and is 0.0, as on its main branch, where there is none. VGGT-Omega has 0.5.
            cache: Where to keep what comes from a URL, or None.
            **filters: Filters on scenes (`SceneFilters`); ``split`` is "train" unless evaluation
                data are asked for in so many words.

        Raises:
            SelectionError: If nothing matches, frames are clips, or ``sequence`` is
                neither.
            FieldError: If the size is not one.
            StorageError: If the data are not there, or lack a video that is needed.
            MediaError: If depth cannot have been stored whole.
        """
        if sequence not in ("moment", "scene"):
            raise SelectionError(f"sequence must be 'moment' or 'scene', got {sequence!r}.")
        index = index_of(data)
        filters = training_filters(index, filters)
        plan = plan_views(index, cameras=cameras, frames=frames, seed=0, filters=filters)
        if plan.windows.is_clip:
            raise SelectionError(
                f"frames={frames!r} are clips: a sequence of several frames is sequence='scene' "
                "with frames='all' or numbers of frames."
            )
        self._reader = PosedImageReader(index, size=size, depth=depth, cache=cache)
        check_samples(index, plan, self._reader.request)
        self._keys = index.column("key")
        self._plan = plan
        self._cameras = 1 + int(plan.pairs.targets.shape[1])
        self._sequence = sequence
        self._firsts = plan.first_sample if sequence == "scene" else np.arange(len(plan) + 1)
        self._centre_px = (
            _installed_centre_px() if pixel_centre_px == "installed" else pixel_centre_px
        )

    def __len__(self) -> int:
        """Return the number of sequences."""
        return len(self._firsts) - 1

    def sequence_name(self, number: int) -> str:
        """Return the key of a sequence's scene, with the frame where it is one moment."""
        address = self._plan.locate(int(self._firsts[number]), epoch=0)
        key = str(self._keys[address.row])
        return key if self._sequence == "scene" else f"{key}/{address.frames[0]:03d}"

    def view_count(self, number: int) -> int:
        """Return how many views a sequence has."""
        moments = int(self._firsts[number + 1] - self._firsts[number])
        return moments * self._cameras

    def get_data(  # noqa: PLR0913 - the parameters are VGGT's
        self,
        seq_index: int | None = None,
        img_per_seq: int | None = None,
        seq_name: str | None = None,
        ids: Sequence[int] | None = None,
        aspect_ratio: float = 1.0,
        *,
        repeats: Literal["never", "where too few", "always"] = "where too few",
        prepare: Prepare | None = None,
    ) -> dict[str, Any]:
        """Return one sequence as VGGT's datasets do.

        Args:
            seq_index: Number of the sequence; what is beyond the last begins anew.
            img_per_seq: How many views, drawn by torch's generator, which the workers of a loader
                seed; None for all, in order.
            seq_name: Its name instead of its number.
            ids: Numbers of the views in the sequence instead of drawn ones.
            aspect_ratio: Height divided by width: for ``prepare``.
            repeats: Whether a view may be drawn twice.
            prepare: What crops and scales each picture; None gives it as it is.

        Returns:
            ``seq_name``, ``ids`` (n,) int64 and ``frame_num`` n; lists of n: ``images`` (h, w, 3)
            uint8, ``depths`` (h, w) float32 in metres, ``extrinsics`` (3, 4) float64 from the world
            to the camera, ``intrinsics`` (3, 3) float64, ``cam_points`` and ``world_points``
            (h, w, 3) float32, ``point_masks`` (h, w) bool, ``original_sizes`` (height, width). The
            world's origin is at the first view's camera. ``tracks`` is None: VGGT makes them.

        Raises:
            SelectionError: If there is no such sequence or view, or too few views.
            StorageError: If a file is missing or altered.
            MediaError: If a video does not decode to what the index says.

        Source: facebookresearch/vggt, training/data/base_dataset.py, datasets/vkitti.py.
        """
        del aspect_ratio  # the pictures are as they are, unless `prepare` crops them
        number = self._number(seq_index, seq_name)
        chosen = self._chosen(number, img_per_seq, ids, repeats=repeats)
        record: dict[str, Any] = {
            "seq_name": f"{DATASET}_{self.sequence_name(number)}",
            "dataset": DATASET,
            "is_synthetic": True,
            "ids": chosen,
            "frame_num": len(chosen),
        }
        lists: dict[str, list[Any]] = {name: [] for name in _VGGT_LISTS}
        shift = None
        for view in chosen:
            moment, place = divmod(int(view), self._cameras)
            address = self._plan.locate(int(self._firsts[number]) + moment, epoch=0)
            camera = (address.source, *address.targets)[place]
            image = self._reader.read(address.row, camera, address.frames[0])
            shift = origin_at(image) if shift is None else shift
            for name, value in self._record(image.in_world(shift), prepare).items():
                lists[name].append(value)
        return record | lists | {"tracks": None, "track_masks": None}

    def _number(self, seq_index: int | None, seq_name: str | None) -> int:
        if seq_name is not None:
            name = seq_name.removeprefix(f"{DATASET}_")
            key = name if self._sequence == "scene" else name.rpartition("/")[0]
            rows = np.flatnonzero(self._keys == key)
            first = int(np.searchsorted(self._plan.scene_rows, rows[0])) if len(rows) else 0
            numbers = range(*np.searchsorted(self._firsts, self._plan.first_sample[first:][:2]))
            found = [number for number in numbers if self.sequence_name(number) == name]
            if not found:
                raise SelectionError(
                    f"there is no sequence {seq_name!r}; the first of {len(self)} is "
                    f"{self.sequence_name(0)!r}."
                )
            return found[0]
        if seq_index is None:
            raise SelectionError("give seq_index or seq_name: a sequence is one or the other.")
        return int(seq_index) % len(self)

    def _chosen(
        self,
        number: int,
        img_per_seq: int | None,
        ids: Sequence[int] | None,
        *,
        repeats: Literal["never", "where too few", "always"],
    ) -> Any:
        count, name = self.view_count(number), self.sequence_name(number)
        if ids is not None:
            chosen = np.asarray(ids, dtype=np.int64)
            if chosen.ndim != 1 or not len(chosen) or chosen.min() < 0 or chosen.max() >= count:
                raise SelectionError(
                    f"{name} has views 0 to {count - 1}, got ids={np.asarray(ids).tolist()}."
                )
            return chosen
        if img_per_seq is None:
            return np.arange(count)
        if img_per_seq < 1 or (img_per_seq > count and repeats == "never"):
            raise SelectionError(
                f"{name} has {count} views, got img_per_seq={img_per_seq}: ask for 1 to {count}, "
                "allow repeats, or take sequence='scene'."
            )
        if repeats == "always" or img_per_seq > count:
            return torch.randint(count, (img_per_seq,)).numpy()
        return torch.randperm(count)[:img_per_seq].numpy()

    def _record(self, image: PosedImage, prepare: Prepare | None) -> dict[str, Any]:
        """Return the values of one picture by the names of the record's lists."""
        intrinsics = image.intrinsics_for(centre_px=self._centre_px)
        extrinsics = image.cam_from_world[:3]
        original_size = np.array(image.size)
        if prepare is not None:
            values = prepare(image.rgb, image.depth_m, extrinsics, intrinsics, original_size)
            return dict(zip(_VGGT_PREPARED, values, strict=False)) | {
                "original_sizes": original_size
            }
        rows, columns = np.indices(image.size)
        return {
            "images": image.rgb,
            "depths": np.ascontiguousarray(image.depth_m),
            "extrinsics": extrinsics,
            "intrinsics": intrinsics,
            "cam_points": image.points_cam(rows, columns).astype(np.float32),
            "world_points": image.points_world(rows, columns).astype(np.float32),
            "point_masks": image.depth_m > 0,
            "original_sizes": original_size,
        }


_VGGT_PREPARED: Final = (
    "images", "depths", "extrinsics", "intrinsics", "world_points", "cam_points", "point_masks",
)  # fmt: skip
"""What ``process_one_image`` returns, in its order; tracks follow."""
_VGGT_LISTS: Final = (*_VGGT_PREPARED, "original_sizes")


def _installed_centre_px() -> float:
    """Return where the installed vggt unprojects the top-left pixel, 0.0 if none is installed."""
    try:
        from vggt.utils.geometry import depth_to_cam_coords_points
    except ImportError:
        return 0.0
    return float(depth_to_cam_coords_points(np.ones((1, 1), dtype=np.float32), np.eye(3))[0, 0, 0])


class VGGTMixin:
    """What stands in front of VGGT's ``BaseDataset`` to train on these views.

    ``class StereoGenBench(VGGTMixin, BaseDataset)`` is what the configuration of a dataset names as
    ``_target_``, with ``views`` a `VGGTViews`, configured the same way.
    """

    def __init__(self, common_conf: Any, *, views: VGGTViews, len_train: int | None = None) -> None:
        """Take the views; everything else is the base's.

        Args:
            common_conf: VGGT's common configuration.
            views: The views.
            len_train: How many samples an epoch has [the number of sequences].
        """
        base: Any = super()  # VGGT's BaseDataset, where this class stands in front of it
        base.__init__(common_conf=common_conf)
        self.views = views
        self.training = common_conf.training
        self.inside_random = common_conf.inside_random
        self.allow_duplicate_img = common_conf.allow_duplicate_img
        self.len_train = len(views) if len_train is None else len_train

    def get_data(
        self,
        seq_index: int | None = None,
        img_per_seq: int | None = None,
        seq_name: str | None = None,
        ids: Sequence[int] | None = None,
        aspect_ratio: float = 1.0,
    ) -> dict[str, Any]:
        """Return a sequence whose pictures the base has cropped and scaled; see `VGGTViews`."""
        base: Any = self
        if self.inside_random:
            seq_index, seq_name = int(torch.randint(len(self.views), ())), None
        return self.views.get_data(
            seq_index=seq_index,
            img_per_seq=img_per_seq,
            seq_name=seq_name,
            ids=ids,
            repeats="always" if self.allow_duplicate_img else "never",
            prepare=partial(
                base.process_one_image, target_image_shape=base.get_target_shape(aspect_ratio)
            ),
        )
