"""Pairs and views as DUSt3R, MASt3R and CUT3R train on them: behind their own base class.

Copy the class into the project. For MASt3R the base is ``MASt3RBaseStereoViewDataset``, for CUT3R
``BaseMultiViewDataset``, which asks for ``num_views`` of the views of a moment:

    samples = StereoPairs("shards/", split="train", pairs="all", frames="all", fields=PAIR_FIELDS)
    samples = SceneViews("shards/", split="train", frames="all", fields=VIEW_FIELDS)
    dataset = StereoGenBench(samples, split="train", resolution=[(512, 384)], aug_crop=16)

Both tuples of fields are in `stereogenbench_data.bridges.multiview`. The bases'
``_crop_resize_if_necessary`` crops, scales and moves the intrinsics with it.
Source: naver/dust3r, naver/mast3r and CUT3R/CUT3R, the files of these classes.
"""

import numpy as np
from dust3r.datasets.base.base_stereo_view_dataset import BaseStereoViewDataset

from stereogenbench_data import SceneViews, StereoPairs
from stereogenbench_data.bridges.multiview import dust3r_views

OF_CUT3R = {
    "is_metric": True, "is_video": False, "quantile": np.array(1.0, dtype=np.float32),
    "camera_only": False, "depth_only": False, "single_view": False, "reset": False,
}  # fmt: skip


class StereoGenBench(BaseStereoViewDataset):
    """Lists of views of StereoGenBench."""

    def __init__(self, samples: StereoPairs | SceneViews, **base_options) -> None:
        super().__init__(**base_options)
        self.samples = samples
        views = 1 + samples.plan.pairs.targets.shape[1]
        self.num_views = base_options.get("num_views", views)
        self.is_metric_scale = True  # MASt3R's name for depth in metres

    def __len__(self) -> int:
        return len(self.samples)

    def _get_views(self, idx, resolution, rng, num_views=None):
        views = dust3r_views(self.samples[idx])
        if num_views is not None:
            views = [views[place] for place in rng.permutation(len(views))[:num_views]]
        for number, view in enumerate(views):
            view["img"], view["depthmap"], intrinsics = self._crop_resize_if_necessary(
                view["img"], view["depthmap"], view["camera_intrinsics"], resolution,
                rng=rng, info=(idx, number),
            )  # fmt: skip
            view["camera_intrinsics"] = np.asarray(intrinsics, dtype=np.float32)
            if num_views is not None:  # only CUT3R asks for a number
                shows, maps_rays = self.get_img_and_ray_masks(True, number, rng)  # noqa: FBT003
                view |= OF_CUT3R | {"img_mask": shows, "ray_mask": maps_rays}
        return views
