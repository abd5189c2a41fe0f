"""Arrow's functions on columns: `pyarrow.compute`, imported with the first of them that is called.

Its import takes 0.1 s, and importing this package needs none of them.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    """Return a function of `pyarrow.compute`."""
    import pyarrow.compute

    return getattr(pyarrow.compute, name)
