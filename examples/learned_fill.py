"""A G0 method that learns: warp, fill, and let a small network correct the result.

    python examples/learned_fill.py [DATA] [--steps N] [--crop N] [--size HEIGHT WIDTH]

It trains on the train split and is scored by the paper's protocol on the eval split, beside the
copied left view, the warped view with black holes, and `warp_and_fill` without a network. The
table and a picture go to demo/. DATA are scenes or packed ones; training shards cannot be scored.
"""

import argparse
from itertools import chain, islice, repeat
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import nn
from torch.nn.functional import interpolate, l1_loss
from warp_and_fill import warp_and_fill

from stereogenbench_data import EvaluationProtocol, RandomCrop, StereoPairs, evaluate
from stereogenbench_data.evaluation.report import markdown
from stereogenbench_data.evaluation.tables import TableForm, table_of

DEMO, SHARDS = Path("demo"), Path(__file__).parents[1] / "shards"
FIELDS = ("left", "right", "warped_right", "hole", "disparity")


def layer(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Return a convolution and a rectifier."""
    convolution = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation)
    return nn.Sequential(convolution, nn.ReLU())


class Correction(nn.Module):
    """Changes a filled view; sees the scene about 60 pixels around, at a quarter of its size."""

    def __init__(self) -> None:
        super().__init__()
        self.fine, self.middle = layer(4, 16), layer(16, 32, stride=2)
        around = [layer(64, 64, dilation=dilation) for dilation in (2, 4, 8)]
        self.coarse = nn.Sequential(layer(32, 64, stride=2), *around)
        self.to_middle, self.to_fine = layer(64 + 32, 32), layer(32 + 16, 16)
        self.last = nn.Conv2d(16, 3, 3, padding=1, bias=False)
        nn.init.zeros_(self.last.weight)  # it begins by changing nothing

    def forward(self, inputs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the right view, (n, 3, h, w) from 0 to 1."""
        filled = warp_and_fill(inputs) / 255
        fine = self.fine(torch.cat([filled - 0.5, inputs["hole"]], 1))
        middle = self.middle(fine)
        found = interpolate(self.coarse(middle), size=middle.shape[-2:], mode="bilinear")
        found = self.to_middle(torch.cat([found, middle], 1))
        found = interpolate(found, size=fine.shape[-2:], mode="bilinear")
        return (filled + self.last(self.to_fine(torch.cat([found, fine], 1)))).clamp(0, 1)


def draw(methods: dict, pairs: StereoPairs, picture: Path) -> None:
    """Draw the right view of a pair of three scenes, rendered and by each method."""
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
    options.add_argument("data", nargs="?", default=SHARDS)
    options.add_argument("--steps", type=int, default=600)
    options.add_argument("--crop", type=int, default=64)
    options.add_argument("--size", type=int, nargs=2, default=(72, 72), help="size of the scores")
    given = options.parse_args()
    torch.manual_seed(0)
    training = StereoPairs(
        given.data, split="train", pairs="all", frames=("every", 8), fields=FIELDS,
        transform=RandomCrop(given.crop, given.crop),
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
            print(f"step {step}: loss {loss:.4f}, waiting {loader.stats().waiting:.1%}", flush=True)

    methods = {
        "copied left view": lambda inputs: inputs["left"],
        "warped": lambda inputs: inputs["warped_right"],
        "warp and fill": warp_and_fill,
        "learned": network.eval().requires_grad_(requires_grad=False),
    }
    protocol = EvaluationProtocol(metrics=("psnr", "ssim"), size=tuple(given.size))
    selection = {"split": "eval", "pairs": "all", "frames": "first"}
    scores = [
        evaluate(given.data, method, tier="G0", name=name, protocol=protocol, **selection)
        for name, method in methods.items()
    ]
    DEMO.mkdir(exist_ok=True)
    drawn = StereoPairs(given.data, fields=(*FIELDS, "scene"), baseline_cm=(30, 100), **selection)
    draw(methods, drawn, DEMO / "learned_fill.png")
    form = TableForm("Baseline in cm, all pairs", ("baseline",), pairs="all")
    table = table_of(scores, "by_baseline", form=form)
    (DEMO / "learned_fill.md").write_text(markdown(table))
    print(markdown(table))


if __name__ == "__main__":
    main()
