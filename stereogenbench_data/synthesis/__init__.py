"""Scenes in the released layout, drawn without Unreal."""

from stereogenbench_data.synthesis.produce import Progress, synthesise
from stereogenbench_data.synthesis.request import ExportContract, SynthRequest

__all__ = ["ExportContract", "Progress", "SynthRequest", "synthesise"]
