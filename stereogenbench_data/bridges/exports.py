"""What all exports share: they are of training scenes, unless the user names another split."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast

from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.filters import SceneFilters


def training_filters(options: Mapping[str, Any]) -> SceneFilters:
    """Return the filters on scenes among options; without ``split``, training scenes.

    A model that was trained on evaluation scenes cannot be evaluated on them, so these are exported
    only where ``split`` names them, or is "all".
    """
    names = SceneFilters.__annotations__
    given = {name: options[name] for name in names if options.get(name) is not None}
    found = {"split": "train", **given}
    if found["split"] == "all":
        found["split"] = None
    return cast("SceneFilters", found)


def depth_setting(depth: DepthEncoding | None) -> dict[str, Any] | None:
    """Return a depth encoding as the settings of an export hold it, the same in every process."""
    return None if depth is None else asdict(depth) | {"accept": sorted(depth.accept)}
