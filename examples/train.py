"""Plain PyTorch: draw scenes, train on the sample shards, write a contact sheet (`make demo`)."""

from pathlib import Path

import torch
from torch import nn

from stereogenbench_data import Compose, HorizontalFlip, RandomCrop, StereoPairs
from stereogenbench_data.samples.picture import contact_sheet, write_png
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

DEMO, SHARDS = Path("demo"), Path(__file__).parents[1] / "shards"
FIELDS = ("left", "right", "disparity", "valid", "visible", "baseline_m", "pair", "__key__")


class SmallStereo(nn.Module):
    """Correlates left with right at 32 shifts and regresses disparity at a quarter of the size."""

    def __init__(self) -> None:
        super().__init__()
        first, second = nn.Conv2d(3, 16, 5, 2, 2), nn.Conv2d(16, 16, 5, 2, 2)
        self.features = nn.Sequential(first, nn.ReLU(), second)
        self.head = nn.Sequential(nn.Conv2d(48, 48, 3, 1, 1), nn.ReLU(), nn.Conv2d(48, 1, 3, 1, 1))

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        left, right = (self.features(view.float() / 255 - 0.5) for view in (left, right))
        shifted = [torch.roll(right, shift, dims=-1) for shift in range(32)]
        costs = torch.stack([(left * view).mean(1) for view in shifted], dim=1)
        quarter = nn.functional.softplus(self.head(torch.cat([costs, left], dim=1)))
        return 4 * nn.functional.interpolate(quarter, scale_factor=4, mode="nearest")


def main() -> None:
    torch.manual_seed(0)
    synthesise(DEMO / "scenes", SynthRequest(family="Uniform", scenes=2, size_px=160, frames=5))
    shown = StereoPairs(DEMO / "scenes", pairs=[(0, 1), (2, 4)], fields=FIELDS)
    augment = Compose([HorizontalFlip(), RandomCrop(64, 64)])
    pairs = StereoPairs(
        SHARDS, split="train", pairs="all", baseline_cm=(4, 60), frames=("every", 4),
        fields=FIELDS, transform=augment,
    )  # fmt: skip
    network = SmallStereo()
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    loader = pairs.loader(batch_size=16, num_workers=2, seed=0, shuffle_groups=2)
    for step, batch in zip(range(24), loader, strict=False):
        error = (network(batch["left"], batch["right"]) - batch["disparity"]).abs()
        loss = error[batch["valid"] & (batch["disparity"] < 64)].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        print(f"step {step + 1:2d}  mean disparity error {loss.item():6.2f} px")
    sheet = DEMO / "contact_sheet.png"
    write_png(sheet, contact_sheet([*shown, *(pairs[number] for number in (0, len(pairs) // 2))]))
    print(f"{len(pairs)} samples in shards/; contact sheet written to {sheet}")


if __name__ == "__main__":
    main()
