"""The record sets that name all values of split, subset, family and map."""

from typing import Final

from stereogenbench_data.bridges.croissant_terms import Node, enumeration
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import FAMILIES, TRAIN_MAPS, UNSEEN_MAPS


def enumerations(index: SceneIndex | None) -> list[Node]:
    """Return them as the index has them, or as the paper lists them for the release if None."""
    if index is None:
        families, train = list(FAMILIES), set(TRAIN_MAPS)
        maps = sorted(TRAIN_MAPS | UNSEEN_MAPS)
    else:
        families = sorted(set(index.column("family")))
        maps = sorted(set(index.column("map_name")))
        train = set(index.column("map_name")[index.column("split") == "train"])
    return [
        enumeration(
            "splits", "Parts of the dataset.", {
                "train": "For training.",
                "eval": "For evaluation; no scene of it is in train.",
            }, kind="cr:Split",
        ),
        enumeration(
            "eval_subsets", "Parts of eval.", {
                "seen_map": "On maps that train has scenes of.",
                "unseen_map": "On maps that train has no scene of.",
            }, kind="sc:Enumeration",
        ),
        enumeration(
            "families", "How the distances between cameras are drawn.",
            {name: _FAMILIES.get(name, "A family of its own.") for name in families},
            kind="sc:Enumeration",
        ),
        enumeration(
            "maps", "The environments of the scenes.",
            {name: "in train" if name in train else "in eval alone" for name in maps},
            kind="sc:Enumeration",
        ),
    ]  # fmt: skip


_FAMILIES: Final = {
    "IPD_Gaussian": "Adjacent cameras about 6.4 cm apart, as human eyes are.",
    "Uniform": "Adjacent cameras 1 to 150 cm apart, evenly.",
    "Pairwise_Uniform": "All pairs up to 200 cm apart; in train alone.",
}
