"""The features of FID: the 2048 pooled numbers of the Inception network that FID was defined with.

It differs from torchvision's network: its average pools leave out the border, its last pool takes
the maximum, and it resizes pictures as TensorFlow 1 does, bilinearly from pixel corners and
without smoothing. Layers are named as in the file of its weights.

The network of torch-fidelity 0.4 gives the same features bit for bit. It is not used because it
imports torchvision, each release of which fits one release and one build of torch only.
"""

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal, NamedTuple

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
        self.Mixed_5b = _Block(192, _layers_5(pooled=32), pool="mean")
        self.Mixed_5c = _Block(256, _layers_5(pooled=64), pool="mean")
        self.Mixed_5d = _Block(288, _layers_5(pooled=64), pool="mean")
        self.Mixed_6a = _Block(288, _LAYERS_6A, pool="halve")
        self.Mixed_6b = _Block(768, _layers_6(between=128), pool="mean")
        self.Mixed_6c = _Block(768, _layers_6(between=160), pool="mean")
        self.Mixed_6d = _Block(768, _layers_6(between=160), pool="mean")
        self.Mixed_6e = _Block(768, _layers_6(between=192), pool="mean")
        self.Mixed_7a = _Block(768, _LAYERS_7A, pool="halve")
        self.Mixed_7b = _Block(1280, _LAYERS_7, pool="mean")
        self.Mixed_7c = _Block(2048, _LAYERS_7, pool="max")
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


class _Layer(NamedTuple):
    """A convolution within a block.

    Attributes:
        of: The layer before it; "input" and "pool" are the block's input and its pool.
        outputs: How many channels it makes.
        kernel: (rows, columns).
        step: "same" keeps the size, "halve" has a stride of 2 and no padding.
    """

    of: str
    outputs: int
    kernel: tuple[int, int] = (1, 1)
    step: Literal["same", "halve"] = "same"


_Layers = Mapping[str, _Layer]


def _layers_5(*, pooled: int) -> _Layers:
    return {
        "branch1x1": _Layer("input", 64),
        "branch5x5_1": _Layer("input", 48),
        "branch5x5_2": _Layer("branch5x5_1", 64, (5, 5)),
        "branch3x3dbl_1": _Layer("input", 64),
        "branch3x3dbl_2": _Layer("branch3x3dbl_1", 96, (3, 3)),
        "branch3x3dbl_3": _Layer("branch3x3dbl_2", 96, (3, 3)),
        "branch_pool": _Layer("pool", pooled),
    }


_LAYERS_6A: Final[_Layers] = {
    "branch3x3": _Layer("input", 384, (3, 3), "halve"),
    "branch3x3dbl_1": _Layer("input", 64),
    "branch3x3dbl_2": _Layer("branch3x3dbl_1", 96, (3, 3)),
    "branch3x3dbl_3": _Layer("branch3x3dbl_2", 96, (3, 3), "halve"),
}


def _layers_6(*, between: int) -> _Layers:
    return {
        "branch1x1": _Layer("input", 192),
        "branch7x7_1": _Layer("input", between),
        "branch7x7_2": _Layer("branch7x7_1", between, (1, 7)),
        "branch7x7_3": _Layer("branch7x7_2", 192, (7, 1)),
        "branch7x7dbl_1": _Layer("input", between),
        "branch7x7dbl_2": _Layer("branch7x7dbl_1", between, (7, 1)),
        "branch7x7dbl_3": _Layer("branch7x7dbl_2", between, (1, 7)),
        "branch7x7dbl_4": _Layer("branch7x7dbl_3", between, (7, 1)),
        "branch7x7dbl_5": _Layer("branch7x7dbl_4", 192, (1, 7)),
        "branch_pool": _Layer("pool", 192),
    }


_LAYERS_7A: Final[_Layers] = {
    "branch3x3_1": _Layer("input", 192),
    "branch3x3_2": _Layer("branch3x3_1", 320, (3, 3), "halve"),
    "branch7x7x3_1": _Layer("input", 192),
    "branch7x7x3_2": _Layer("branch7x7x3_1", 192, (1, 7)),
    "branch7x7x3_3": _Layer("branch7x7x3_2", 192, (7, 1)),
    "branch7x7x3_4": _Layer("branch7x7x3_3", 192, (3, 3), "halve"),
}

_LAYERS_7: Final[_Layers] = {
    "branch1x1": _Layer("input", 320),
    "branch3x3_1": _Layer("input", 384),
    "branch3x3_2a": _Layer("branch3x3_1", 384, (1, 3)),
    "branch3x3_2b": _Layer("branch3x3_1", 384, (3, 1)),
    "branch3x3dbl_1": _Layer("input", 448),
    "branch3x3dbl_2": _Layer("branch3x3dbl_1", 384, (3, 3)),
    "branch3x3dbl_3a": _Layer("branch3x3dbl_2", 384, (1, 3)),
    "branch3x3dbl_3b": _Layer("branch3x3dbl_2", 384, (3, 1)),
    "branch_pool": _Layer("pool", 192),
}


class _Block(nn.Module):
    """A block of parallel branches; outputs that no other layer uses are concatenated in order."""

    def __init__(
        self, inputs: int, layers: _Layers, *, pool: Literal["mean", "max", "halve"]
    ) -> None:
        super().__init__()
        self.layers = layers
        self.pool = pool
        channels = {"input": inputs, "pool": inputs}
        for name, (of, outputs, kernel, step) in layers.items():
            halves = step == "halve"
            padding = (0, 0) if halves else (kernel[0] // 2, kernel[1] // 2)
            stride = 2 if halves else 1
            conv = _conv(channels[of], outputs, kernel, stride=stride, padding=padding)
            self.add_module(name, conv)
            channels[name] = outputs

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.pool == "mean":
            pooled = functional.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)
        elif self.pool == "max":
            pooled = functional.max_pool2d(x, 3, stride=1, padding=1)
        else:
            pooled = functional.max_pool2d(x, 3, stride=2)
        made = {"input": x, "pool": pooled}
        for name, layer in self.layers.items():
            made[name] = self.get_submodule(name)(made[layer.of])
        taken = {"input", *(layer.of for layer in self.layers.values())}
        return torch.cat(
            [made[name] for name in (*self.layers, "pool") if name not in taken], dim=1
        )


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
