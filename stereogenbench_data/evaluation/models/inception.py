"""The features of FID: the 2048 pooled numbers of the Inception network that FID was defined with.

It differs from torchvision's network: its average pools leave out the border, its last pool takes
the maximum, and it resizes pictures as TensorFlow 1 does, bilinearly from pixel corners and
without smoothing. Layers are named as in the file of its weights.

The network of torch-fidelity 0.4 gives the same features bit for bit. It is not used because it
imports torchvision, each release of which fits one release and one build of torch only.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

import torch
from torch import nn
from torch.nn import functional

from stereogenbench_data.evaluation.models.loading import Network, Weights, load_weights

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


class InceptionFeatures(Network):
    """FID's features of pictures: from uint8 (n, 3, h, w) to (n, 2048)."""

    def __init__(self, *, weights: Path | None = None, device: str = "cpu") -> None:
        """Load the network; the arguments are those of `load_model`.

        Raises:
            ExtraError: If the file of weights is missing.
            EvaluationError: If it does not hold this network's weights.
        """
        network = Inception()
        settings = {
            "layer": "pool3, 2048",
            "resize": "TensorFlow 1 bilinear to 299x299, corners not aligned, no smoothing",
            **load_weights(network, INCEPTION, folder=weights),
        }
        super().__init__(network, settings=settings, device=device, rows=_BATCH)


class Inception(nn.Module):
    """From pictures (n, 3, h, w) of 0 to 255 to 2048 features each."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = _conv(3, 32, (3, 3), stride=2)
        self.Conv2d_2a_3x3 = _conv(32, 32, (3, 3))
        self.Conv2d_2b_3x3 = _conv(32, 64, (3, 3), padding=(1, 1))
        self.Conv2d_3b_1x1 = _conv(64, 80, (1, 1))
        self.Conv2d_4a_3x3 = _conv(80, 192, (3, 3))
        self.Mixed_5b = _Block(192, _branches_5(pooled=32), pool="mean")
        self.Mixed_5c = _Block(256, _branches_5(pooled=64), pool="mean")
        self.Mixed_5d = _Block(288, _branches_5(pooled=64), pool="mean")
        self.Mixed_6a = _Block(288, _BRANCHES_6A, pool="halve")
        self.Mixed_6b = _Block(768, _branches_6(between=128), pool="mean")
        self.Mixed_6c = _Block(768, _branches_6(between=160), pool="mean")
        self.Mixed_6d = _Block(768, _branches_6(between=160), pool="mean")
        self.Mixed_6e = _Block(768, _branches_6(between=192), pool="mean")
        self.Mixed_7a = _Block(768, _BRANCHES_7A, pool="halve")
        self.Mixed_7b = _Block(1280, _BRANCHES_7, pool="mean")
        self.Mixed_7c = _Block(2048, _BRANCHES_7, pool="max")
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


def _conv(
    inputs: int,
    outputs: int,
    kernel: tuple[int, int],
    *,
    stride: int = 1,
    padding: tuple[int, int] = (0, 0),
) -> nn.Sequential:
    layers: OrderedDict[str, nn.Module] = OrderedDict(
        conv=nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False),
        bn=nn.BatchNorm2d(outputs, eps=0.001),
        relu=nn.ReLU(),
    )
    return nn.Sequential(layers)


_Layer = tuple[int, int, int]
"""A convolution: how many channels it makes, and the rows and columns of its kernel."""
_Branches = Mapping[str, Sequence[Sequence[_Layer]]]
"""Branches of a block by name, each of steps one after another; a step is of one or two layers."""


def _branches_5(*, pooled: int) -> _Branches:
    return {
        "branch1x1": [[(64, 1, 1)]],
        "branch5x5": [[(48, 1, 1)], [(64, 5, 5)]],
        "branch3x3dbl": [[(64, 1, 1)], [(96, 3, 3)], [(96, 3, 3)]],
        "branch_pool": [[(pooled, 1, 1)]],
    }


_BRANCHES_6A: Final[_Branches] = {
    "branch3x3": [[(384, 3, 3)]],
    "branch3x3dbl": [[(64, 1, 1)], [(96, 3, 3)], [(96, 3, 3)]],
}


def _branches_6(*, between: int) -> _Branches:
    first, across, down = [(between, 1, 1)], [(between, 1, 7)], [(between, 7, 1)]
    return {
        "branch1x1": [[(192, 1, 1)]],
        "branch7x7": [first, across, [(192, 7, 1)]],
        "branch7x7dbl": [first, down, across, down, [(192, 1, 7)]],
        "branch_pool": [[(192, 1, 1)]],
    }


_BRANCHES_7A: Final[_Branches] = {
    "branch3x3": [[(192, 1, 1)], [(320, 3, 3)]],
    "branch7x7x3": [[(192, 1, 1)], [(192, 1, 7)], [(192, 7, 1)], [(192, 3, 3)]],
}
_BOTH_WAYS: Final = [(384, 1, 3), (384, 3, 1)]
_BRANCHES_7: Final[_Branches] = {
    "branch1x1": [[(320, 1, 1)]],
    "branch3x3": [[(384, 1, 1)], _BOTH_WAYS],
    "branch3x3dbl": [[(448, 1, 1)], [(384, 3, 3)], _BOTH_WAYS],
    "branch_pool": [[(192, 1, 1)]],
}


class _Block(nn.Module):
    """A block of parallel branches, concatenated; one that halves the size ends with its pool.

    In a block that halves, the last layer of each branch has a stride of 2 and no padding; all
    others keep the size.
    """

    def __init__(
        self, inputs: int, branches: _Branches, *, pool: Literal["mean", "max", "halve"]
    ) -> None:
        super().__init__()
        self.pool = pool
        self.steps: dict[str, list[list[str]]] = {}
        for branch, steps in branches.items():
            channels, self.steps[branch] = inputs, []
            for number, layers in enumerate(steps, 1):
                halves = pool == "halve" and number == len(steps)
                names = []
                for letter, (outputs, rows, columns) in zip("ab", layers, strict=False):
                    place = f"{number}{letter}" if len(layers) > 1 else f"{number}"
                    names.append(f"{branch}_{place}" if len(steps) > 1 else branch)
                    stride, padding = (2, (0, 0)) if halves else (1, (rows // 2, columns // 2))
                    kernel = rows, columns
                    conv = _conv(channels, outputs, kernel, stride=stride, padding=padding)
                    self.add_module(names[-1], conv)
                channels = layers[0][0]
                self.steps[branch].append(names)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.pool == "mean":
            pooled = functional.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)
        elif self.pool == "max":
            pooled = functional.max_pool2d(x, 3, stride=1, padding=1)
        else:
            pooled = functional.max_pool2d(x, 3, stride=2)
        made = []
        for branch, steps in self.steps.items():
            outputs = [pooled if branch == "branch_pool" else x]
            for names in steps:
                outputs = [self.get_submodule(name)(outputs[0]) for name in names]
            made += outputs
        return torch.cat([*made, pooled] if self.pool == "halve" else made, dim=1)


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
