"""One rank under torchrun: write the keys of its batches, of a run stopped and of its rest."""

import itertools
import json
import sys
from pathlib import Path

import torch.distributed

from stereogenbench_data import StereoPairs


def main() -> None:
    data, out = sys.argv[1], Path(sys.argv[2])
    torch.distributed.init_process_group("gloo")
    rank = torch.distributed.get_rank()
    pairs = StereoPairs(data, fields=("__key__",), pairs="adjacent", frames="all")
    loader = pairs.loader(9, num_workers=1, drop_last=False)
    loader.set_epoch(1)
    whole = [batch["__key__"] for batch in loader]
    loader.set_epoch(1)
    taken = [batch["__key__"] for batch in itertools.islice(loader, 3)]
    state = loader.state_dict()
    states = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(states, state)
    found = {"whole": whole, "taken": taken, "states": states}
    (out / f"rank{rank}.json").write_text(json.dumps(found))
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main()
