"""Compiles `derive` as one graph and compares; without pytest, whose type checks cannot be traced.

python -m tests.datasets.compile_derive BACKEND
"""

import sys

import torch

from stereogenbench_data import DERIVED_FIELDS, derive
from tests.datasets.test_derive import CONTRACTS, RIGS, batch_of, scene


def main() -> None:
    for rig, contract in zip(RIGS, ("planar depth", "ray inverse"), strict=True):
        batch = batch_of([scene(CONTRACTS[contract], rig=rig, seed=seed) for seed in (1, 2)])
        torch.compiler.reset()
        compiled = torch.compile(derive, fullgraph=True, backend=sys.argv[1])
        options = {"fields": DERIVED_FIELDS, "pairs": [(0, 5), (2, 1)]}
        made, expected = compiled(batch, **options), derive(batch, **options)
        for name, values in made.items():
            assert torch.equal(values.nan_to_num(), expected[name].nan_to_num()), (rig, name)
        sys.stdout.write(f"{rig} {contract}: {len(made)} fields are equal\n")


if __name__ == "__main__":
    main()
