"""A report of a tree's format that may be pasted into a public issue: structure, and no content.

It shows keys of JSON with the kinds of their values, sizes of files, codecs, names of tags and the
evidence about them. Values of texts, captions, names of maps, characters, scenes and machines, and
paths are left out. A number is shown only where it is a scale; a text only if each of its words is
one of a list that says how files are read.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any, Final

from stereogenbench_data.audit.conventions import Survey
from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.index.learning import Examined
from stereogenbench_data.index.tree import SceneFolder, folder_of
from stereogenbench_data.media.container import StreamFacts
from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import FAMILIES, METADATA_FILES
from stereogenbench_data.schema.text import counted
from stereogenbench_data.schema.units import UNITS_M, words

_FORM_WORDS: Final = UNITS_M.keys() | {
    "unreal", "rotator", "rotators", "quaternion", "quaternions", "euler", "matrix", "degrees",
    "degree", "deg", "radians", "radian", "rad", "xyzw", "wxyz", "pitch", "yaw", "roll", "world",
    "camera", "cam", "to", "from", "c2w", "w2c", "opencv", "opengl", "blender", "ros", "colmap",
    "left", "right", "handed", "up", "forward", "x", "y", "z", "row", "column", "rows", "columns",
    "major", "representation", "rotation", "planar", "ray", "depth", "inverse", "per", "unit",
    "units", "px", "pixels",
}  # fmt: skip
"""Words that say how files are read; `_kind` shows texts that consist of them."""
_SCALE: Final = re.compile(
    r"\s*[-+]?[0-9.]+(?:e[-+]?[0-9]+)?\s*(?:mm|cm|m|meters?|metres?)?\s*", re.I
)
_LIBRARY: Final = re.compile(r"Lav[cf][0-9. a-z]{0,24}[a-z0-9]*", re.I)
_KEY: Final = re.compile(r"[a-z0-9#_]{1,40}")
_MOST_KEYS: Final = 200
_MOST_OF_OBJECT: Final = 40
"""An object with more keys has names of things as keys, which are content."""
_HIDDEN: Final = "<name>"


def format_report(survey: Survey) -> str:
    """Return the report of some scenes' format as Markdown."""
    groups: dict[frozenset[str], list[Examined]] = {}
    for each in survey.examined:
        groups.setdefault(each.keys, []).append(each)
    lines = [
        f"stereogenbench-data {version('stereogenbench-data')}: "
        f"{counted(len(survey.examined), 'scene')}, {counted(len(groups), 'shape')} of files"
    ]
    for number, group in enumerate(sorted(groups.values(), key=len, reverse=True), 1):
        lines += ["", *_shape_lines(survey.root, number, group)]
    lines += ["", "pictures:", *(f"  {_public(each, survey)}" for each in survey.verdicts or ["-"])]
    lines += ["not settled:", *(f"  {_public(each, survey)}" for each in survey.problems or ["-"])]
    return "\n".join(lines)


def _shape_lines(root: str, number: int, group: Sequence[Examined]) -> Iterator[str]:
    first = group[0]
    families = Counter(parse_scene_key(each.key).family for each in group)
    known = {name: count for name, count in families.items() if name in FAMILIES}
    others = len(group) - sum(known.values())
    told = [f"{count} {name}" for name, count in sorted(known.items())]
    told += [f"{others} of other families"] if others else []
    yield f"shape {number}: {counted(len(group), 'scene')} ({', '.join(told)})"
    sizes: dict[str, list[int]] = {}
    for each in group:
        for name, (size, _) in folder_of(root, each.key).stamps().items():
            sizes.setdefault(re.sub(r"cam_\d\d", "cam_##", name), []).append(size)
    for name, found in sorted(sizes.items()):
        yield f"  {name}: {counted(len(found), 'file')}, {min(found):,} to {max(found):,} bytes"
    secrets = _secrets(group)
    folder = folder_of(root, first.key)
    for name in METADATA_FILES:
        if name in folder.stamps() and name.endswith(".json"):
            yield f"  {name}:"
            yield from _document_lines(folder, name, secrets)
    if first.depth is not None:
        yield f"  depth: {_stream(first.depth, secrets)}"
    scene = first.scene
    if scene is None:
        yield "  cannot be used"
        return
    about = sorted({remark.about for remark in scene.remarks})
    yield f"  remarks about: {', '.join(about) or 'nothing'}"
    poses = first.shape.poses
    if poses is not None:
        yield f"  poses: {poses.form}, {poses.axes} axes, {poses.unit}"
    yield f"  evidence: {'; '.join(first.notes.get('poses', [])[:2]) if poses else 'no poses'}"
    yield f"  depth unit: {scene.depth_unit_m[0]:g} m ({scene.depth_unit_source[0]})"


