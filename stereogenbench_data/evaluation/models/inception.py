"""The features of FID: the 2048 pooled numbers of the Inception network that FID was defined with.

That network is not the one of torchvision: its average pools leave the border out, its last pool
takes the maximum, and pictures come to it through TensorFlow 1's bilinear resize, which samples
at the corner of a pixel and does not smooth. Tensors are named as in the files of its weights.
"""

from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float64
from torch import nn
from torch.nn import functional

from stereogenbench_data.evaluation.models.interfaces import Pictures, Settings, require_batch
from stereogenbench_data.evaluation.models.weights import (
    Weights,
    fingerprint,
    load_into,
    read_weights,
    weights_path,
)

INCEPTION: Final = Weights(
    what="FID's Inception",
    file="weights-inception-2015-12-05-6726825d.pth",
    source="https://github.com/toshas/torch-fidelity/releases/download/v0.2.0/"
    "weights-inception-2015-12-05-6726825d.pth",
    licence="Apache-2.0",
)
_SIDE_PX: Final = 299
_DIM: Final = 2048
_CLASSES: Final = 1008
_BATCH: Final = 8


class InceptionFeatures:
    """FID's features of pictures.

    Attributes:
        name: What tables call it.
        distance: What a Fréchet distance of these features is called.
        dim: How many features there are.
        settings: Every choice that the features depend on.
    """

    name = "Inception-v3 (TensorFlow, 2015-12-05)"
    distance = "FID"
    dim = _DIM

    def __init__(self, *, weights: Path | None = None, device: str = "cpu") -> None:
        """Load the network.

        Args:
            weights: The folder of its file; None for that of torch.hub's checkpoints.
            device: Where to compute.

        Raises:
            ExtraError: If the file is missing.
            EvaluationError: If it does not hold this network's weights.
        """
        path = weights_path(INCEPTION, folder=weights)
        network = Inception()
        load_into(network, read_weights(path, what=INCEPTION.what), path=path)
        self._network = network.to(device)
        self._device = device
        self.settings: Settings = {
            "layer": "pool3, 2048",
            "resize": "TensorFlow 1 bilinear to 299x299, corners not aligned, no smoothing",
            "weights": path.name,
            "weights_sha256": fingerprint(path),
            "precision": "float32",
        }

    def __call__(self, pictures: Pictures) -> Float64[np.ndarray, "n dim"]:
        """Return the features of each picture.

        Raises:
            EvaluationError: If they are no pictures.
        """
        require_batch(pictures)
        features = np.empty((len(pictures), _DIM))
        with torch.inference_mode():
            for start in range(0, len(pictures), _BATCH):
                some = torch.from_numpy(pictures[start : start + _BATCH].copy()).to(self._device)
                features[start : start + _BATCH] = self._network(some.float()).cpu().numpy()
        return features


class Inception(nn.Module):
    """From pictures (n, 3, h, w) of 0 to 255 to 2048 features each."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = _Conv(3, 32, 3, stride=2)
        self.Conv2d_2a_3x3 = _Conv(32, 32, 3)
        self.Conv2d_2b_3x3 = _Conv(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1 = _Conv(64, 80, 1)
        self.Conv2d_4a_3x3 = _Conv(80, 192, 3)
        self.Mixed_5b = _MixedA(192, pooled=32)
        self.Mixed_5c = _MixedA(256, pooled=64)
        self.Mixed_5d = _MixedA(288, pooled=64)
        self.Mixed_6a = _MixedB()
        self.Mixed_6b = _MixedC(between=128)
        self.Mixed_6c = _MixedC(between=160)
        self.Mixed_6d = _MixedC(between=160)
        self.Mixed_6e = _MixedC(between=192)
        self.Mixed_7a = _MixedD()
        self.Mixed_7b = _MixedE(1280, pool="mean")
        self.Mixed_7c = _MixedE(2048, pool="max")
        self.fc = nn.Linear(_DIM, _CLASSES)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """Return features (n, 2048)."""
        x = (_resized(pictures) - 128) / 128
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))
        x = self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(functional.max_pool2d(x, 3, stride=2)))
        x = functional.max_pool2d(x, 3, stride=2)
        x = self.Mixed_6a(self.Mixed_5d(self.Mixed_5c(self.Mixed_5b(x))))
        x = self.Mixed_6e(self.Mixed_6d(self.Mixed_6c(self.Mixed_6b(x))))
        pooled: torch.Tensor = self.Mixed_7c(self.Mixed_7b(self.Mixed_7a(x))).mean(dim=(2, 3))
        return pooled


class _Conv(nn.Module):
    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int | tuple[int, int],
        *,
        stride: int = 1,
        padding: int | tuple[int, int] = 0,
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.relu(self.bn(self.conv(x)))


class _Branches(nn.Module):
    """Branches side by side, of convolutions that are made here by the names of their weights."""

    def chain(self, x: torch.Tensor, branch: str, *steps: str) -> torch.Tensor:
        """Return what a branch's convolutions make of x, one after the other."""
        for step in steps:
            x = self.get_submodule(f"{branch}_{step}")(x)
        return x


