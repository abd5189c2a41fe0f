"""Hugging Face datasets, streaming: our samples, and the raw shards (extra 'huggingface').

python examples/huggingface_streaming.py [SHARDS]
"""

import sys
from pathlib import Path

from datasets import load_dataset
from torch.utils.data import DataLoader

from stereogenbench_data.bridges import huggingface

SHARDS = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "shards")


def main() -> None:
    samples = huggingface.iterable(SHARDS, split="train", pairs="adjacent", frames=("every", 40))
    shuffled = samples.shuffle(
        seed=0, buffer_size=1
    )  # shuffles whole scenes, so no samples are buffered
    for number, batch in enumerate(DataLoader(shuffled, batch_size=4, num_workers=2)):
        if number == 0:
            print(f"samples: left {tuple(batch['left'].shape)} {batch['left'].dtype}")
    print(f"samples: {number + 1} batches of {samples.num_shards} scenes")

    rows = load_dataset(
        "webdataset", data_files={"train": sorted(map(str, SHARDS.glob("train-*.tar")))},
        features=huggingface.features(), streaming=True, split="train",
    )  # fmt: skip
    decode = huggingface.decode(("left", "right", "disparity", "valid", "__key__"))
    for sample in rows.map(decode, remove_columns=rows.column_names):
        print(f"raw shards: {sample['__key__']} disparity up to {sample['disparity'].max():.1f} px")


if __name__ == "__main__":
    main()
