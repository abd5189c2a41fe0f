"""The simplest G0 method: splat the left view by the true disparity, and fill the holes.

The script scores it twice on the sample in shards/: as a function called on batches, and from the
pictures that it wrote. Both ways give the same numbers.
"""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from stereogenbench_data import evaluate, export_inputs
from stereogenbench_data.evaluation.report import markdown
from stereogenbench_data.evaluation.tables import table_of

SHARDS = Path(__file__).parents[1] / "shards"
FOLDER = Path("demo") / "warp_and_fill"
FRAMES = [0, 40]


def warp_and_fill(inputs: dict[str, torch.Tensor]) -> torch.Tensor:
    """Fill each hole with the next pixel to its right, which is background; else to its left."""
    warped, hole = inputs["warped_right"], inputs["hole"]
    columns = torch.arange(hole.shape[-1]).expand(hole.shape)
    far = torch.where(hole, hole.shape[-1], columns).flip(-1).cummin(-1).values.flip(-1)
    last = torch.where(hole, 0, columns).cummax(-1).values
    source = torch.where(far < hole.shape[-1], far, last)
    return warped.gather(-1, source.expand(warped.shape))


def read(item: Path, name: str, frame: int) -> torch.Tensor:
    pixels = np.array(Image.open(item / name / f"{frame:03d}.png"))
    return torch.from_numpy(np.atleast_3d(pixels)).permute(2, 0, 1)[None]


def main() -> None:
    called = evaluate(SHARDS, warp_and_fill, tier="G0", split="eval", frames=FRAMES)
    inputs = FOLDER / "inputs"
    for item in export_inputs(SHARDS, inputs, tier="G0", split="eval", frames=FRAMES):
        target = FOLDER / "predictions" / item
        target.mkdir(parents=True, exist_ok=True)
        for frame in FRAMES:
            views = {name: read(inputs / item, name, frame) for name in ("warped_right", "hole")}
            right = warp_and_fill(views | {"hole": views["hole"] > 0})[0].permute(1, 2, 0)
            Image.fromarray(right.numpy()).save(target / f"{frame:03d}.png")
    written = evaluate(SHARDS, FOLDER / "predictions", tier="G0", split="eval", frames=FRAMES)
    print(markdown(table_of([called, written], "bins_primary")))
    same = repr(called.pairs) == repr(written.pairs)
    print("the same scores both ways" if same else "the scores differ")


if __name__ == "__main__":
    main()