def _document_lines(folder: SceneFolder, name: str, secrets: frozenset[str]) -> Iterator[str]:
    """Yield the keys of a JSON file, with how often values of a kind stand there."""
    try:
        document = parse_object(folder.read(name), where=name)
    except StereoGenBenchError as error:
        yield f"    {type(error).__name__}"
        return
    kinds: dict[str, Counter[str]] = {}
    _structure(document, "", kinds, secrets)
    for place, counts in list(kinds.items())[:_MOST_KEYS]:
        yield f"    {place}: {', '.join(f'{kind} x {n}' for kind, n in counts.items())}"
    if len(kinds) > _MOST_KEYS:
        yield f"    and {len(kinds) - _MOST_KEYS} keys more"


def _names(each: Examined) -> list[str]:
    """Return the names of a scene's map, label, character and animation."""
    names: list[str | None] = [parse_scene_key(each.key).map_name]
    if each.scene is not None:
        labels = each.scene.labels
        names += [labels.map_path, labels.scene_label, labels.map_name, labels.character,
                  labels.animation]  # fmt: skip
    return [name for name in names if name and len(name) > 2]


def _secrets(group: Sequence[Examined]) -> frozenset[str]:
    """Return words of names that keys may hold."""
    names = {words(name) for each in group for name in _names(each)}
    return frozenset(re.sub(r"[0-9]+", "#", name) for name in names if len(name) > 2)


def _structure(
    node: Any, place: str, kinds: dict[str, Counter[str]], secrets: frozenset[str]
) -> None:
    if isinstance(node, dict):
        for key, value in node.items():
            shown = _HIDDEN if len(node) > _MOST_OF_OBJECT else _public_key(key, secrets)
            _structure(value, f"{place}.{shown}".lstrip("."), kinds, secrets)
        return
    if isinstance(node, list):
        kinds.setdefault(f"{place}[]", Counter())[f"list of {len(node)}"] += 1
        for each in node:
            _structure(each, f"{place}[]", kinds, secrets)
        return
    kinds.setdefault(place, Counter())[_kind(node)] += 1


def _public_key(key: str, secrets: frozenset[str]) -> str:
    """Return a key in words without numbers; one that may be a name is not shown."""
    plain = re.sub(r"[0-9]+", "#", words(key))
    for name in secrets:
        plain = plain.replace(name, _HIDDEN)
    is_plain = _KEY.fullmatch(plain.replace(_HIDDEN, "")) or plain == _HIDDEN
    return plain if is_plain and "/" not in key and "\\" not in key else _HIDDEN


def _kind(value: object) -> str:
    """Return what kind of value it is; a text only where it says how files are read."""
    if isinstance(value, str):
        parts = words(value).split("_")
        is_shown = len(value) <= 40 and all(part in _FORM_WORDS for part in parts)
        return f'"{"_".join(parts)}"' if is_shown else "text"
    if value is None or isinstance(value, bool):
        return "null" if value is None else "boolean"
    return "whole number" if isinstance(value, int) else "number"


def _stream(facts: StreamFacts, secrets: frozenset[str]) -> str:
    return (
        f"{facts.codec} {facts.pixel_format}, {facts.width_px}x{facts.height_px}, {facts.frames} "
        f"frames at {facts.frame_rate_hz:g} Hz, container {facts.container}; tags: "
        f"{_tags(facts.tags, secrets)}"
    )


def _tags(tags: Mapping[str, str], secrets: frozenset[str]) -> str:
    shown = []
    for key, value in sorted(tags.items()):
        is_scale = _SCALE.fullmatch(value) and len(value) < 30
        is_known = is_scale or _LIBRARY.fullmatch(value)
        shown.append(f"{_public_key(key, secrets)}={value.strip() if is_known else _kind(value)}")
    return ", ".join(shown) or "none"


def _public(text: str, survey: Survey) -> str:
    """Return a message without the root, keys of scenes and quoted texts."""
    text = text.replace(str(survey.root), "ROOT")
    for each in sorted(survey.examined, key=lambda each: -len(each.key)):
        text = text.replace(each.key, "SCENE")
        for name in _names(each):
            text = text.replace(name, _HIDDEN)
    text = re.sub(r"'[^']*'|\"[^\"]*\"", "TEXT", text)
    text = re.sub(r"(?<![\w.])(?:[A-Za-z]:)?[/\\][^\s:,;]+|\w+://\S+", "PATH", text)
    return " ".join(text.split())[:1000]
