"""A G0 method that learns: warp, fill, and let a small network correct the result.

    python examples/learned_fill.py [SHARDS] [--steps N] [--size HEIGHT WIDTH]

It trains on the train split and is scored by the paper's protocol on the eval split, beside the
copied left view, the warped view with black holes, and `warp_and_fill` without a network. The
table and a picture go to demo/.
"""

import argparse
from itertools import chain, islice, repeat
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import nn
from torch.nn.functional import l1_loss
from warp_and_fill import warp_and_fill

from stereogenbench_data import (
    Compose,
    EvaluationProtocol,
    HorizontalFlip,
    RandomCrop,
    StereoPairs,
    evaluate,
    tables_of,
)
from stereogenbench_data.evaluation.report import markdown

DEMO, SHARDS = Path("demo"), Path(__file__).parents[1] / "shards"
FIELDS = ("left", "right", "warped_right", "hole", "disparity")


class Correction(nn.Module):
    """Changes a filled view, (n, 3, h, w) uint8, most where pixels were made up."""

    def __init__(self, channels: int = 32) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(4, channels, 3, padding=1), nn.ReLU()]
        for dilation in (1, 2, 4, 8, 2, 1):
            layer = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)
            layers += [layer, nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, 3, 3, padding=1))
        nn.init.zeros_(self.layers[-1].weight)  # it begins by changing nothing
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, inputs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the right view, (n, 3, h, w) from 0 to 1."""
        filled = warp_and_fill(inputs) / 255
        return (filled + self.layers(torch.cat([filled - 0.5, inputs["hole"]], 1))).clamp(0, 1)


def draw(methods: dict, pairs: StereoPairs, picture: Path) -> None:
    """Draw the right view of the first pair of three scenes, rendered and by each method."""
    samples = list({sample["scene"]: sample for sample in pairs}.values())[:3]
    figure = Figure(figsize=(3 * (1 + len(methods)), 3 * len(samples)), layout="constrained")
    for row, sample in zip(figure.subplots(len(samples), 1 + len(methods)), samples, strict=True):
        inputs = {name: sample[name][None] for name in FIELDS}
        with torch.no_grad():
            made = [(name, method(inputs)[0]) for name, method in methods.items()]
        for tile, (name, view) in zip(row, [("rendered", sample["right"]), *made], strict=True):
            tile.imshow(view.permute(1, 2, 0))
            tile.set_title(name, fontsize=9)
            tile.set_axis_off()
    figure.savefig(picture, dpi=110)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("shards", nargs="?", default=SHARDS)
    options.add_argument("--steps", type=int, default=600)
    options.add_argument("--size", type=int, nargs=2, default=(72, 72), help="size of the scores")
    given = options.parse_args()
    torch.manual_seed(0)
    training = StereoPairs(
        given.shards, split="train", pairs="all", frames=("every", 8), fields=FIELDS,
        transform=Compose([HorizontalFlip(), RandomCrop(64, 64)]),
    )  # fmt: skip
    loader = training.loader(8, num_workers=1, seed=0)
    network = Correction()
    optimiser = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=given.steps)
    batches = chain.from_iterable(repeat(loader))  # epoch after epoch
    for step, batch in enumerate(islice(batches, given.steps), start=1):
        loss = l1_loss(network(batch), batch["right"] / 255)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 100 == 0:
            print(f"step {step}: loss {loss.item():.4f}", flush=True)

    methods = {
        "copied left view": lambda inputs: inputs["left"],
        "warped": lambda inputs: inputs["warped_right"],
        "warp and fill": warp_and_fill,
        "learned": network.eval().requires_grad_(requires_grad=False),
    }
    protocol = EvaluationProtocol(metrics=("psnr", "ssim"), size=tuple(given.size))
    selection = {"split": "eval", "pairs": "all", "frames": "first"}
    scores = [
        evaluate(given.shards, method, tier="G0", name=name, protocol=protocol, **selection)
        for name, method in methods.items()
    ]
    DEMO.mkdir(exist_ok=True)
    held_out = StereoPairs(given.shards, fields=(*FIELDS, "scene"), **selection)
    draw(methods, held_out, DEMO / "learned_fill.png")
    table = next(table for table in tables_of(scores) if table.name == "bins_all")
    (DEMO / "learned_fill.md").write_text(markdown(table))
    print(markdown(table))


if __name__ == "__main__":
    main()
