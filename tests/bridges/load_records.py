"""Load every record set of descriptors with mlcroissant, and print the records as JSON, by path.

It runs in its own process, because mlcroissant reads the place of its cache when it is imported,
and names what it unpacked by URL alone.
"""

import json
import sys
import zlib
from pathlib import Path

import mlcroissant as mlc

MEDIA = ("rgb_videos", "depth_videos", "baseline_json", "trajectory_json", "scene_complete_json")


def loaded(path: str) -> dict:
    """Return the records of every set, in both orders, and whether a dict gives a first of each."""
    document = json.loads(Path(path).read_text())
    names = [records["@id"] for records in document["recordSet"]]
    forwards, backwards = mlc.Dataset(jsonld=path), mlc.Dataset(jsonld=path)
    found = {name: list(forwards.records(name)) for name in names}
    again = {name: len(list(backwards.records(name))) for name in reversed(names)}
    report = {
        "counts": {name: len(records) for name, records in found.items()},
        "backwards": again,
        "contents": {
            name: sorted(
                [_text(row[f"{name}/scene_id"]), row.get(f"{name}/camera"), _crc(row, name)]
                for row in found[name]
            )
            for name in MEDIA
            if name in found
        },
        "scenes": [
            {key: _text(value) for key, value in row.items()} for row in found.get("scenes", [])
        ],
        "baselines": [row["pairs/baseline_cm"] for row in found.get("pairs", [])],
    }
    if all("://" in each.get("contentUrl", "://") for each in document["distribution"]):
        strict = mlc.Dataset(jsonld=document)
        report["first_of_each"] = [bool(next(iter(strict.records(name)))) for name in names]
    return report


def _crc(row: dict, name: str) -> int:
    return zlib.crc32(row[f"{name}/content"])


def _text(value: object) -> object:
    return value.decode() if isinstance(value, bytes) else value


print(json.dumps([loaded(path) for path in sys.argv[1:]]))  # noqa: T201 - the parent reads it
