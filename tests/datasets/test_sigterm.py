"""SIGTERM to the process group, as launchers and schedulers send it: the loop ends by itself."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = """
import os, signal, sys
from stereogenbench_data import StereoPairs

def main():
    asked = []
    signal.signal(signal.SIGTERM, lambda *given: asked.append(given))
    pairs = StereoPairs({root!r}, frames="all", split="train", fields=("left",))
    loader = pairs.loader(1, num_workers=2, multiprocessing_context={method!r})
    taken = 0
    while not asked:
        for batch in loader:
            taken += 1
            if taken == 3:
                print("begun", flush=True)
            if asked:
                break
    after = next(iter(loader))["left"].shape[0]
    print("saved", loader.state_dict()["batches_consumed"], after, flush=True)
    held = iter(loader)  # an exit in the middle of a pass
    next(held)
    sys.exit(3)

if __name__ == "__main__":
    main()
"""


def no_process_is_left_of(group):
    """Return whether a process group ends; Python's tracker of resources takes a moment."""
    for _ in range(1000):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_go_on_until_their_parent_ends_them(small_release, tmp_path, method):
    if not hasattr(signal, "sigwaitinfo"):
        pytest.skip("this system does not tell who sent a signal")
    script = tmp_path / "train.py"
    script.write_text(SCRIPT.format(root=str(small_release), method=method))
    ran = subprocess.Popen(
        [sys.executable, script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert ran.stdout.readline() == "begun\n"
    for _ in range(3):
        os.killpg(ran.pid, signal.SIGTERM)
        time.sleep(0.05)
    said, errors = ran.communicate(timeout=120)

    assert ran.returncode == 3, errors
    assert said.startswith("saved ")
    assert "Traceback" not in errors
    assert no_process_is_left_of(ran.pid)
