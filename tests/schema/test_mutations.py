"""Any change of a metadata file gives records or a `SchemaError`, never another error."""

import copy
import json
import random
from contextlib import suppress
from functools import partial

import pytest

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.geometry.pose_evidence import settled_poses
from stereogenbench_data.schema.parse import parse_caption, parse_complete, parse_rig

VALUES = (
    None, True, 0, -1, 1.5, "x", "Cam_07", [], {}, [1], {"a": 1}, [[1, 2, 3]] * 3, [0, 0, 0, 1],
    float("nan"), 10**400, {"pitch": 1},
)  # fmt: skip
UNKNOWN_KEYS = ("cx", "lengthUnit", "caption", "resolution", "rotationKind", "film back")


def places(value, path=()):
    """Every place of a document but its root."""
    children = value.items() if isinstance(value, dict) else enumerate(value)
    for key, child in children:
        yield *path, key
        if isinstance(child, dict | list):
            yield from places(child, (*path, key))


def mutated(document, pick):
    changed = copy.deepcopy(document)
    *parents, last = pick.choice(list(places(document)))
    holder = changed
    for key in parents:
        holder = holder[key]
    action = pick.random()
    if action < 0.3:
        del holder[last]
    elif action < 0.5 and isinstance(holder, dict):
        holder[pick.choice(UNKNOWN_KEYS)] = pick.choice(VALUES)
    else:
        holder[last] = pick.choice(VALUES)
    return changed


@pytest.fixture
def parsers(rig_document, trajectory_document):
    rig, _, _ = parse_rig(json.dumps(rig_document).encode(), where="baseline.json")
    labels = {"scene_label": "A_1", "scene_index": 1, "map_name": "A", "map_path": "/Game/A"}
    description = {"short_caption": "A yard.", "detailed_caption": "A yard.", "tags": ["yard"]}
    return (
        (parse_rig, rig_document),
        (partial(settled_poses, rig=rig), trajectory_document),
        (parse_complete, labels),
        (parse_caption, description),
    )


@pytest.mark.parametrize("seed", range(2))
def test_a_mutated_file_is_read_or_refused_by_name(parsers, dumped, seed):
    pick = random.Random(seed)
    for parse, document in parsers:
        for _ in range(100):
            with suppress(SchemaError):
                parse(dumped(mutated(document, pick)), where="file.json")
