"""A small stereo network: features, a cost volume of cosines, soft arg-min, a refinement."""

import torch
from torch import nn
from torch.nn.functional import interpolate, normalize, pad


class SmallStereo(nn.Module):
    """Predicts disparity from 0 to `max_disparity` pixels, of pictures of even width and height.

    Soft arg-min: Kendall et al., End-to-End Learning of Geometry and Context for Deep Stereo
    Regression, ICCV 2017, section 3.4.
    """

    def __init__(self, max_disparity: int = 32, channels: int = 24) -> None:
        super().__init__()
        self.shifts = max_disparity // 2  # matching is at half the size
        self.features = nn.Sequential(
            nn.Conv2d(3, channels, 5, stride=2, padding=2), nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
        )  # fmt: skip
        self.sharpness = nn.Parameter(torch.tensor(5.0))
        self.smooth = nn.Sequential(
            nn.Conv3d(2, 8, 3, padding=1), nn.ReLU(), nn.Conv3d(8, 1, 3, padding=1)
        )
        self.refine = nn.Sequential(
            nn.Conv2d(4, 16, 3, padding=1), nn.ReLU(),
            nn.Conv2d(16, 16, 3, padding=2, dilation=2), nn.ReLU(),
            nn.Conv2d(16, 1, 3, padding=1),
        )  # fmt: skip
        nn.init.zeros_(self.refine[-1].weight)  # it begins by changing nothing
        nn.init.zeros_(self.refine[-1].bias)

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """Return the disparity of the left views, (n, 1, h, w) in pixels.

        Args:
            left: (n, 3, h, w) uint8.
            right: The same of the right views.
        """
        left, right = left / 255 - 0.5, right / 255 - 0.5
        ours, theirs = self.describe(left), pad(self.describe(right), (self.shifts, 0))
        width = ours.shape[-1]
        shifted = [theirs[..., self.shifts - by :][..., :width] for by in range(self.shifts)]
        # The two halves of the channels are compared apart: (n, 2, shifts, h / 2, w / 2).
        cosines = torch.stack([(ours * view).unflatten(1, (2, -1)).sum(2) for view in shifted], 2)
        scores = self.sharpness * (cosines.sum(1) + self.smooth(cosines).squeeze(1))
        steps = torch.arange(self.shifts, device=left.device).view(-1, 1, 1)
        coarse = (scores.softmax(1) * steps).sum(1, keepdim=True)
        disparity = 2 * interpolate(coarse, scale_factor=2.0, mode="bilinear")
        return disparity + self.refine(torch.cat([left, disparity / 8], 1))

    def describe(self, view: torch.Tensor) -> torch.Tensor:
        """Return unit vectors, one for each pixel of the view at half its size."""
        features = self.features(view)
        return normalize(features - features.mean((2, 3), keepdim=True), dim=1)
