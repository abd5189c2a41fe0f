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

from collections.abc import Sequence
from typing import Any, Final, Literal, Unpack

import numpy as np
import torch
from PIL import Image
from torch.utils.data import Dataset

from stereogenbench_data.bridges.exports import training_selection
from stereogenbench_data.bridges.posed_images import (
    PAIR_FIELDS,
    VIEW_FIELDS,
    PosedImage,
    PosedImageReader,
    index_of,
    origin_at,
    posed_images,
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

    `examples/dust3r_dataset.py` puts them behind DUSt3R's own base class, which crops and scales.
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
        options, _ = training_selection(index, options)
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


class VGGTViews:
    """Sequences of views as records of VGGT's ``get_data``.

    `examples/vggt_dataset.py` puts them behind VGGT's own ``BaseDataset``, which crops and scales.
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
        pixel_centre_px: float = 0.0,
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
                pixel: 0.0, as VGGT's main branch, or 0.5, as VGGT-Omega. It moves cx and cy.
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
        chosen: Any = training_selection(index, filters)[0]
        plan = plan_views(index, cameras=cameras, frames=frames, seed=0, filters=chosen)
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
        self._centre_px = pixel_centre_px

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

    def get_data(
        self,
        seq_index: int | None = None,
        img_per_seq: int | None = None,
        seq_name: str | None = None,
        ids: Sequence[int] | None = None,
        aspect_ratio: float = 1.0,
    ) -> dict[str, Any]:
        """Return one sequence as VGGT's datasets do.

        Args:
            seq_index: Number of the sequence; what is beyond the last begins anew.
            img_per_seq: How many views, drawn by torch's generator, which the workers of a loader
                seed; None for all, in order. Views are drawn twice only where there are too few.
            seq_name: Its name instead of its number.
            ids: Numbers of the views in the sequence instead of drawn ones.
            aspect_ratio: Not used: pictures are as they are.

        Returns:
            ``seq_name``, ``ids`` (n,) int64 and ``frame_num`` n; lists of n: ``images`` (h, w, 3)
            uint8, ``depths`` (h, w) float32 in metres, ``extrinsics`` (3, 4) float64 from the world
            to the camera, ``intrinsics`` (3, 3) float64, ``cam_points`` and ``world_points``
            (h, w, 3) float32, ``point_masks`` (h, w) bool, ``original_sizes`` (height, width). The
            world's origin is at the first view's camera. ``tracks`` is None: VGGT makes them.

        Raises:
            SelectionError: If there is no such sequence or view.
            StorageError: If a file is missing or altered.
            MediaError: If a video does not decode to what the index says.

        Source: facebookresearch/vggt, training/data/base_dataset.py, datasets/vkitti.py.
        """
        del aspect_ratio
        number = self._number(seq_index, seq_name)
        chosen = self._chosen(number, img_per_seq, ids)
        record: dict[str, Any] = {
            "seq_name": f"{DATASET}_{self.sequence_name(number)}",
            "dataset": DATASET,
            "is_synthetic": True,
            "ids": chosen,
            "frame_num": len(chosen),
        }
        lists: dict[str, list[Any]] = {}
        shift = None
        for view in chosen:
            moment, place = divmod(int(view), self._cameras)
            address = self._plan.locate(int(self._firsts[number]) + moment, epoch=0)
            camera = (address.source, *address.targets)[place]
            image = self._reader.read(address.row, camera, address.frames[0])
            shift = origin_at(image) if shift is None else shift
            for name, value in self._record(image.in_world(shift)).items():
                lists.setdefault(name, []).append(value)
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
        if img_per_seq < 1:
            raise SelectionError(f"img_per_seq must be at least 1, got {img_per_seq!r}.")
        if img_per_seq > count:
            return torch.randint(count, (img_per_seq,)).numpy()
        return torch.randperm(count)[:img_per_seq].numpy()

    def _record(self, image: PosedImage) -> dict[str, Any]:
        """Return the values of one picture by the names of the record's lists."""
        rows, columns = np.indices(image.size)
        return {
            "images": image.rgb,
            "depths": np.ascontiguousarray(image.depth_m),
            "extrinsics": image.cam_from_world[:3],
            "intrinsics": image.intrinsics_for(centre_px=self._centre_px),
            "cam_points": image.points_cam(rows, columns).astype(np.float32),
            "world_points": image.points_world(rows, columns).astype(np.float32),
            "point_masks": image.depth_m > 0,
            "original_sizes": np.array(image.size),
        }
