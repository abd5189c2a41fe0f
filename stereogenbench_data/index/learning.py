"""Learning conventions from some scenes: how poses and depth are read, by files and numbers alone.

Scenes with the same keys have one decision, made by the first of them; decisions that are equal are
one shape. Described by the conventions as they are written, all must be what they are without. What
pictures say of depth is added by `audit.survey`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.geometry.pose_evidence import MatchedPoses
from stereogenbench_data.index.build import find_tree
from stereogenbench_data.index.scene_folder import (
    Description,
    IncompleteScene,
    describe_scene,
    keys_in,
)
from stereogenbench_data.index.tree import folder_of
from stereogenbench_data.schema.conventions import Conventions, parse_conventions, write_toml
from stereogenbench_data.schema.declaration import (
    UNKNOWN,
    Declaration,
    DepthAs,
    PosesAt,
)
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import (
    DepthEncoding,
    DepthUnitSource,
    Scene,
    SceneId,
)
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.schema.text import counted
from stereogenbench_data.sources.location import is_remote

_KEYS_READ: Final = 500
"""Of how many scenes the keys are read, for shapes that the chosen scenes do not have."""
_MORE_SHAPES: Final = 5
SCENE_FILES: Final = (BASELINE_JSON, TRAJECTORY_JSON, *VIDEO_FILES)
_LEFT, _RIGHT = (list(cameras) for cameras in zip(*CAMERA_PAIRS, strict=True))

Notes = dict[str, list[str]]


class Problem(NamedTuple):
    """What is not understood of a dataset, or contradicts itself.

    Attributes:
        text: Where, and what.
        about: The file of a scene, "poses" or "depth"; "" for anything else.
    """

    text: str
    about: str = ""


def problem_of_scene(text: str) -> Problem:
    """Return what is wrong with a scene, about the first of its files that the text names."""
    return Problem(text, next((name for name in SCENE_FILES if name in text), ""))


@dataclass(frozen=True, slots=True, eq=False)
class Examined:
    """What one scene's files say.

    Attributes:
        key: The scene.
        keys: The keys of its files, as `Declaration.has` names them.
        shape: What conventions would state about it.
        notes: For each table of the conventions, what was found and how it is known.
        scene: Its row; None where it cannot be used.
        problem: Why not; "" where it can.
        lacks_mark: Whether it has no completion mark.
    """

    key: str
    keys: frozenset[str]
    shape: Declaration
    notes: Notes
    scene: Scene | None
    problem: str = ""
    lacks_mark: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """Conventions that some scenes taught.

    Attributes:
        conventions: What is stated; shapes are in the order of `taught_by`.
        taught_by: For each shape, the scenes that were looked at for it, the deciding one first.
        problems: What is not understood or contradicts itself.
    """

    conventions: Conventions
    taught_by: list[list[Examined]]
    problems: list[Problem] = field(default_factory=list)


def chosen_scenes(
    root: str | Path, *, count: int, wanted: Callable[[SceneId], bool] | None
) -> list[str]:
    """Return the keys of some scenes of a tree, spread over families, maps and keys of files.

    Raises:
        StorageError: If there are no scenes.
    """
    by_map: dict[str, list[str]] = {}
    for key in find_tree(root, wanted=wanted).keys:
        by_map.setdefault(key.rpartition("/")[0], []).append(key)
    rounds = zip_longest(*by_map.values())
    spread = [key for each in rounds for key in each if key is not None]
    chosen, others = spread[:count], spread[count:]
    if not is_remote(root) and others:
        known = {keys_in(folder_of(root, key), (BASELINE_JSON,)) for key in chosen}
        step = max(1, len(others) // _KEYS_READ)
        for key in others[::step][:_KEYS_READ]:
            keys_there = keys_in(folder_of(root, key), (BASELINE_JSON,))
            if keys_there not in known and len(chosen) < count + _MORE_SHAPES:
                known.add(keys_there)
                chosen.append(key)
    return chosen


def examine(root: str | Path, key: str, *, conventions: Conventions | None = None) -> Examined:
    """Return what a scene's files say, also where it cannot be used.

    Raises:
        IncompleteScene: If it has no videos.
        StorageError: If its folder cannot be read.
    """
    folder = folder_of(root, key)
    files = folder.stamps()
    described, scene, problem = None, None, ""
    try:
        described = Description(folder, key)
        scene = described.scene(conventions)
    except IncompleteScene:
        raise
    except StereoGenBenchError as error:
        problem = str(error)
    shape, notes = Declaration(), Notes()
    if scene is not None and described is not None:
        named, notes["poses"] = _learned_poses(scene, described.understood)
        shape = replace(shape, poses=named)
        notes["depth"] = _depth_notes(scene, described)
    names = [name for name in (BASELINE_JSON, TRAJECTORY_JSON) if name in files]
    return Examined(
        key, keys_in(folder, names), shape, notes, scene, problem,
        lacks_mark=COMPLETE_JSON not in files,
    )  # fmt: skip


def _learned_poses(scene: Scene, found: MatchedPoses | None) -> tuple[PosesAt | None, list[str]]:
    """Return how poses are read, and the evidence; None where it is not decided."""
    if found is None:
        reason = scene.remark("poses").replace(f"{scene.id.key}/", "")
        unread = f'to train without poses and say so, write [poses] with form = "{UNKNOWN}"'
        return None, [unread, f"not understood: {reason}"]
    poses = found.poses
    steps = poses.centres[:, _RIGHT] - poses.centres[:, _LEFT]
    lengths_cm = np.linalg.norm(steps, axis=-1) * poses.unit_m * 100
    off_cm = np.abs(lengths_cm - np.array(scene.rig.baselines_cm)).max()
    lateral_m = np.array([poses.cam_from_cam(0, target=0, source=camera)[:3, 3]
                          for camera in range(1, CAMERA_COUNT)])  # fmt: skip
    across_cm = np.abs(lateral_m[:, 1:]).max() * 100
    notes = [
        f"distances of the cameras are the baselines to {off_cm:.2g} cm in {len(steps)} frames",
        f"the cameras stand along the x axis of camera 0 to {across_cm:.2g} cm in frame 0",
    ]
    return None if scene.remark("world") else found.at, notes


def _depth_notes(scene: Scene, described: Description) -> list[str]:
    depths = (facts for name, facts in described.facts.items() if name.endswith("_depth.mkv"))
    notes = [
        f"stored by codec {facts.codec} as {facts.pixel_format}, {facts.frames} frames; tags: "
        f"{', '.join(sorted(facts.tags)) or 'none'}"
        for facts in islice(depths, 1)
    ]
    if scene.depth_unit_source[0] == "unreadable":
        return [*notes, f"the unit is not understood: {scene.remark('depth')}"]
    where = _UNIT_SOURCES[scene.depth_unit_source[0]]
    return [*notes, f"{scene.depth_unit_m[0]:g} m in a stored unit: {where}"]


_UNIT_SOURCES: Final = {
    "tag": "a tag states it",
    "metadata": "the scene's files state it",
    "conventions": "the conventions state it",
    "default": "nothing states it, so this is the release's default",
}


def learn(root: str | Path, examined: Sequence[Examined]) -> Learned:
    """Return the conventions that scenes teach, and what is wrong with them.

    Args:
        root: The folder that holds ``train`` and ``eval``, or its URL.
        examined: The scenes.
    """
    usable = [each for each in examined if each.scene is not None]
    problems = [problem_of_scene(each.problem) for each in examined if each.scene is None]
    decided_by: dict[frozenset[str], Examined] = {}
    groups: dict[str, list[Examined]] = {}
    for each in usable or examined:
        deciding = decided_by.setdefault(each.keys, each)
        groups.setdefault(deciding.shape.text(), []).append(each)
    by_size = sorted(groups.values(), key=len, reverse=True)
    shapes: list[tuple[Declaration, list[Examined]]] = []
    for group in by_size:
        elsewhere = {key for other in by_size if other is not group for each in other
                     for key in each.keys}  # fmt: skip
        own = frozenset.intersection(*(each.keys for each in group)) - elsewhere
        has = tuple(sorted(own, key=len)[:1]) if len(by_size) > 1 else ()
        if len(by_size) > 1 and not has and any(not shape.has for shape, _ in shapes):
            told = "has the keys of other scenes and is read otherwise"
            problems.append(Problem(f"{group[0].key} {told}: the conventions do not state it."))
            continue
        depth = _stated_depth(group)
        stated = {"format": 2}
        shapes.append((replace(group[0].shape, has=has, depth=depth, stated=stated), group))
    shapes.sort(key=lambda pair: not pair[0].has)
    problems += [
        Problem(f"{group[0].key}: poses: {group[0].notes['poses'][-1]}", "poses")
        for shape, group in shapes
        if group[0].scene is not None and shape.poses is None and not group[0].scene.remark("world")
    ]
    conventions = Conventions(tuple(shape for shape, _ in shapes), "the conventions learned")
    learned = Learned(conventions, [group for _, group in shapes], problems=problems)
    verify(root, learned)
    return learned


def _stated_depth(group: Sequence[Examined]) -> DepthAs | None:
    """Return unit and offset that all files of some scenes state; None where they state several."""
    stated = {
        lengths
        for each in group if each.scene is not None
        for lengths in zip(
            each.scene.depth_unit_m, each.scene.depth_offset_m, each.scene.depth_unit_source,
            strict=True,
        )
    }  # fmt: skip
    unit_m, offset_m, source = stated.pop() if len(stated) == 1 else (1.0, 0.0, "default")
    if source in ("default", "unreadable"):
        return None
    encoding = DepthEncoding(unit_m=unit_m, offset_m=offset_m, source="conventions")
    return DepthAs(encoding=encoding)


def verify(root: str | Path, learned: Learned) -> None:
    """Describe scenes by the conventions as they are written, and note those that then differ."""
    written = write_toml(learned.conventions, {}).encode()
    read_back = parse_conventions(written, where=learned.conventions.where)
    for each in chain.from_iterable(learned.taught_by):
        if each.scene is None:
            continue
        try:
            again = describe_scene(root, each.key, conventions=read_back)
        except StereoGenBenchError as error:
            learned.problems.append(problem_of_scene(str(error)))
            continue
        if _essence(again) != _essence(each.scene):
            told = f"{each.key}: is read otherwise by the conventions learned."
            learned.problems.append(Problem(told))


def _essence(scene: Scene) -> Scene:
    """Return a scene without what conventions may add to its row."""
    sources: tuple[DepthUnitSource, ...] = ("conventions",) * CAMERA_COUNT
    return replace(scene, conventions=None, pose_form=None, remarks=(), depth_unit_source=sources)


def tables_of_notes(learned: Learned) -> Iterator[tuple[tuple[int, str], list[str]]]:
    """Yield the notes of each table of each shape, by the scene that decided it."""
    for number, group in enumerate(learned.taught_by):
        maps = sorted({parse_scene_key(each.key).map_name for each in group})
        scenes = f"{counted(len(group), 'scene')} of {counted(len(maps), 'map')}"
        head = f"{scenes}, decided by {group[0].key}"
        yield (number, ""), [head]
        for table, notes in group[0].notes.items():
            yield (number, table), notes
