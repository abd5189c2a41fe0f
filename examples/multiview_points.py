"""Several views: each pixel's point as the first camera sees it, what VGGT and DUSt3R predict.

python examples/multiview_points.py [SHARDS]

Records are those that VGGT's own datasets give. The network is a toy.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from stereogenbench_data import SceneViews
from stereogenbench_data.bridges.multiview import VIEW_FIELDS, vggt_record

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")


class Moments(Dataset):
    """Four views of each moment, drawn anew each time."""

    def __init__(self) -> None:
        options = {"split": "train", "frames": ("every", 40), "fields": VIEW_FIELDS}
        self.views = SceneViews(SHARDS, **options)

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, number: int) -> list[torch.Tensor]:
        record = vggt_record(self.views[number], ids=torch.randperm(6)[:4])
        rotation, shift = np.split(np.float32(record["extrinsics"][0]), [3], axis=1)
        points = np.stack(record["world_points"]) @ rotation.T + shift[:, 0]
        arrays = (np.stack(record["images"]), points, np.stack(record["point_masks"]))
        return [torch.from_numpy(array) for array in arrays]


def main() -> None:
    torch.manual_seed(0)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    loader = DataLoader(Moments(), batch_size=2, shuffle=True, num_workers=1)
    network = nn.Sequential(
        nn.Conv2d(4 * 3, 32, 7, padding=3), nn.ReLU(), nn.Conv2d(32, 4 * 3, 7, padding=3)
    ).to(device)  # fmt: skip
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-2)
    for epoch in range(4):
        for batch in loader:
            images, points, is_valid = (values.to(device) for values in batch)
            pictures = images.movedim(-1, 2).flatten(1, 2).float() / 255
            predicted = network(pictures).unflatten(1, (4, 3)).movedim(2, -1)
            scale = points[is_valid].norm(dim=-1).mean()
            loss = (predicted - points / scale).norm(dim=-1)[is_valid].mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        print(f"epoch {epoch}: error {loss.item():.2f} of the mean distance")


if __name__ == "__main__":
    main()
