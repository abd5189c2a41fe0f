"""Score trained networks on Middlebury pairs that they never saw, beside OpenCV's matcher.

    python examples/stereo/score.py --middlebury DIR RUN [RUN ...] [--picture FILE]

DIR holds folders of Middlebury pairs as they are downloaded (2003, 2006, 2014). Pictures wider than
800 pixels are reduced, those of 2014 to a quarter. Every method is scored on the same pixels: those
whose disparity was measured and that the right camera sees. Of runs that differ by their seeds, the
mean is printed, and in brackets the least and the most.
"""

import argparse
from collections import defaultdict
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure
from network import StereoNetwork
from PIL import Image

from stereogenbench_data import DisparityError

WIDEST = 800
# Left view, right view, disparity of the left view; {} is the folder's name. Disparity stored as
# whole numbers is multiplied: full size is 1800 px wide in 2003, and about 1300 in 2006.
LAYOUTS = [
    ("im2.png", "im6.png", "disp2.png", 1800),
    ("view1.png", "view5.png", "disp1.png", 1300),
    ("im0.png", "im1.png", "disp0.pfm", 0),
    ("left.png", "right.png", "disp_left.tif", 0),
    ("{}_left.png", "{}_right.png", "{}_disp.npz", 0),
]


def read_pair(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return left and right view (h, w, 3) and disparity (h, w) in pixels, 0 where unknown."""
    for *names, full_width in LAYOUTS:
        left, right, truth = (folder / name.format(folder.name) for name in names)
        if not all(path.exists() for path in (left, right, truth)):
            continue
        views = [np.array(Image.open(path).convert("RGB")) for path in (left, right)]
        if truth.suffix == ".npz":
            (disparity,) = np.load(truth).values()
        elif truth.suffix == ".pfm":
            disparity = cv2.imread(str(truth), cv2.IMREAD_UNCHANGED)
        else:
            disparity = np.array(Image.open(truth))
        width = views[0].shape[1]
        disparity = disparity.astype(np.float32) / (round(full_width / width) if full_width else 1)
        disparity[~np.isfinite(disparity)] = 0
        by = -(-width // WIDEST)
        size = (width // by, views[0].shape[0] // by)
        views = [cv2.resize(view, size, interpolation=cv2.INTER_AREA) for view in views]
        return *views, cv2.resize(disparity, size, interpolation=cv2.INTER_NEAREST) / by
    return None


def seen_by_both(disparity: np.ndarray) -> np.ndarray:
    """Return which pixels land in the right view, where nothing nearer lands."""
    rows, columns = np.nonzero(disparity)
    values = disparity[rows, columns]
    landing = np.round(columns - values).astype(int)
    inside = landing >= 0
    nearest = np.zeros_like(disparity)
    np.maximum.at(nearest, (rows[inside], landing[inside]), values[inside])
    seen = np.zeros(disparity.shape, dtype=bool)
    seen[rows[inside], columns[inside]] = (
        values[inside] > nearest[rows[inside], landing[inside]] - 1
    )
    return seen


def by_opencv(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return semi-global matching's disparity; where it has none, the next smaller of the row."""
    least, most = 0, 96
    matcher = cv2.StereoSGBM_create(
        least, most, 5, P1=8 * 3 * 25, P2=32 * 3 * 25, disp12MaxDiff=1, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    # Without columns before the first one, it leaves as many as it searches unanswered.
    left, right = (
        cv2.copyMakeBorder(v, 0, 0, most, 0, cv2.BORDER_REPLICATE) for v in (left, right)
    )
    found = matcher.compute(left, right)[:, most:].astype(np.float32) / 16
    known = found >= least
    columns = np.arange(found.shape[1])
    before = np.maximum.accumulate(np.where(known, columns, 0), axis=1)
    after = np.minimum.accumulate(np.where(known, columns, columns[-1])[:, ::-1], axis=1)[:, ::-1]
    beside = [np.take_along_axis(found, where, axis=1) for where in (before, after)]
    beside = [np.where(each >= least, each, np.inf) for each in beside]
    filled = np.where(known, found, np.minimum(*beside))
    return np.where(np.isfinite(filled), filled, 0)


def by_network(network: StereoNetwork, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return a trained network's disparity."""
    views = [torch.from_numpy(view).permute(2, 0, 1)[None] for view in (left, right)]
    with torch.no_grad():
        return network(*views)[0, 0].numpy()


def errors(found: np.ndarray, truth: np.ndarray, scored: np.ndarray) -> tuple[float, float]:
    """Return the mean error in px, and the share of scored pixels that are more than 2 px wrong."""
    error = DisparityError()
    error.update(*map(torch.from_numpy, (found, truth, scored)))
    measures = error.compute()
    return measures["epe"], measures["bad_2"]


def cell(scores: np.ndarray) -> str:
    """Return the error in px and the share over 2 px of runs, (runs, 2), for the table."""
    texts = []
    for values, unit, form in ((scores[:, 0], "px", ".2f"), (100 * scores[:, 1], "%", ".1f")):
        spread = f" ({values.min():{form}} to {values.max():{form}})" if len(values) > 1 else ""
        texts.append(f"{values.mean():{form}} {unit}{spread}")
    return ", ".join(texts)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("runs", nargs="*", type=Path)
    options.add_argument("--middlebury", type=Path, required=True)
    options.add_argument("--picture", type=Path)
    given = options.parse_args()
    found = {folder.name: read_pair(folder) for folder in sorted(given.middlebury.iterdir())}
    pairs = {name: pair for name, pair in found.items() if pair is not None}
    if not pairs:
        options.error(f"{given.middlebury}: no folder holds a Middlebury pair.")
    methods = {"OpenCV SGBM": [by_opencv]}
    for run in given.runs:
        saved = torch.load(run / "checkpoint.pt", weights_only=True)
        network = StereoNetwork().eval()
        network.load_state_dict(saved["network"])
        of_kind = methods.setdefault(f"trained on {saved['pairs']} pairs", [])
        of_kind.append(partial(by_network, network))

    figure = Figure(figsize=(3 * (2 + len(methods)), 2.3 * len(pairs)), layout="constrained")
    tiles = figure.subplots(len(pairs), 2 + len(methods), squeeze=False)
    scores = defaultdict(list)  # of each method: of each pair, (runs, 2)
    for row, (name, (left, right, truth)) in zip(tiles, pairs.items(), strict=True):
        scored = seen_by_both(truth)
        shown = [(name, left), ("measured", truth)]
        for method, runs in methods.items():
            predicted = [predict(left, right) for predict in runs]
            scores[method].append(np.array([errors(each, truth, scored) for each in predicted]))
            shown.append((method, predicted[0]))
        for tile, (title, picture) in zip(row, shown, strict=True):
            tile.imshow(picture, vmin=0, vmax=truth.max(), cmap="turbo")
            tile.set_title(title, fontsize=8)
            tile.set_axis_off()
    if given.picture:
        figure.savefig(given.picture, dpi=80)

    print("| method | " + " | ".join(pairs) + " | mean |\n|---|" + "---|" * (len(pairs) + 1))
    for method, of_pairs in scores.items():
        cells = map(cell, [*of_pairs, np.mean(of_pairs, axis=0)])
        print(f"| {method} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
