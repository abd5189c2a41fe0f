"""Code that is given hostile data runs in a process of its own, with little memory and patience."""

import subprocess
import sys
from pathlib import Path

_HANGS_S = 240
"""After how long a process is given up as hanging: hundreds of times what the work takes."""


def run_bounded(code: str, *arguments: str | Path, memory_mb: int | None = None) -> str:
    """Return what Python code prints that may take so much address space beyond its imports.

    The code sees its arguments as ``sys.argv[1:]``. What stands before a line ``# bounded`` is
    done before the bound holds.
    """
    bound = ""
    if memory_mb is not None:
        bound = (
            "import resource\n"
            "taken = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
            f"most = taken + {memory_mb * 2**20}\n"
            "resource.setrlimit(resource.RLIMIT_AS, (most, most))\n"
        )
    done = subprocess.run(
        [sys.executable, "-c", code.replace("# bounded\n", bound), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=_HANGS_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout
