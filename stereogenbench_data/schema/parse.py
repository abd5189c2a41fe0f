"""Untrusted metadata to typed records: the one place where other layers look for a parser.

Each function gathers every problem of its file and raises one `SchemaError` that names the file
and each problem's JSON path.
"""

from stereogenbench_data.schema.labels import parse_complete, parse_description, parse_scene_key
from stereogenbench_data.schema.rig import parse_rig
from stereogenbench_data.schema.trajectory import parse_trajectory

__all__ = [
    "parse_complete",
    "parse_description",
    "parse_rig",
    "parse_scene_key",
    "parse_trajectory",
]
