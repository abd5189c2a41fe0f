"""Code that is given hostile data runs in a process of its own, with little memory and patience."""

from pathlib import Path

from tests.servers.tools import run_python


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
    return run_python("-c", code.replace("# bounded\n", bound), *arguments)
