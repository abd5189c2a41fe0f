"""A stereo network: features, a cost volume at a quarter of the size, two refinements.

To train another network, give it the same two methods: `train.py` and `score.py` know no others.
"""

import torch
from torch import nn
from torch.nn.functional import grid_sample, interpolate, normalize, pad, smooth_l1_loss

GROUPS = 4


def block(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Return a convolution, batch normalisation and a rectifier."""
    convolution = nn.Conv2d(
        inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation, bias=False
    )
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())


class Refinement(nn.Module):
    """Corrects a disparity by the left view and by what it makes of the right one."""

    def __init__(self) -> None:
        super().__init__()
        dilated = [block(16, 16, dilation=dilation) for dilation in (1, 2, 4, 1)]
        last = nn.Conv2d(16, 1, 3, padding=1)
        nn.init.zeros_(last.weight)  # it begins by changing nothing
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(block(7, 16), *dilated, last)

    def forward(
        self, left: torch.Tensor, right: torch.Tensor, disparity: torch.Tensor
    ) -> torch.Tensor:
        """Return the disparity at the views' size, (n, 1, h, w) in their pixels."""
        scale = left.shape[-1] / disparity.shape[-1]
        disparity = scale * interpolate(disparity, size=left.shape[-2:], mode="bilinear")
        moved = warped(right, disparity)
        return disparity + self.layers(torch.cat([left, left - moved, disparity / 16], 1))


def warped(right: torch.Tensor, disparity: torch.Tensor) -> torch.Tensor:
    """Return the right views where the disparity says that the left pixels are seen."""
    height, width = right.shape[-2:]
    rows = torch.linspace(-1, 1, height, device=right.device).view(1, height, 1)
    columns = torch.linspace(-1, 1, width, device=right.device).view(1, 1, width)
    columns = columns - disparity[:, 0] * 2 / (width - 1)
    grid = torch.stack([columns, rows.expand_as(columns)], dim=-1)
    return grid_sample(right, grid, padding_mode="border", align_corners=True)


class StereoNetwork(nn.Module):
    """Predicts disparity from 0 to `max_disparity` pixels, of views of any size.

    Soft arg-min: Kendall et al., ICCV 2017, section 3.4. Refinement by residuals over a coarse
    volume: Khamis et al., StereoNet, ECCV 2018, section 3.4.
    """

    def __init__(self, max_disparity: int = 96, channels: int = 32) -> None:
        super().__init__()
        self.max_disparity = max_disparity
        self.features = nn.Sequential(
            block(3, channels, stride=2), block(channels, channels, stride=2),
            block(channels, channels), block(channels, channels, dilation=2),
            block(channels, channels, dilation=4), nn.Conv2d(channels, channels, 3, padding=1),
        )  # fmt: skip
        self.smooth = nn.Sequential(
            nn.Conv3d(GROUPS, 16, 3, padding=1), nn.BatchNorm3d(16), nn.ReLU(),
            nn.Conv3d(16, 16, 3, padding=1), nn.BatchNorm3d(16), nn.ReLU(),
            nn.Conv3d(16, 1, 3, padding=1),
        )  # fmt: skip
        self.sharpness = nn.Parameter(torch.tensor(5.0))
        self.refinements = nn.ModuleList([Refinement(), Refinement()])

    def stages(self, left: torch.Tensor, right: torch.Tensor) -> list[torch.Tensor]:
        """Return the disparity from coarse to fine, each at the views' size in their pixels."""
        height, width = left.shape[-2:]
        # A quarter of the size must be whole: repeat the last row, and the first column.
        filling = (-width % 4, 0, 0, -height % 4)
        left, right = (pad(view / 255 - 0.5, filling, mode="replicate") for view in (left, right))
        disparity = self.coarse(left, right)
        found = [4 * interpolate(disparity, size=left.shape[-2:], mode="bilinear")]
        for scale, refine in zip((0.5, 1.0), self.refinements, strict=True):
            views = [
                view if scale == 1 else interpolate(view, scale_factor=scale, mode="area")
                for view in (left, right)
            ]
            disparity = refine(*views, disparity)
            found.append(interpolate(disparity / scale, size=left.shape[-2:], mode="bilinear"))
        return [each[..., :height, -width:] for each in found]

    def coarse(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """Return the disparity at a quarter of the views' size, in its pixels."""
        shifts = self.max_disparity // 4
        ours, theirs = (normalize(self.features(view), dim=1) for view in (left, right))
        width, theirs = ours.shape[-1], pad(theirs, (shifts, 0))
        shifted = [theirs[..., shifts - by :][..., :width] for by in range(shifts)]
        cosines = [(ours * view).unflatten(1, (GROUPS, -1)).sum(2) for view in shifted]
        volume = torch.stack(cosines, dim=2)  # (n, groups, shifts, h / 4, w / 4)
        scores = self.sharpness * (volume.sum(1) + self.smooth(volume).squeeze(1))
        steps = torch.arange(shifts, device=left.device).view(-1, 1, 1)
        return (scores.softmax(1) * steps).sum(1, keepdim=True)

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """Return the disparity of the left views, (n, 1, h, w) in pixels.

        Args:
            left: (n, 3, h, w) uint8.
            right: The same of the right views.
        """
        return self.stages(left, right)[-1]

    def loss(
        self, left: torch.Tensor, right: torch.Tensor, disparity: torch.Tensor, valid: torch.Tensor
    ) -> torch.Tensor:
        """Return how wrong all stages are, the finer ones counting more."""
        kept = valid & (disparity < self.max_disparity)
        errors = [
            smooth_l1_loss(stage[kept], disparity[kept]) for stage in self.stages(left, right)
        ]
        return sum(weight * error for weight, error in zip((0.25, 0.5, 1.0), errors, strict=True))
