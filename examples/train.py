"""Train a small stereo network on scenes made on the spot: `make demo` runs this.

It draws six scenes of two families, trains for a few steps through a DataLoader with two workers,
and writes a contact sheet of what the network was shown.
"""

from pathlib import Path

import torch
from torch import nn
from torch.utils.data import DataLoader

from stereogenbench_data import Compose, HorizontalFlip, RandomCrop, StereoPairs, collate
from stereogenbench_data.samples.picture import contact_sheet, write_png
from stereogenbench_data.synthesis import SynthRequest, synthesise

DEMO = Path("demo")


class SmallStereo(nn.Module):
    """Correlates left with right at 32 shifts and regresses disparity at a quarter of the size."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 16, 5, 2, 2), nn.ReLU(), nn.Conv2d(16, 16, 5, 2, 2)
        )
        self.head = nn.Sequential(nn.Conv2d(48, 48, 3, 1, 1), nn.ReLU(), nn.Conv2d(48, 1, 3, 1, 1))

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        left, right = (self.features(view.float() / 255 - 0.5) for view in (left, right))
        shifted = [torch.roll(right, shift, dims=-1) for shift in range(32)]
        costs = torch.stack([(left * view).mean(1) for view in shifted], dim=1)
        quarter = nn.functional.softplus(self.head(torch.cat([costs, left], dim=1)))
        return 4 * nn.functional.interpolate(quarter, scale_factor=4, mode="nearest")


def main() -> None:
    torch.manual_seed(0)
    scenes = DEMO / "scenes"
    for family in ("IPD_Gaussian", "Uniform"):
        synthesise(scenes, SynthRequest(family=family, scenes=3, size_px=160, frames=9, seed=1))
    pairs = StereoPairs(
        scenes,
        split="train",
        baseline_cm=(4, 60),
        pairs="all",
        frames="all",
        fields=("left", "right", "disparity", "valid", "visible", "baseline_m", "pair", "__key__"),
        transform=Compose([HorizontalFlip(), RandomCrop(128, 128)]),
    )
    loader = DataLoader(pairs, batch_size=8, shuffle=True, num_workers=2, collate_fn=collate)
    network = SmallStereo()
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    for step, batch in zip(range(24), loader, strict=False):
        error = (network(batch["left"], batch["right"]) - batch["disparity"]).abs()
        loss = error[batch["valid"] & (batch["disparity"] < 128)].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        print(f"step {step + 1:2d}  mean disparity error {loss.item():6.2f} px")
    sheet = DEMO / "contact_sheet.png"
    write_png(
        sheet, contact_sheet([pairs[number] for number in range(0, len(pairs), len(pairs) // 6)])
    )
    print(f"{len(pairs)} samples; contact sheet written to {sheet}")


if __name__ == "__main__":
    main()
