"""Several views of a moment as VGGT trains on them: behind its own ``BaseDataset``.

Copy the class into ``training/data/datasets/stereogenbench.py`` and name it in the configuration:

    - _target_: data.datasets.stereogenbench.StereoGenBench
      len_train: 100000
      data: /data/shards
      frames: all

The base's ``process_one_image`` crops and scales a picture and computes its points.
Source: facebookresearch/vggt, training/data/base_dataset.py and datasets/vkitti.py.
"""

import numpy as np
import torch
from data.base_dataset import BaseDataset

from stereogenbench_data import SceneViews
from stereogenbench_data.bridges.multiview import VIEW_FIELDS, vggt_record

PREPARED = ("images", "depths", "extrinsics", "intrinsics", "world_points", "cam_points",
            "point_masks")  # fmt: skip


class StereoGenBench(BaseDataset):
    """Moments of StereoGenBench, each a sequence by its number."""

    def __init__(self, common_conf, data, frames="first", len_train: int | None = None) -> None:
        super().__init__(common_conf=common_conf)
        self.moments = SceneViews(data, split="train", frames=frames, fields=VIEW_FIELDS)
        self.len_train = len_train or len(self.moments)
        self.training = common_conf.training
        self.inside_random = common_conf.inside_random
        self.allow_duplicate_img = common_conf.allow_duplicate_img

    def get_data(
        self, seq_index=None, img_per_seq=None, seq_name=None, ids=None, aspect_ratio=1.0
    ) -> dict:
        if self.inside_random:
            seq_index = int(torch.randint(len(self.moments), ()))
        moment = self.moments[seq_index % len(self.moments)]
        count = len(moment["image"])
        if ids is None and img_per_seq:
            draws_twice = self.allow_duplicate_img or img_per_seq > count
            drawn = torch.randint(count, (img_per_seq,)) if draws_twice else torch.randperm(count)
            ids = drawn[:img_per_seq].numpy()
        record = vggt_record(moment, ids=ids)
        plain = [record.pop(name) for name in ("images", "depths", "extrinsics", "intrinsics")]
        shape = self.get_target_shape(aspect_ratio)
        prepared = [
            self.process_one_image(*view, np.array(view[0].shape[:2]), shape)
            for view in zip(*plain, strict=True)
        ]
        return record | {
            name: [values[place] for values in prepared] for place, name in enumerate(PREPARED)
        }
