"""Matplotlib's figures, which draw without a display."""

from typing import Any

from stereogenbench_data.errors import missing_extra


def figure_class() -> Any:
    """Return matplotlib's `Figure`.

    Raises:
        ExtraError: If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("plots", "plots", error) from error
    return Figure
