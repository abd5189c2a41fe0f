"""Print which part of a training's time is spent waiting for data.

    python examples/stereo/waiting.py SCENES SHARDS [--steps N]

Both hold the same scenes, as drawn and as training shards. The steps are those of train.py.
"""

import argparse
import time
from itertools import islice

from network import StereoNetwork
from train import BATCH, CROP, FIELDS, training_pairs


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("scenes")
    options.add_argument("shards")
    options.add_argument("--steps", type=int, default=60)
    given = options.parse_args()
    network = StereoNetwork()
    print("| data | workers | samples/s | waiting for data |\n|---|---:|---:|---:|")
    for data in (given.scenes, given.shards):
        training = training_pairs(data, pairs="all", crop=CROP, seed=0)
        for workers in (0, 1, 2):
            loader = training.loader(BATCH, num_workers=workers, seed=0)
            began = time.perf_counter()
            for batch in islice(loader, given.steps):
                network.zero_grad()
                loss = network.loss(*(batch[name] for name in FIELDS))
                loss.backward()
            rate = given.steps * BATCH / (time.perf_counter() - began)
            waiting = loader.stats().waiting
            print(f"| {data} | {workers} | {rate:.1f} | {waiting:.1%} |", flush=True)


if __name__ == "__main__":
    main()
