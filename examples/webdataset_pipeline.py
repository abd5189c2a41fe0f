"""webdataset: a pipeline whose decoder is this package's stage (extra 'webdataset').

python examples/webdataset_pipeline.py [SHARDS]

Each epoch shuffles the shards and, in a buffer, the samples of each worker. A scene's samples come
one after another, so the buffer should hold those of several scenes.
"""

import sys
from pathlib import Path

import webdataset

from stereogenbench_data import collate
from stereogenbench_data.bridges.webdataset import decode

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")
FIELDS = ("left", "right", "disparity", "valid", "__key__")


def main() -> None:
    urls = sorted(map(str, SHARDS.glob("train-*.tar")))
    stage = decode(FIELDS, pairs="adjacent", frames=[0, 40, 80])
    shards = webdataset.WebDataset(urls, shardshuffle=len(urls), detshuffle=True, seed=0)
    samples = shards.compose(stage).shuffle(60, initial=30)
    # Workers that persist count epochs, so that each has an order of its own.
    batches = webdataset.WebLoader(
        samples, batch_size=5, collate_fn=collate, num_workers=2, persistent_workers=True
    )
    for epoch in range(2):
        for number, batch in enumerate(batches):
            mean_px = batch["disparity"][batch["valid"]].mean()
            print(f"epoch {epoch}, batch {number}: mean disparity {mean_px:.1f} px of")
            print(*(f"  {key}" for key in batch["__key__"]), sep="\n")


if __name__ == "__main__":
    main()
