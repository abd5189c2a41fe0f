"""The dataset card of packed shards: a ``README.md`` for the Hub and for ``datasets``.

``load_dataset("ORG/NAME", "Uniform", split="train", streaming=True)`` reads from its YAML head
which shards to load, and that videos stay bytes. The rest is for people.
"""

import fnmatch
import json
from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from stereogenbench_data.bridges import dataset_facts, viewer
from stereogenbench_data.engine import Progress
from stereogenbench_data.errors import DescriptorError, describe_os_error
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    DESCRIPTION_TXT,
    METADATA_FILES,
    TRAINING_JSON,
)
from stereogenbench_data.schema.text import counted, markdown_text
from stereogenbench_data.sources.files import write_atomic

CARD_NAME: Final = "README.md"
_SCENES: Final = "scenes"
MARK: Final = "<!-- made by stereogenbench card -->"
"""Marks a card that this package wrote. A README.md without it is never overwritten."""
_TASKS: Final = ("depth-estimation", "image-to-image", "image-to-video", "image-to-3d")
"""Tasks that the Hub lists for datasets; it hides video-to-video there."""
_TAGS: Final = (
    "stereo", "disparity", "view-synthesis", "multi-view", "synthetic", "benchmark", "3d", "image",
    "video", "webdataset", "mlcroissant", f"arxiv:{dataset_facts.ARXIV}",
)  # fmt: skip
"""Among them the Hub's names of modalities (3d, image, video) and libraries."""
_Configs = dict[str, dict[str, list[str]]]
_SIZES: Final = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))
_ADJACENT: Final = [CAMERA_PAIRS.index(pair) for pair in ADJACENT_PAIRS]


def card(index: SceneIndex, *, repository: str, about: dataset_facts.About | None = None) -> str:
    """Return the card of shards, whose config "scenes" is what `viewer` writes beside them.

    Args:
        index: The index of the shards.
        repository: "ORG/NAME" on the Hub.
        about: What the user states of the scenes, as for `dataset_facts.facts_of`.

    Raises:
        DescriptorError: If the data are not shards, or who made them is not known.
    """
    if not index.shards:
        raise DescriptorError(f"{index.where}: not a folder of shards. Pack the data first.")
    facts = dataset_facts.facts_of(index, about=about)
    configs = _configs(index)
    lines = [*_head(index, facts, configs), MARK, "", *_body(index, facts, configs, repository)]
    return "\n".join(lines) + "\n"


