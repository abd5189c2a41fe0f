"""A step of video diffusion: noise becomes the right view, given left, warped view, mask, caption.

python examples/clip_diffusion.py [SHARDS]

It trains by flow matching, as Wan and LTX do, on clips of 4N+1 frames, (3,T,H,W). The network is a
toy: it takes pixels for a VAE's latents, and the mean of letters for a prompt's encoding.
"""

import sys
from pathlib import Path

import torch
from torch import nn

from stereogenbench_data import to_device
from stereogenbench_data.bridges.generation import StereoClips

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")


class TinyDenoiser(nn.Module):
    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.letters = nn.Embedding(256, width)
        self.time = nn.Linear(1, width)
        self.first = nn.Conv3d(3 + 3 + 3 + 1, width, 3, padding=1)
        self.last = nn.Sequential(nn.SiLU(), nn.Conv3d(width, 3, 3, padding=1))

    def forward(self, noisy, condition, time, captions) -> torch.Tensor:
        texts = (torch.tensor([*f"{caption} ".encode()]).to(noisy.device) for caption in captions)
        embedded = torch.stack([self.letters(text).mean(0) for text in texts])
        hidden = self.first(torch.cat([noisy, condition], dim=1))
        return self.last(hidden + (embedded + self.time(time.flatten(1)))[..., None, None, None])


def main() -> None:
    torch.manual_seed(0)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    clips = StereoClips(
        SHARDS, split="train", pairs=[(0, 1), (0, 5)], frames=("clips", 9),
        size=(32, 32), layout="cthw", captions="with baseline",
    )  # fmt: skip
    loader = clips.loader(batch_size=2, num_workers=1, seed=0, pin_memory=device.type == "cuda")
    network = TinyDenoiser().to(device)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-2)
    for step, batch in enumerate(to_device(loader, device)):
        target, noise = batch["target"], torch.randn_like(batch["target"])
        time = torch.rand(len(target), 1, 1, 1, 1, device=device)
        condition = torch.cat([batch[name] for name in ("source", "warped", "mask")], dim=1)
        velocity = network(torch.lerp(noise, target, time), condition, time, batch["caption"])
        loss = nn.functional.mse_loss(velocity, target - noise)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 10 == 0:
            print(f"step {step}: loss {loss.item():.2f}, {batch['caption'][0]}")


if __name__ == "__main__":
    main()
