"""Pairs and views as DUSt3R, MASt3R and CUT3R train on them: behind their own base class.

Copy the class into the project. For MASt3R the base is ``MASt3RBaseStereoViewDataset``, for CUT3R
``BaseMultiViewDataset``, which asks for ``num_views`` views of a moment (``cameras="all"``).

    views = DUSt3RViews("shards/", pairs="all", frames="all")
    dataset = StereoGenBench(views, split="train", resolution=[(512, 384)], aug_crop=16)

The bases' ``_crop_resize_if_necessary`` crops, scales and moves the intrinsics with it.
Source: naver/dust3r, naver/mast3r and CUT3R/CUT3R, the files of these classes.
"""

import numpy as np
from dust3r.datasets.base.base_stereo_view_dataset import BaseStereoViewDataset

from stereogenbench_data.bridges.multiview import DUSt3RViews

OF_CUT3R = {
    "is_metric": True, "is_video": False, "quantile": np.array(1.0, dtype=np.float32),
    "camera_only": False, "depth_only": False, "single_view": False, "reset": False,
}  # fmt: skip


class StereoGenBench(BaseStereoViewDataset):
    """Lists of views of StereoGenBench."""

    def __init__(self, views: DUSt3RViews, **base_options) -> None:
        super().__init__(**base_options)
        self.views = views
        self.num_views = base_options.get("num_views", views.num_views)
        self.is_metric_scale = True  # MASt3R's name for depth in metres

    def __len__(self) -> int:
        return len(self.views)

    def _get_views(self, idx, resolution, rng, num_views=None):
        views = self.views[idx]
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
