"""Scenes of a user's own assets, rendered by Blender's Cycles in a process of its own."""
