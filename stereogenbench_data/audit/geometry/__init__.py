"""The audit of geometry and pictures, scene by scene, against the paper's."""
