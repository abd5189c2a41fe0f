"""Two real processes of torchrun, with gloo on this machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.datasets.conftest import flat, in_turn, keys_of

SCRIPT = Path(__file__).with_name("ranks.py")


@pytest.fixture(scope="module")
def ranks(small_release, tmp_path_factory):
    out = tmp_path_factory.mktemp("ranks")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    ended = subprocess.run(
        [*torchrun, "--nproc-per-node", "2", SCRIPT, small_release, out],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return [json.loads((out / f"rank{rank}.json").read_text()) for rank in range(2)]


def test_the_ranks_of_torchrun_share_the_epoch_exactly_once(ranks, keyed):
    keyed.set_epoch(1)
    alone = keys_of(keyed.loader(9, drop_last=False))
    together = in_turn([rank["whole"] for rank in ranks])

    assert together == alone
    assert len(flat(together)) == len(set(flat(together))) == 140


def test_a_position_saved_under_torchrun_goes_on_in_one_process(ranks, keyed):
    states = ranks[0]["states"]
    assert states[0] == states[1] == ranks[1]["states"][0]
    loader = keyed.loader(9, drop_last=False, num_workers=1)
    loader.load_state_dict(states[0])
    taken = in_turn([rank["taken"] for rank in ranks])

    assert loader.epoch == 1
    assert taken + keys_of(loader) == in_turn([rank["whole"] for rank in ranks])
