"""Synthetic scenes in the released layout, rendered without Unreal."""

from typing import TYPE_CHECKING, Any

from stereogenbench_data.synthesis.request import ExportContract, SynthRequest

if TYPE_CHECKING:
    from stereogenbench_data.synthesis.produce import synthesise

__all__ = ["ExportContract", "SynthRequest", "synthesise"]


def __getattr__(name: str) -> Any:
    """Import the renderer, and torch with it, on first use."""
    if name != "synthesise":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from stereogenbench_data.synthesis.produce import synthesise

    return synthesise