def write_card(
    index: SceneIndex,
    folder: Path,
    *,
    repository: str,
    about: dataset_facts.About | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the card beside the shards, and the scenes that the Hub's viewer shows.

    Args:
        index: The index of the shards.
        folder: Where to write.
        repository: "ORG/NAME" on the Hub.
        about: As for `card`.
        progress: Called with (scenes done, scenes in all) while pictures of scenes are written.

    Raises:
        DescriptorError: If a file cannot be written, the folder has another README.md, or who made
            the scenes is not known.
        StorageError, MediaError: If a scene's pictures cannot be read.
    """
    path = folder / CARD_NAME
    text = card(index, repository=repository, about=about)
    try:
        if path.exists() and MARK.encode() not in path.read_bytes():
            raise DescriptorError(
                f"{path}: exists and was not written by this package. Move it away, or add "
                f"{MARK!r} to it to have it replaced."
            )
        viewer.write_viewer_rows(index, folder, progress=progress)
        write_atomic(path, text.encode())
    except OSError as error:
        raise DescriptorError(
            describe_os_error(
                f"{path}: cannot be written", error, "Choose another place with --out."
            )
        ) from error
    return path


def _head(index: SceneIndex, facts: dataset_facts.Facts, configs: _Configs) -> list[str]:
    """Return the YAML head; JSON texts are YAML too.

    The Hub shows "all" first, and `datasets` loads it without a config. It reads every config in
    the format of the first one.
    """
    licence = dataset_facts.LICENCE_NAMES.get(facts["license"])
    other = [
        "license: other",
        "license_name: other",
        f"license_link: {json.dumps(facts['license'])}",
    ]
    lines = [
        "---",
        f"pretty_name: {json.dumps(facts['name'])}",
        *(other if licence is None else [f"license: {licence}"]),
        "language:",
        f"- {facts.get('inLanguage', 'en')}",
        "task_categories:",
        *(f"- {task}" for task in _TASKS),
        "tags:",
        *(f"- {tag}" for tag in _TAGS),
        "size_categories:",
        f"- {next((name for most, name in _SIZES if len(index) < most), '100K<n<1M')}",
        "configs:",
    ]
    for config, splits in configs.items():
        lines.append(f"- config_name: {config}")
        if config == "all":
            lines.append("  default: true")
        lines.append("  data_files:")
        for split, paths in splits.items():
            lines += [f"  - split: {split}", f"    path: {json.dumps(paths)}"]
    lines.append("dataset_info:")
    for config in configs:
        lines += [f"- config_name: {config}", "  features:"]
        features = viewer.FEATURES if config == _SCENES else _features(index)
        for name, kind in features.items():
            lines += [f"  - name: {name}", f"    dtype: {kind}"]
    return [*lines, "---"]


def _features(index: SceneIndex) -> dict[str, str]:
    kinds = {name: "string" if name == DESCRIPTION_TXT else "json" for name in METADATA_FILES}
    members = index.scene(0).members
    videos = sorted(name for name in members if name.startswith("cam_"))
    kinds |= {TRAINING_JSON: "json"} if TRAINING_JSON in members else {}
    return kinds | dict.fromkeys(videos, "binary") | {"__key__": "string", "__url__": "string"}


def _configs(index: SceneIndex) -> _Configs:
    """Return config to split to patterns of tars: a config for all, one a family, the scenes."""
    found: dict[str, dict[str, set[str]]] = {}
    for row in range(len(index)):
        scene = index.scene(row)
        split = viewer.split_name(scene.id)
        path = next(iter(scene.members.values())).path
        for config in ("all", scene.id.family):
            found.setdefault(config, {}).setdefault(split, set()).add(path)
    configs = {
        config: {
            split: _patterns(paths, index)
            for split, paths in sorted(
                splits.items(), key=lambda item: (item[0] != "train", item[0])
            )
        }
        for config, splits in sorted(found.items(), key=lambda item: (item[0] != "all", item[0]))
    }
    scenes = {split: [viewer.viewer_tar(split)] for split in configs["all"]}
    return configs | {_SCENES: scenes}


def _patterns(paths: set[str], index: SceneIndex) -> list[str]:
    """Return a few patterns that match these shards and no others."""
    patterns: set[str] = set()
    for path in paths:
        pattern = f"{path.rpartition('-')[0]}-*.tar"
        matched = set(fnmatch.filter(index.shards, pattern))
        patterns.add(pattern if matched <= paths else path)
    return sorted(patterns)


def _body(
    index: SceneIndex, facts: dataset_facts.Facts, configs: _Configs, repository: str
) -> list[str]:
    config = next(name for name in configs if name != "all")
    split = next(iter(configs[config]))
    size = "" if index.is_derived else ", size=(480, 832)"
    sections = ("dataUseCases", "dataLimitations", "dataBiases", "personalSensitiveInformation")
    return [
        f"# {markdown_text(facts['name'])}",
        "",
        markdown_text(facts["description"]),
        "",
        f"Paper: [{dataset_facts.TITLE}]({dataset_facts.PAPER}).",
        "",
        *_derivation(index),
        "## How to load",
        "",
        "With stereogenbench-data and its extra `hub`, which reads only the bytes that a sample",
        "needs, derives disparity from depth and keeps one order of samples:",
        "",
        "```python",
        "from stereogenbench_data import StereoPairs",
        "",
        f'pairs = StereoPairs("hf://datasets/{repository}", split="{split.partition("_")[0]}",',
        f'                    family="{config}", pairs="all", frames="all"{size})',
        "loader = pairs.loader(batch_size=8, num_workers=2, seed=0)",
        "```",
        "",
        "With `datasets`, as bytes (videos are not decoded: that would cut depth to 8 bits):",
        "",
        "```python",
        "from datasets import load_dataset",
        "",
        f'rows = load_dataset("{repository}", "{config}", split="{split}", streaming=True)',
        "```",
        "",
        "The shards are plain WebDataset tars, one scene a sample: `webdataset`, Ray and `tar`",
        "read them as they are. `index.parquet` holds where every file lies, with its checksum.",
        "",
        f"The config `{_SCENES}` has one row a scene, with a small picture: choose it in the",
        f'viewer, or load it by `load_dataset("{repository}", "{_SCENES}")`. `croissant.json`',
        "describes the files for mlcroissant, with tables of scenes and pairs in `croissant/`.",
        "",
        "## What is in it",
        "",
        *_counts(index),
        "",
        *_facts(index),
        "",
        "## Depth",
        "",
        *_depth(index),
        "",
        "## Licence",
        "",
        f"{facts['license']}. {markdown_text(facts['usageInfo'])}",
        "",
        "## Where it comes from",
        "",
        *_provenance(facts),
        "",
        "## Responsible use",
        "",
        *(
            f"- {markdown_text(text)}"
            for section in sections
            for text in dataset_facts.listed(facts[f"rai:{section}"])
        ),
        "",
        "## Citation",
        "",
        "```bibtex",
        facts["citeAs"].rstrip().replace("```", ""),
        "```",
    ]


def _provenance(facts: dataset_facts.Facts) -> list[str]:
    nodes = [
        *dataset_facts.listed(facts["prov:wasGeneratedBy"]),
        *dataset_facts.listed(facts["prov:wasDerivedFrom"]),
    ]
    return [
        f"- {markdown_text(str(node['prov:label']))}: {markdown_text(str(node['description']))}"
        for node in nodes
    ]


def _derivation(index: SceneIndex) -> list[str]:
    if not index.is_derived:
        return []
    facts = dataset_facts.derivation_facts(index)
    psnr_db = facts["psnr_db"]
    return [
        "## Derived for training",
        "",
        f"{dataset_facts.DERIVED}",
        "",
        f"- size {facts['size']}, quality {facts['quality']}, pictures by {facts['codec']}, depth "
        f"by blosc2 without loss",
        f"- PSNR of pictures: {psnr_db['mean']:.2f} dB on average, {psnr_db['worst_frame']:.2f} "
        f"in the worst frame",
        f"- source: the release with index {facts['source_digest']}",
        f"- settings: `{json.dumps(facts['settings'], sort_keys=True)}`",
        "",
    ]


def _counts(index: SceneIndex) -> list[str]:
    columns = (index.column(name) for name in ("split", "subset", "family"))
    kinds = list(zip(*columns, strict=True))
    adjacent_cm = index.column("baselines_cm")[:, _ADJACENT]
    lines = [
        "| split | subset | family | scenes | pairs | adjacent baselines, cm |",
        "|---|---|---|---:|---:|---|",
    ]
    for kind in sorted(set(kinds), key=lambda each: (each[0] != "train", str(each[1]), each[2])):
        rows = [number for number, each in enumerate(kinds) if each == kind]
        low, high = adjacent_cm[rows].min(), adjacent_cm[rows].max()
        split, subset, family = kind
        lines.append(
            f"| {split} | {subset or ''} | {markdown_text(family)} | {len(rows)} "
            f"| {len(rows) * len(CAMERA_PAIRS)} | {low:.2f} to {high:.2f} |"
        )
    return lines


def _facts(index: SceneIndex) -> list[str]:
    sizes = Counter(
        zip(index.column("image_width_px"), index.column("image_height_px"), strict=True)
    )
    frames = Counter(index.column("frames").tolist())
    focal_mm, maps = index.column("focal_mm"), set(index.column("map_name"))
    bytes_ = sum(shard.size for shard in index.shards.values())
    listed = ", ".join(f"{width}x{height}" for (width, height), _ in sizes.most_common())
    counts = ", ".join(str(count) for count, _ in frames.most_common())
    return [
        f"- {counted(len(index), 'scene')} on {counted(len(maps), 'map')}, in "
        f"{counted(len(index.shards), 'shard')} of {bytes_ / 1e9:.3g} GB together",
        f"- {CAMERA_COUNT} cameras a scene: pictures of {listed}, {counts} frames",
        f"- focal lengths of {focal_mm.min():.1f} to {focal_mm.max():.1f} mm",
    ]


def _depth(index: SceneIndex) -> list[str]:
    units = sorted(set(index.column("depth_unit_m").ravel().tolist()))
    codecs = sorted(set(index.column("depth_codec").ravel().tolist()))
    formats = sorted(set(index.column("depth_pixel_format").ravel().tolist()))
    sources = set(np.ravel(index.column("depth_unit_source")).tolist())
    scale = "each file's own tag" if sources == {"tag"} else "each file's tag, else 0.1 m"
    advice = ["Decode them in their own pixel format: a decoder that gives 8 bits destroys them."]
    if "blosc2" in codecs:
        advice = [
            "They are blosc2 frames (`.b2frame`), which no decoder of videos reads: `StereoPairs`",
            "takes them as they are, and `stereogenbench unpack` turns them back into videos.",
        ]
    return [
        f"Depth files hold whole numbers ({', '.join(codecs)}, {', '.join(formats)}).",
        f"Metres along the optical axis are the number times {scale}",
        f"({', '.join(f'{unit:g}' for unit in units)} m here); 0 and the largest number mean that",
        "nothing was measured.",
        *advice,
    ]
