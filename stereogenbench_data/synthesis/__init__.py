"""Synthetic scenes in the released layout, rendered without Unreal."""