class _MixedA(_Branches):
    def __init__(self, inputs: int, *, pooled: int) -> None:
        super().__init__()
        self.branch1x1 = _Conv(inputs, 64, 1)
        self.branch5x5_1 = _Conv(inputs, 48, 1)
        self.branch5x5_2 = _Conv(48, 64, 5, padding=2)
        self.branch3x3dbl_1 = _Conv(inputs, 64, 1)
        self.branch3x3dbl_2 = _Conv(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = _Conv(96, 96, 3, padding=1)
        self.branch_pool = _Conv(inputs, pooled, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat(
            [
                self.branch1x1(x),
                self.chain(x, "branch5x5", "1", "2"),
                self.chain(x, "branch3x3dbl", "1", "2", "3"),
                self.branch_pool(_mean_pool(x)),
            ],
            dim=1,
        )


class _MixedB(_Branches):
    def __init__(self) -> None:
        super().__init__()
        self.branch3x3 = _Conv(288, 384, 3, stride=2)
        self.branch3x3dbl_1 = _Conv(288, 64, 1)
        self.branch3x3dbl_2 = _Conv(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = _Conv(96, 96, 3, stride=2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        double = self.chain(x, "branch3x3dbl", "1", "2", "3")
        return torch.cat([self.branch3x3(x), double, functional.max_pool2d(x, 3, 2)], dim=1)


class _MixedC(_Branches):
    def __init__(self, *, between: int) -> None:
        super().__init__()
        self.branch1x1 = _Conv(768, 192, 1)
        self.branch7x7_1 = _Conv(768, between, 1)
        self.branch7x7_2 = _Conv(between, between, (1, 7), padding=(0, 3))
        self.branch7x7_3 = _Conv(between, 192, (7, 1), padding=(3, 0))
        self.branch7x7dbl_1 = _Conv(768, between, 1)
        self.branch7x7dbl_2 = _Conv(between, between, (7, 1), padding=(3, 0))
        self.branch7x7dbl_3 = _Conv(between, between, (1, 7), padding=(0, 3))
        self.branch7x7dbl_4 = _Conv(between, between, (7, 1), padding=(3, 0))
        self.branch7x7dbl_5 = _Conv(between, 192, (1, 7), padding=(0, 3))
        self.branch_pool = _Conv(768, 192, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat(
            [
                self.branch1x1(x),
                self.chain(x, "branch7x7", "1", "2", "3"),
                self.chain(x, "branch7x7dbl", "1", "2", "3", "4", "5"),
                self.branch_pool(_mean_pool(x)),
            ],
            dim=1,
        )


class _MixedD(_Branches):
    def __init__(self) -> None:
        super().__init__()
        self.branch3x3_1 = _Conv(768, 192, 1)
        self.branch3x3_2 = _Conv(192, 320, 3, stride=2)
        self.branch7x7x3_1 = _Conv(768, 192, 1)
        self.branch7x7x3_2 = _Conv(192, 192, (1, 7), padding=(0, 3))
        self.branch7x7x3_3 = _Conv(192, 192, (7, 1), padding=(3, 0))
        self.branch7x7x3_4 = _Conv(192, 192, 3, stride=2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        small = self.chain(x, "branch3x3", "1", "2")
        large = self.chain(x, "branch7x7x3", "1", "2", "3", "4")
        return torch.cat([small, large, functional.max_pool2d(x, 3, 2)], dim=1)


class _MixedE(_Branches):
    def __init__(self, inputs: int, *, pool: str) -> None:
        super().__init__()
        self.pool = pool
        self.branch1x1 = _Conv(inputs, 320, 1)
        self.branch3x3_1 = _Conv(inputs, 384, 1)
        self.branch3x3_2a = _Conv(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3_2b = _Conv(384, 384, (3, 1), padding=(1, 0))
        self.branch3x3dbl_1 = _Conv(inputs, 448, 1)
        self.branch3x3dbl_2 = _Conv(448, 384, 3, padding=1)
        self.branch3x3dbl_3a = _Conv(384, 384, (1, 3), padding=(0, 1))
        self.branch3x3dbl_3b = _Conv(384, 384, (3, 1), padding=(1, 0))
        self.branch_pool = _Conv(inputs, 192, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        single = self.branch3x3_1(x)
        double = self.chain(x, "branch3x3dbl", "1", "2")
        pooled = _mean_pool(x) if self.pool == "mean" else functional.max_pool2d(x, 3, 1, 1)
        return torch.cat(
            [
                self.branch1x1(x),
                self.branch3x3_2a(single),
                self.branch3x3_2b(single),
                self.branch3x3dbl_3a(double),
                self.branch3x3dbl_3b(double),
                self.branch_pool(pooled),
            ],
            dim=1,
        )


def _mean_pool(x: torch.Tensor) -> torch.Tensor:
    """Return 3 x 3 means of what lies inside."""
    return functional.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)


def _resized(pictures: torch.Tensor) -> torch.Tensor:
    """Return pictures of 299 x 299, pixel i taken at i times the scale, between two neighbours."""
    columns, to_right = _neighbours(pictures.shape[3], like=pictures)
    rows, down = _neighbours(pictures.shape[2], like=pictures)
    left, right = (pictures[..., column] for column in columns)
    across = left + (right - left) * to_right
    above, below = (across[..., row, :] for row in rows)
    return above + (below - above) * down[:, None]


def _neighbours(
    side_px: int, *, like: torch.Tensor
) -> tuple[tuple[torch.Tensor, torch.Tensor], torch.Tensor]:
    scale = torch.tensor(side_px / _SIDE_PX, dtype=torch.float32, device=like.device)
    place = torch.arange(_SIDE_PX, dtype=torch.float32, device=like.device) * scale
    low = place.long()
    return (low, (low + 1).clamp_max(side_px - 1)), place - low
