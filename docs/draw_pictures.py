"""Draws clips.png and shuffle.png into pictures/: `draw_pictures.py CLIPS SCENES`, two data sets.

The other pictures are of `show` and `eval score`; rig.svg is drawn by hand.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from stereogenbench_data import StereoPairs

FOLDER = Path(__file__).parent / "pictures"


def draw_clips(data: str) -> None:
    """Draw a batch of two clips: a row for the left pictures of each, and one for disparity."""
    fields = ("left", "disparity")
    clips = StereoPairs(data, frames=("random clips", 1, 6, 3), fields=fields, size=(200, 200))
    batch = next(iter(clips.loader(batch_size=2, seed=1)))
    figure, rows = plt.subplots(4, 6, figsize=(9, 6.2), layout="constrained")
    for place, row in enumerate(rows):
        clip, name = divmod(place, 2)
        row[0].set_ylabel(f"{fields[name]}[{clip}]")
        largest = float(batch["disparity"][clip].max())
        for time, axes in enumerate(row):
            picture = batch[fields[name]][clip, time].permute(1, 2, 0).numpy()
            axes.imshow(picture, cmap="turbo", vmin=0, vmax=largest if name else None)
            axes.set(xticks=[], yticks=[], title=f"[:, {time}]" if place == 0 else "")
    figure.savefig(FOLDER / "clips.png", dpi=100)


def draw_shuffle(data: str) -> None:
    """Draw where in an epoch the samples of each scene come, in colours of their frames."""
    pairs = StereoPairs(data, frames="all", fields=("scene", "frame_index"))
    batches = list(pairs.loader(batch_size=8, seed=0))
    scenes = list(dict.fromkeys(key for batch in batches for key in batch["scene"]))
    shown = [
        (place, scenes.index(key), frame)
        for place, batch in enumerate(batches)
        for key, frame in zip(batch["scene"], batch["frame_index"].tolist(), strict=True)
    ]
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    places, rows, frames = zip(*shown, strict=True)
    points = axes.scatter(places, rows, c=frames, s=1)
    figure.colorbar(points, label="frame")
    axes.set(
        xlabel="batch of 8",
        ylabel="scene, by first sample",
        title="One epoch: where the samples of each scene come",
    )
    figure.savefig(FOLDER / "shuffle.png", dpi=100)


if __name__ == "__main__":
    draw_clips(sys.argv[1])
    draw_shuffle(sys.argv[2])
