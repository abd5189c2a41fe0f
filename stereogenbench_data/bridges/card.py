"""The dataset card of packed shards: a ``README.md`` for the Hub and for ``datasets``.

``load_dataset("ORG/NAME", "Uniform", split="train", streaming=True)`` reads from its YAML head
which shards to load, and that videos stay bytes. The rest is for people: the template `card.md`.
"""

import fnmatch
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

from stereogenbench_data.bridges import dataset_facts
from stereogenbench_data.bridges.in_memory import columns
from stereogenbench_data.errors import DescriptorError, explain_os_errors, needs_extra
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    CAMERA_PAIRS,
    TRAINING_JSON,
)
from stereogenbench_data.schema.text import counted, markdown_text
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import is_remote, local_path
from stereogenbench_data.sources.members import require_own_files

CARD_NAME: Final = "README.md"
MARK: Final = "<!-- made by stereogenbench publish card -->"
"""Marks a card that this package wrote. A README.md without it is never overwritten."""
_TASKS: Final = ("depth-estimation", "image-to-image", "image-to-video", "image-to-3d")
"""Tasks that the Hub lists for datasets; it hides video-to-video there."""
_TAGS: Final = (
    "stereo", "disparity", "view-synthesis", "multi-view", "synthetic", "benchmark", "3d", "image",
    "video", "webdataset", "mlcroissant", "arxiv:2605.23237",
)  # fmt: skip
"""Among them the Hub's names of modalities (3d, image, video) and libraries."""
_LICENCES: Final = {
    "https://creativecommons.org/licenses/by/4.0/": "cc-by-4.0",
    "https://opensource.org/license/mit": "mit",
}
"""The Hub's name of a licence, by its URL."""
_SIZES: Final = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))


def card(index: SceneIndex, *, repository: str, about: dataset_facts.About | None = None) -> str:
    """Return the card of shards.

    Args:
        index: The index of the shards.
        repository: "ORG/NAME" on the Hub.
        about: What the user states of the scenes, as for `dataset_facts.facts_of`.

    Raises:
        ExtraError: If huggingface_hub is not installed.
        DescriptorError: If the data are not shards, or who made them is not known.
    """
    if not index.shards:
        raise DescriptorError(f"{index.where}: not a folder of shards. Pack the data first.")
    with needs_extra("the dataset card", "hub"):
        from huggingface_hub import DatasetCard, DatasetCardData
    facts, configs = dataset_facts.facts_of(index, about=about), _configs(index)
    family = next(name for name in configs if name != "all")
    made = DatasetCard.from_template(
        DatasetCardData(**_head(index, facts, configs)),
        template_path=str(Path(__file__).with_name("card.md")),
        text=markdown_text,
        counted=counted,
        facts=facts,
        repository=repository,
        config=family,
        split=next(iter(configs[family])),
        derived=dataset_facts.STEPS["derived_text"] if index.is_derived else "",
        **_numbers(index),
    )
    return f"{made.content.rstrip()}\n"


def write_card(
    index: SceneIndex,
    folder: Path,
    *,
    repository: str,
    about: dataset_facts.About | None = None,
) -> Path:
    """Write the card, and check that a client of the Hub would upload the shards' own files alone.

    Args:
        index: The index of the shards.
        folder: Where to write.
        repository: "ORG/NAME" on the Hub.
        about: As for `card`.

    Raises:
        ExtraError: If huggingface_hub is not installed.
        DescriptorError: If a file cannot be written, the folder has another README.md, or who made
            the scenes is not known.
        StorageError: If a shard leads out of its folder by a link, which would be followed.
    """
    path = folder / CARD_NAME
    if not is_remote(index.root):
        require_own_files(local_path(index.root), [*index.shards, INDEX_NAME])
    text = card(index, repository=repository, about=about)
    cannot = f"{path}: cannot be written"
    with explain_os_errors(cannot, "Choose another place with --out.", kind=DescriptorError):
        if path.exists() and MARK.encode() not in path.read_bytes():
            raise DescriptorError(
                f"{path}: exists and was not written by this package. Move it away, or add "
                f"{MARK!r} to it to have it replaced."
            )
        write_atomic(path, text.encode())
    return path


_Configs = dict[str, dict[str, list[str]]]


