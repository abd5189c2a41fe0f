"""webdataset: a pipeline whose decoder is this package's stage (extra 'webdataset').

python examples/webdataset_pipeline.py [SHARDS]
"""

import sys
from pathlib import Path

import webdataset

from stereogenbench_data import collate
from stereogenbench_data.bridges.webdataset import decode

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")


def main() -> None:
    urls = sorted(map(str, SHARDS.glob("train-*.tar")))
    stage = decode(("left", "right", "disparity", "valid"), pairs="adjacent", frames=[0, 40, 80])
    samples = webdataset.WebDataset(urls, shardshuffle=len(urls), seed=0).compose(stage)
    batches = webdataset.WebLoader(samples, batch_size=5, collate_fn=collate, num_workers=2)
    for number, batch in enumerate(batches):
        mean_px = batch["disparity"][batch["valid"]].mean()
        print(f"batch {number}: {tuple(batch['left'].shape)}, mean disparity {mean_px:.1f} px")


if __name__ == "__main__":
    main()
