"""LPIPS, version 0.1 on AlexNet: a weighted distance of two pictures' normalised activations.

The network of the package lpips gives the same distances to 1e-8. It is not used because it imports
torchvision, each release of which fits one release and one build of torch only. The package is
needed for its file of weights, and is not imported.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Final

import torch
from torch import nn
from torch.nn import functional

from stereogenbench_data.errors import missing_extra
from stereogenbench_data.evaluation.models.loading import (
    Network,
    Tensors,
    Weights,
    load_file,
    load_weights,
)

TRUNK: Final = Weights(
    what="LPIPS' AlexNet",
    file="alexnet-owt-7be5be79.pth",
    source="https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    licence="BSD-3-Clause, torchvision",
    extra="lpips",
)
HEADS: Final = Path("weights") / "v0.1" / "alex.pth"
_SHIFT: Final = (-0.030, -0.088, -0.188)
_SCALE: Final = (0.458, 0.448, 0.450)
_CHANNELS: Final = (64, 192, 384, 256, 256)
_BATCH: Final = 8


class Lpips(Network):
    """LPIPS of pictures against their targets: from two arrays, uint8 (n, 3, h, w), to (n,)."""

    def __init__(self, *, weights: Path | None = None, device: str = "cpu") -> None:
        """Load the network; the arguments are those of `load_model`.

        AlexNet's file is in the folder of weights; the few numbers on top of it come from the
        installed package lpips.

        Raises:
            ExtraError: If the package or the file is missing.
            EvaluationError: If a file does not hold this network's weights.
        """
        network = PerceptualDistance()
        settings = {
            "network": "AlexNet",
            "version": "0.1",
            "size": "as scored",
            **load_weights(network.alexnet, TRUNK, folder=weights, select=_of_features),
        }
        package = find_spec("lpips")
        if package is None or package.origin is None:
            raise missing_extra("LPIPS", TRUNK.extra, "No module named lpips")
        load_file(network.heads, Path(package.origin).parent / HEADS)
        super().__init__(network, settings=settings, device=device, rows=_BATCH)


def _of_features(tensors: Tensors) -> Tensors:
    """Leave out the layers of AlexNet that classify."""
    return {name: each for name, each in tensors.items() if name.startswith("features.")}


class PerceptualDistance(nn.Module):
    """From two batches of pictures (n, 3, h, w) of 0 to 255 to n distances.

    Source: Zhang, Isola, Efros, Shechtman & Wang, CVPR 2018.
    """

    def __init__(self) -> None:
        super().__init__()
        features = nn.Sequential(
            nn.Conv2d(3, 64, 11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(64, 192, 5, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(192, 384, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(384, 256, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1),
            nn.ReLU(),
        )
        self.alexnet = nn.ModuleDict({"features": features})
        self.heads = nn.ModuleDict()
        for layer, channels in enumerate(_CHANNELS):
            head = nn.Sequential(nn.Dropout(), nn.Conv2d(channels, 1, 1, bias=False))
            self.heads[f"lin{layer}"] = nn.ModuleDict({"model": head})

    def forward(self, one: torch.Tensor, two: torch.Tensor) -> torch.Tensor:
        """Return distances (n,)."""
        total = one.new_zeros(len(one))
        activations = zip(self._activations(one), self._activations(two), strict=True)
        for layer, (here, there) in enumerate(activations):
            head = self.heads.get_submodule(f"lin{layer}.model")
            total += head((here - there) ** 2).mean(dim=(1, 2, 3))
        return total

    def _activations(self, pictures: torch.Tensor) -> list[torch.Tensor]:
        """Return the output of each ReLU, of unit length at each pixel."""
        shift, scale = (
            torch.tensor(values, device=pictures.device)[:, None, None]
            for values in (_SHIFT, _SCALE)
        )
        x = (pictures / 127.5 - 1 - shift) / scale
        found = []
        for step in self.alexnet.get_submodule("features").children():
            x = step(x)
            if isinstance(step, nn.ReLU):
                found.append(functional.normalize(x, dim=1, eps=1e-10))
        return found
