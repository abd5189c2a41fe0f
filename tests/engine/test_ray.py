"""Batch commands on Ray, tested in a process of its own.

Forks of a process that used Ray 2.60 die in its library, and other tests fork.
"""

import subprocess
import sys
from pathlib import Path

from tests.servers.tools import require_module


def test_every_case_of_ray_passes():
    require_module("ray")
    cases = Path(__file__).with_name("ray_cases.py")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-rs"]
    # Ray 2.45 leaves /dev/null open.
    command += ["-W", "ignore::pytest.PytestUnraisableExceptionWarning", str(cases)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-2000:]
    assert " passed" in done.stdout
