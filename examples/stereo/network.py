"""A stereo network: features, a cost volume at a quarter of the size, and a refinement.

To train another network, give it the same two methods: `train.py` and `score.py` know no others.
"""

from functools import partial

import torch
from torch import nn
from torch.nn.functional import grid_sample, normalize, pad, pixel_shuffle, smooth_l1_loss, unfold

GROUPS, UNSEEN_WEIGHT = 4, 0.1


def block(
    inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1, norm: type = nn.BatchNorm2d
) -> nn.Sequential:
    """Return a convolution, a normalisation and a rectifier."""
    convolution = nn.Conv2d(
        inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation, bias=False
    )
    return nn.Sequential(convolution, norm(outputs), nn.ReLU())


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
        """Return the corrected disparity, (n, 1, h, w) as it was given."""
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


def enlarged(disparity: torch.Tensor, weights: torch.Tensor, *, by: int) -> torch.Tensor:
    """Return a map as so many times larger; each pixel is a mean of 3 x 3 with weights of its own.

    Teed and Deng, RAFT, ECCV 2020, section 3.3.
    """
    n, _, height, width = disparity.shape
    around = unfold(pad(by * disparity, (1, 1, 1, 1), mode="replicate"), 3)
    around = around.view(n, 9, 1, height, width)
    weights = weights.view(n, 9, by * by, height, width).softmax(1)
    return pixel_shuffle((weights * around).sum(1), by)


class StereoNetwork(nn.Module):
    """Predicts disparity from 0 to `max_disparity` pixels, of views of any size.

    Soft arg-min: Kendall et al., ICCV 2017, section 3.4. Refinement by residuals over a coarse
    volume: Khamis et al., StereoNet, ECCV 2018, section 3.4.
    """

    def __init__(self, max_disparity: int = 96, channels: int = 32) -> None:
        super().__init__()
        self.max_disparity = max_disparity
        # Each view by its own brightness and contrast: real pictures differ from drawn ones.
        own = partial(block, norm=nn.InstanceNorm2d)
        self.stem = nn.Sequential(own(3, channels, stride=2), own(channels, channels, stride=2))
        self.features = nn.Sequential(
            own(channels, channels), own(channels, channels, dilation=2),
            own(channels, channels, dilation=4), nn.Conv2d(channels, channels, 3, padding=1),
        )  # fmt: skip
        self.smooth = nn.Sequential(
            nn.Conv3d(GROUPS, 16, 3, padding=1), nn.BatchNorm3d(16), nn.ReLU(),
            nn.Conv3d(16, 16, 3, padding=1), nn.BatchNorm3d(16), nn.ReLU(),
            nn.Conv3d(16, 1, 3, padding=1),
        )  # fmt: skip
        self.sharpness = nn.Parameter(torch.tensor(5.0))
        self.weights = nn.Sequential(block(channels, 64), nn.Conv2d(64, 9 * 16, 1))
        self.refine = Refinement()

    def stages(self, left: torch.Tensor, right: torch.Tensor) -> list[torch.Tensor]:
        """Return the disparity before and after refinement."""
        height, width = left.shape[-2:]
        # A quarter of the size must be whole: repeat the last row, and the first column.
        filling = (-width % 4, 0, 0, -height % 4)
        left, right = (pad(view / 255 - 0.5, filling, mode="replicate") for view in (left, right))
        ours, theirs = self.stem(left), self.stem(right)
        disparity = enlarged(self.coarse(ours, theirs), self.weights(ours), by=4)
        found = [disparity, self.refine(left, right, disparity)]
        return [each[..., :height, -width:] for each in found]

    def coarse(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """Return the disparity at a quarter of the views' size, in its pixels, from the stems."""
        shifts = self.max_disparity // 4
        ours, theirs = (normalize(self.features(view).float(), dim=1) for view in (left, right))
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
        self,
        left: torch.Tensor,
        right: torch.Tensor,
        disparity: torch.Tensor,
        valid: torch.Tensor,
        visible: torch.Tensor,
    ) -> torch.Tensor:
        """Return how wrong both stages are; what the right view does not show counts little."""
        kept = valid & (disparity < self.max_disparity)
        weight = torch.where(visible, 1.0, UNSEEN_WEIGHT)[kept]
        before, after = (
            (weight * smooth_l1_loss(stage[kept], disparity[kept], reduction="none")).sum()
            for stage in self.stages(left, right)
        )
        return (0.5 * before + after) / weight.sum()
