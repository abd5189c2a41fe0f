"""The features of FVD: the 400 logits of I3D, the inflated Inception trained on Kinetics-400.

Tensors are named as in the file of its weights.
"""

from pathlib import Path
from typing import Final

import torch
from torch import nn
from torch.nn import functional

from stereogenbench_data.evaluation.models.loading import Network, Weights, load_weights

I3D: Final = Weights(
    what="FVD's I3D",
    file="i3d_pretrained_400.pt",
    source="https://github.com/songweige/TATS/raw/main/tats/fvd/i3d_pretrained_400.pt",
    licence="Apache-2.0 (DeepMind's Kinetics-I3D, converted)",
)
_SIDE_PX: Final = 224
_CLASSES: Final = 400

Size = tuple[int, int, int]


class I3dFeatures(Network):
    """FVD's features of clips: from uint8 (n, t, 3, h, w) to (n, 400)."""

    min_frames = 10

    def __init__(self, *, weights: Path | None = None, device: str = "cpu") -> None:
        """Load the network; the arguments are those of `load_model`.

        Raises:
            ExtraError: If the file of weights is missing.
            EvaluationError: If it does not hold this network's weights.
        """
        network = InflatedInception()
        settings = {
            "layer": "logits, mean over time",
            "resize": "bilinear to 224x224, aspect not kept, no smoothing",
            **load_weights(network, I3D, folder=weights),
        }
        super().__init__(network, settings=settings, device=device, rows=1)


class InflatedInception(nn.Module):
    """From clips (n, t, 3, h, w) of 0 to 255 to 400 logits each."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv3d_1a_7x7 = _Unit(3, 64, kernel=(7, 7, 7), stride=(2, 2, 2))
        self.Conv3d_2b_1x1 = _Unit(64, 64)
        self.Conv3d_2c_3x3 = _Unit(64, 192, kernel=(3, 3, 3))
        self.Mixed_3b = _InflatedBlock(192, (64, 96, 128, 16, 32, 32))
        self.Mixed_3c = _InflatedBlock(256, (128, 128, 192, 32, 96, 64))
        self.Mixed_4b = _InflatedBlock(480, (192, 96, 208, 16, 48, 64))
        self.Mixed_4c = _InflatedBlock(512, (160, 112, 224, 24, 64, 64))
        self.Mixed_4d = _InflatedBlock(512, (128, 128, 256, 24, 64, 64))
        self.Mixed_4e = _InflatedBlock(512, (112, 144, 288, 32, 64, 64))
        self.Mixed_4f = _InflatedBlock(528, (256, 160, 320, 32, 128, 128))
        self.Mixed_5b = _InflatedBlock(832, (256, 160, 320, 32, 128, 128))
        self.Mixed_5c = _InflatedBlock(832, (384, 192, 384, 48, 128, 128))
        self.logits = nn.ModuleDict({"conv3d": nn.Conv3d(1024, _CLASSES, 1)})

    def forward(self, clips: torch.Tensor) -> torch.Tensor:
        """Return logits (n, 400)."""
        frames = functional.interpolate(
            clips.flatten(0, 1), size=(_SIDE_PX, _SIDE_PX), mode="bilinear"
        )
        video = (2 * frames / 255 - 1).unflatten(0, clips.shape[:2]).transpose(1, 2)
        wide, all_ways = (1, 3, 3), (3, 3, 3)
        x = _max_pool(self.Conv3d_1a_7x7(video), kernel=wide, stride=(1, 2, 2))
        x = self.Conv3d_2c_3x3(self.Conv3d_2b_1x1(x))
        x = _max_pool(x, kernel=wide, stride=(1, 2, 2))
        x = _max_pool(self.Mixed_3c(self.Mixed_3b(x)), kernel=all_ways, stride=(2, 2, 2))
        x = self.Mixed_4d(self.Mixed_4c(self.Mixed_4b(x)))
        x = self.Mixed_4f(self.Mixed_4e(x))
        x = _max_pool(x, kernel=(2, 2, 2), stride=(2, 2, 2))
        x = functional.avg_pool3d(self.Mixed_5c(self.Mixed_5b(x)), (2, 7, 7), stride=1)
        logits: torch.Tensor = self.logits["conv3d"](x)
        return logits.mean(dim=(2, 3, 4))


class _Unit(nn.Module):
    """Convolution, batch normalisation and ReLU; the size is the input's over the stride."""

    def __init__(
        self, inputs: int, outputs: int, *, kernel: Size = (1, 1, 1), stride: Size = (1, 1, 1)
    ) -> None:
        super().__init__()
        self.kernel, self.stride = kernel, stride
        self.conv3d = nn.Conv3d(inputs, outputs, kernel, stride, bias=False)
        self.bn = nn.BatchNorm3d(outputs, eps=1e-5)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        padded = _padded(x, kernel=self.kernel, stride=self.stride)
        return functional.relu(self.bn(self.conv3d(padded)))


class _InflatedBlock(nn.Module):
    """Four parallel branches, concatenated."""

    def __init__(self, inputs: int, outputs: tuple[int, int, int, int, int, int]) -> None:
        super().__init__()
        self.b0 = _Unit(inputs, outputs[0])
        self.b1a = _Unit(inputs, outputs[1])
        self.b1b = _Unit(outputs[1], outputs[2], kernel=(3, 3, 3))
        self.b2a = _Unit(inputs, outputs[3])
        self.b2b = _Unit(outputs[3], outputs[4], kernel=(3, 3, 3))
        self.b3b = _Unit(inputs, outputs[5])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        pooled = _max_pool(x, kernel=(3, 3, 3), stride=(1, 1, 1))
        branches = [self.b0(x), self.b1b(self.b1a(x)), self.b2b(self.b2a(x)), self.b3b(pooled)]
        return torch.cat(branches, dim=1)


def _max_pool(x: torch.Tensor, *, kernel: Size, stride: Size) -> torch.Tensor:
    return functional.max_pool3d(_padded(x, kernel=kernel, stride=stride), kernel, stride)


def _padded(x: torch.Tensor, *, kernel: Size, stride: Size) -> torch.Tensor:
    """Return x padded with zeros as TensorFlow's "same" does: its size over the stride, rounded up.

    An odd zero goes to the end. Pools see the zeros as values.
    """
    padding: list[int] = []
    for size, window, step in zip(x.shape[:1:-1], kernel[::-1], stride[::-1], strict=True):
        total = max(window - (size % step or step), 0)
        padding += [total // 2, total - total // 2]
    return functional.pad(x, padding)