def _head(index: SceneIndex, facts: dataset_facts.Facts, configs: _Configs) -> dict[str, Any]:
    """Return the YAML head.

    The Hub shows "all" first, and `datasets` loads it without a config. It reads every config in
    the format of the first one.
    """
    licence = _LICENCES.get(facts["license"])
    other = {"license": "other", "license_name": "other", "license_link": facts["license"]}
    members = index.scene(0).members
    videos = sorted(name for name in members if name.startswith("cam_"))
    own = columns(videos, of_training=TRAINING_JSON in members)
    return {
        "pretty_name": facts["name"],
        **(other if licence is None else {"license": licence}),
        "language": [facts.get("inLanguage", "en")],
        "task_categories": [*_TASKS],
        "tags": [*_TAGS],
        "size_categories": [
            next((name for most, name in _SIZES if len(index) < most), "100K<n<1M")
        ],
        "configs": [
            {
                "config_name": config,
                **({"default": True} if config == "all" else {}),
                "data_files": [{"split": split, "path": paths} for split, paths in splits.items()],
            }
            for config, splits in configs.items()
        ],
        "dataset_info": [
            {
                "config_name": config,
                "features": [{"name": name, "dtype": kind} for name, kind in own.items()],
            }
            for config in configs
        ],
    }


def _configs(index: SceneIndex) -> _Configs:
    """Return config to split to patterns of tars: a config for all, and one a family."""
    found: dict[str, dict[str, set[str]]] = {"all": {}}
    for row in range(len(index)):
        scene = index.scene(row)
        path = next(iter(scene.members.values())).path
        # The Hub has no subsets of splits.
        split = scene.id.split if scene.id.subset is None else f"{scene.id.split}_{scene.id.subset}"
        for config in ("all", scene.id.family):
            found.setdefault(config, {}).setdefault(split, set()).add(path)
    configs = {}
    for config in ["all", *sorted(found.keys() - {"all"})]:
        names = sorted(found[config], key=lambda split: (split != "train", split))
        configs[config] = {split: _patterns(found[config][split], index) for split in names}
    return configs


def _patterns(paths: set[str], index: SceneIndex) -> list[str]:
    """Return a few patterns that match these shards and no others."""
    patterns: set[str] = set()
    for path in paths:
        pattern = f"{path.rpartition('-')[0]}-*.tar"
        matched = set(fnmatch.filter(index.shards, pattern))
        patterns.add(pattern if matched <= paths else path)
    return sorted(patterns)


def _numbers(index: SceneIndex) -> dict[str, Any]:
    """Return what the template counts and measures."""
    column = index.column
    adjacent = [CAMERA_PAIRS.index(pair) for pair in ADJACENT_PAIRS]
    kinds = [*zip(column("split"), column("subset"), column("family"), strict=True)]
    parts = []
    for kind in sorted(set(kinds), key=lambda each: (each[0] != "train", str(each[1]), each[2])):
        rows = [number for number, each in enumerate(kinds) if each == kind]
        adjacent_cm = column("baselines_cm")[rows][:, adjacent]
        parts.append(
            dict(zip(("split", "subset", "family"), kind, strict=True))
            | {"scenes": len(rows), "adjacent_cm": (adjacent_cm.min(), adjacent_cm.max())}
        )
    sizes = Counter(zip(column("image_width_px"), column("image_height_px"), strict=True))
    return {
        "parts": parts,
        "scenes": len(index),
        "maps": len(set(column("map_name"))),
        "shards": len(index.shards),
        "gigabytes": sum(shard.size for shard in index.shards.values()) / 1e9,
        "sizes": [f"{width}x{height}" for (width, height), _ in sizes.most_common()],
        "frames": [count for count, _ in Counter(column("frames").tolist()).most_common()],
        "focal_mm": (column("focal_mm").min(), column("focal_mm").max()),
        "depth_units": [f"{unit:g}" for unit in np.unique(column("depth_unit_m"))],
        "depth_codecs": sorted(set(column("depth_codec").ravel().tolist())),
        "depth_formats": sorted(set(column("depth_pixel_format").ravel().tolist())),
        "every_tag": set(np.ravel(column("depth_unit_source")).tolist()) == {"tag"},
    }
