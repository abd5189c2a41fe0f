"""Which scenes exports are made of: training scenes, unless evaluation scenes are asked for."""

from collections.abc import Mapping
from typing import Any, cast

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes


def scene_filters(selection: Mapping[str, Any]) -> SceneFilters:
    """Return the filters on scenes among the options of a selection."""
    names = SceneFilters.__annotations__
    return cast("SceneFilters", {name: selection[name] for name in names if name in selection})


def training_selection(
    index: SceneIndex, selection: Mapping[str, Any]
) -> tuple[dict[str, Any], int]:
    """Return a selection without evaluation scenes, and how many were left out.

    A selection whose ``split`` is given stays as it is: a model that was trained on evaluation
    scenes cannot be evaluated on them, so they are taken only if they are asked for.

    Raises:
        SelectionError: If no scene matches, or only evaluation scenes do.
    """
    if selection.get("split") is not None:
        return dict(selection), 0
    rows = filter_scenes(index, scene_filters(selection))
    evaluation = int((index.column("split")[rows] == "eval").sum())
    if evaluation == len(rows):
        raise SelectionError(
            f"{index.where}: only evaluation scenes ({evaluation}) match, and training data are "
            "made of these only if you say so: split='eval', on the command line --split eval."
        )
    return {**selection, "split": "train"}, evaluation
