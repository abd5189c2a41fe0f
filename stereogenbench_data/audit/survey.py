"""Conventions of a tree, with what its pictures say of depth: the doctor measures, nobody else.

`index.learning` finds where quantities stand; here the depth encoding of each shape of files is
tested on some scenes, changed where nothing states it and the pictures of all of them are sure, and
tested again. Where several readings of the poses fit the rigs, depth decides between them.
"""

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.audit.contract import limits
from stereogenbench_data.audit.contract.doctor import DiagnosisTask, DoctorReport, diagnose
from stereogenbench_data.audit.contract.verdict import (
    QUOTIENT,
    STRETCH,
    TOPICS,
    Unit,
    encoding_line,
)
from stereogenbench_data.audit.contract.worlds import LEAST_SHARE, explained_shares, judge_worlds
from stereogenbench_data.audit.proposals import MOST, Candidate, proposed
from stereogenbench_data.audit.scene_access import source_of, spread
from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress
from stereogenbench_data.errors import StereoGenBenchError, StorageError
from stereogenbench_data.index.learning import (
    SCENE_FILES,
    Examined,
    Learned,
    Problem,
    chosen_scenes,
    examine,
    learn,
    problem_of_scene,
    tables_of_notes,
)
from stereogenbench_data.index.scene_folder import IncompleteScene
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.index.tree import folder_of
from stereogenbench_data.samples.fields import PAIR_FIELDS, VIEW_FIELDS
from stereogenbench_data.schema.conventions import Conventions, depth_of, write_toml
from stereogenbench_data.schema.declaration import Declaration, DepthAs, PosesAt
from stereogenbench_data.schema.depth_contract import MAY_BE_RANGE, NO_LENGTH
from stereogenbench_data.schema.records import DepthEncoding, Scene, SceneId
from stereogenbench_data.schema.release import BASELINE_JSON, CAMERA_COUNT, TRAJECTORY_JSON
from stereogenbench_data.schema.text import counted
from stereogenbench_data.sources.location import is_remote, shown

SCENES: Final = 20
FRAMES: Final = 3
"""Of how many frames of a scene the pictures are compared."""
PICTURED: Final = 6
"""How many scenes of a shape are compared with their pictures."""
_TOPICS: Final = {
    "unit_m": QUOTIENT, "kind": TOPICS["kind"], "form": TOPICS["form"],
    "frame_lag": TOPICS["frame_lag"],
}  # fmt: skip
"""The questions that pictures answer about what [depth] states."""


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What a look at some scenes of a tree found.

    Attributes:
        root: The tree.
        examined: The scenes, in the order in which they were chosen.
        learned: The conventions; None where those of the user were tested instead.
        problems: What is not understood, contradicts the conventions, or contradicts the pictures.
        verdicts: What the pictures say of each shape's depth, in a line each.
        poses: What depth says of readings of the poses, where several fit.
        notes: The comments of the file, as `write_toml` takes them.
        untested: What the user's conventions state of depth and no picture could test.
        candidates: The best of each table that might be stated.
    """

    root: str
    examined: tuple[Examined, ...]
    learned: Learned | None
    problems: list[Problem] = field(default_factory=list)
    verdicts: list[str] = field(default_factory=list)
    poses: list[str] = field(default_factory=list)
    notes: dict[tuple[int, str], list[str]] = field(default_factory=dict)
    untested: tuple[str, ...] = ()
    candidates: list[Candidate] = field(default_factory=list)

    @property
    def settled(self) -> dict[str, bool]:
        """For each part of a scene's files whether it is settled."""
        scenes = [each.scene for each in self.examined]
        known = [scene for scene in scenes if scene is not None]
        is_read = len(known) == len(scenes)
        shapes = () if self.learned is None else self.learned.conventions.shapes
        stated = all(shape.depth and shape.depth.encoding.unit_m for shape in shapes) and shapes
        is_odd = any(problem.about == "depth" for problem in self.problems)
        has_unit = not any("unreadable" in scene.depth_unit_source for scene in known)
        return {
            BASELINE_JSON: is_read and not any(s.remark("principal point") for s in known),
            "poses": is_read and not any(s.remark("poses", "world", "left") for s in known),
            "depth": is_read and not is_odd and bool(has_unit or stated),
        }

    @property
    def unsettled(self) -> list[str]:
        """The problems, one of those about the same file, with how many more there are."""
        alike: dict[str, list[str]] = {}
        for problem in self.problems:
            kind = problem.about if problem.about in SCENE_FILES else problem.text
            alike.setdefault(kind, []).append(" ".join(problem.text.split()))
        return [
            f"{first} ({len(others)} more of {kind})" if others and kind in SCENE_FILES else first
            for kind, (first, *others) in alike.items()
        ]

    @property
    def toml(self) -> str:
        """The conventions as a file."""
        if self.learned is None or not self.learned.conventions.shapes:
            return ""
        return write_toml(self.learned.conventions, self.notes)


def survey(  # noqa: PLR0913 - each names one thing that a user chooses
    root: str | Path,
    *,
    scenes: int = SCENES,
    pictured: int = PICTURED,
    conventions: Conventions | None = None,
    wanted: Callable[[SceneId], bool] | None = None,
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> Survey:
    """Look at some scenes of a tree in the released layout: learn its conventions, or test some.

    Args:
        root: The folder that holds ``train`` and ``eval``, or its URL.
        scenes: How many scenes, at least 1, are read, spread over families, maps and keys of files.
        pictured: How many scenes of each shape are compared with their pictures; 0 for none.
        conventions: What is tested; None to learn.
        wanted: Which scenes, by their paths.
        workers: Number of processes, None for one a core.
        engine: Where they run.
        progress: Called with the number of scenes read and of all.

    Raises:
        StorageError: If the tree holds no scenes, none is wanted, or none of those looked at is
            finished.
    """
    keys = chosen_scenes(root, count=scenes, wanted=wanted)
    found = list[Examined]()
    # Reading takes less time than starting processes, unless each file is fetched.
    readers = workers if is_remote(root) or engine is not LOCAL else 1
    task = functools.partial(_examined, str(root), conventions)
    with closing(engine.map(task, keys, name=str, workers=readers)) as results:
        for each in results:
            found += [] if each is None else [each]
            if progress is not None:
                progress(len(found), len(keys))
    if any(not each.lacks_mark for each in found):
        found = [each for each in found if not each.lacks_mark]
    if not found:
        raise StorageError(
            f"{shown(root)}: none of the {counted(len(keys), 'scene')} that were looked at is "
            f"finished, with videos. Download some whole."
        )
    found.sort(key=lambda each: keys.index(each.key))
    how: dict[str, Any] = {"workers": workers, "engine": engine}
    if conventions is None:
        return _learning(root, found, pictured, how)
    tested = Survey(str(root), tuple(found), None)
    tested.problems.extend(problem_of_scene(each.problem) for each in found if each.problem)
    usable = [each.scene for each in found if each.scene is not None]
    tested.problems.extend(
        Problem(scene.remark("left"), BASELINE_JSON) for scene in usable if scene.remark("left")
    )
    some = _some(usable, pictured) if pictured else []
    report = _diagnosed(tested, some, None, how) if some else None
    if report is not None:
        _note(tested, report, cures=_changed(_measured(report, DepthEncoding(), some)))
        for verdict in report.worlds:
            told = f"poses: {_SHARES}: {'; '.join(verdict.lines)}"
            if verdict.is_wrong:
                tested.problems.append(Problem(told, "poses"))
            else:
                tested.poses.append(told)
        tested = replace(tested, untested=tuple(dict.fromkeys(_untested(report))))
    return tested


def _untested(report: DoctorReport) -> Iterator[str]:
    """Yield what conventions state of depth and no picture could test, as they state it."""
    for verdict in report.verdicts:
        status = {answer.topic: answer.status for answer in verdict.answers}
        for name, value in _changed(verdict.declared).items():
            if status[_TOPICS[name]] == "cannot tell":
                yield f"{name} = {value}"
        if status[STRETCH] == "cannot tell":
            yield STRETCH


def _changed(encoding: DepthEncoding) -> dict[str, str]:
    """Return what pictures may test of a contract and is not usual, as a file states it."""
    return {
        name: json.dumps(getattr(encoding, name))
        for name in _TOPICS
        if getattr(encoding, name) != getattr(DepthEncoding(), name)
    }


def _learning(
    root: str | Path, found: Sequence[Examined], pictured: int, how: dict[str, Any]
) -> Survey:
    """Return the conventions of some scenes, tested by the pictures of some of them."""
    learned = learn(root, found)
    surveyed = Survey(str(root), tuple(found), learned, problems=learned.problems)
    surveyed.notes.update(tables_of_notes(learned))
    scenes = (each.scene for each in found if each.scene is not None)
    points = (scene.remark("principal point") for scene in scenes)
    surveyed.problems.extend(Problem(told, BASELINE_JSON) for told in points if told)
    shapes = []
    for number, (shape, group) in enumerate(
        zip(learned.conventions.shapes, learned.taught_by, strict=True)
    ):
        alike = [each.scene for each in group if each.scene]
        if not alike or alike[0].remark("poses", "left"):
            scene = alike[0] if alike and pictured else None
            _note_candidates(surveyed, number, group[0].key, scene)
        lines, before = surveyed.notes.setdefault((number, "depth"), []), len(surveyed.verdicts)
        report = None
        if pictured and alike:
            shape, report = _with_measured_depth(surveyed, shape, _some(alike, pictured), how)
        if shape.poses is None and alike and alike[0].remark("world"):
            notes = surveyed.notes.setdefault((number, "poses"), [])
            shape = _with_decided_poses(surveyed, shape, alike[0], report, notes)
        lines += surveyed.verdicts[before:] or ["not compared with pictures"]
        shapes.append(shape)
    learned = replace(learned, conventions=Conventions(tuple(shapes), "the conventions learned"))
    surveyed = replace(surveyed, learned=learned)
    surveyed.notes[-1, ""] = _head(surveyed)
    return surveyed


def _note_candidates(surveyed: Survey, number: int, key: str, scene: Scene | None) -> None:
    """Add what might be stated about a scene's files to the notes, as tables to uncomment.

    Forms of poses are ranked by depth from frame to frame, if there is a scene to read it from.
    """
    folder = folder_of(surveyed.root, key)
    with suppress(StereoGenBenchError, KeyError):
        moves = folder.read(TRAJECTORY_JSON) if TRAJECTORY_JSON in folder.stamps() else b""
        for group in filter(None, proposed(folder.read(BASELINE_JSON), moves, where=key)):
            if group[0].table == "poses" and scene is not None:
                group = _by_depth(surveyed.root, scene, moves, group)
                if not group:
                    continue
            notes = surveyed.notes.setdefault((number, group[0].table), [])
            for at, each in enumerate(group[:MOST]):
                notes += ["", f"candidate {at + 1} of {len(group)}, without '# ' in front:"]
                notes += each.lines
            surveyed.candidates.append(group[0])


def _by_depth(root: str, scene: Scene, text: bytes, group: Sequence[Candidate]) -> list[Candidate]:
    """Return the forms of poses that depth does not contradict, the best first."""
    index = SceneIndex.from_scenes([scene], root)
    task = DiagnosisTask(scene, source_of(index, scene), 1, depth_of(scene))
    with task.scene_frames() as views:
        shares = explained_shares(views, text, [each.why for each in group])
    verdict = judge_worlds([shares])
    mean = {each.why: sum(shares[each.why]) / 2 for each in group}
    told = "right by depth" if verdict.chosen else f"depth cannot tell: {verdict.reason}"
    return [
        replace(each, why=f"{mean[each.why]:.0%} of depth is found in other frames by it ({told}): "
                          f"{each.why}")
        for each in sorted(group, key=lambda each: mean[each.why], reverse=True)
        if mean[each.why] >= LEAST_SHARE
    ]  # fmt: skip


def _examined(
    root: str, conventions: Conventions | None, key: str, advance: Advance
) -> Examined | None:
    """Return what a scene's files say, None if it is not whole."""
    advance(0)
    try:
        return examine(root, key, conventions=conventions)
    except IncompleteScene:
        return None


def _some(scenes: Sequence[Scene], count: int) -> list[Scene]:
    """Return at most this number of scenes, evenly spread."""
    return [scenes[place] for place in spread(len(scenes), count)]


def _diagnosed(
    surveyed: Survey, scenes: Sequence[Scene], depth: DepthEncoding | None, how: dict[str, Any]
) -> DoctorReport | None:
    """Return what pictures say of a contract; None, and why, where they cannot be compared."""
    scenes = [scene for scene in scenes if len(scene.held_videos) == 2 * CAMERA_COUNT]
    if not scenes:
        surveyed.verdicts.append("not compared with pictures: no scene has all six cameras' videos")
        return None
    index = SceneIndex.from_scenes(scenes, surveyed.root)
    try:
        return diagnose(index, scenes=len(scenes), frames=FRAMES, depth=depth, **how)
    except StereoGenBenchError as error:
        surveyed.problems.append(Problem(str(error)))
        surveyed.verdicts.append(f"the pictures tell nothing: {error}")
        return None


def _with_measured_depth(
    surveyed: Survey, shape: Declaration, scenes: Sequence[Scene], how: dict[str, Any]
) -> tuple[Declaration, DoctorReport | None]:
    """Return a shape with the depth encoding that pictures confirm, as far as they do.

    The doctor's report by that contract comes with it.

    Args:
        surveyed: Takes what pictures say, and what is wrong.
        shape: What files state.
        scenes: Scenes of it, which must all have the contract that is measured.
        how: Where processes run.
    """
    stated = DepthEncoding(source="conventions") if shape.depth is None else shape.depth.encoding
    report = _diagnosed(surveyed, scenes, stated, how)
    if report is None:
        return shape, None
    measured = _measured(report, stated, scenes)
    again = None if measured == stated else _diagnosed(surveyed, scenes, measured, how)
    found = encoding_line(measured)
    if again is not None and not again.is_wrong:
        count = counted(len(scenes), "scene")
        what = f"measured in {count}: {found}, where the files say {encoding_line(stated)}"
        if measured.unit_m != stated.unit_m:
            what += (
                "; the unit, if focal length and baselines are right: pictures show the quotient"
            )
        surveyed.verdicts.append(what)
        _note(surveyed, again)
        return replace(shape, depth=DepthAs(encoding=measured)), again
    if again is not None:
        told = (
            f"depth: {found} was measured, and by it the pictures of {scenes[0].id.key} or others"
        )
        told += " do not fit. `stereogenbench doctor` says more."
        surveyed.problems.append(Problem(told, "depth"))
    _note(surveyed, report)
    return shape, report


_SHARES: Final = "share of pixels whose depth is found in another frame"


def _with_decided_poses(
    surveyed: Survey,
    shape: Declaration,
    scene: Scene,
    report: DoctorReport | None,
    notes: list[str],
) -> Declaration:
    """Return a shape with the reading of poses that depth confirms, or as it is.

    Args:
        surveyed: Takes what depth says, and what stays undecided.
        shape: Of files of which several readings of the poses fit the rigs.
        scene: One of its scenes.
        report: The doctor's, None where no pictures were compared.
        notes: Of the table of poses.
    """
    worlds = () if report is None else report.worlds
    figures = [f"{_SHARES}: {'; '.join(each.lines)}" for each in worlds]
    surveyed.poses.extend(f"poses: {each}" for each in figures)
    chosen = worlds[0].chosen if len(worlds) == 1 else ""
    if chosen:
        notes += figures
        form = PosesAt.of_reading(chosen)
        return replace(shape, poses=replace(form, location=None, rotation=None))
    fields = (PAIR_FIELDS | VIEW_FIELDS).items()
    refused = ", ".join(name for name, each in fields if "world" in each.held_up_by)
    why = "" if figures else "no pictures were compared, and "
    listed = "; ".join(each.partition(" @ ")[0] for each in str(scene.pose_form).split("|"))
    notes += [
        *figures,
        f"NOT DECIDED: {why}these readings fit the rigs alike: {listed}",
        f"refused until [poses] names one of them: {refused}",
    ]
    told = "; ".join(figures) or why.removesuffix(", and ")
    told = f"{scene.id.key}: poses are not decided: {told}. Fields that are refused: {refused}."
    surveyed.problems.append(Problem(told, "poses"))
    return shape


def _measured(
    report: DoctorReport, stated: DepthEncoding, scenes: Sequence[Scene]
) -> DepthEncoding:
    """Return a contract with what the pictures of some scenes are sure of and nothing states."""
    if len(report.verdicts) != 1 or report.verdicts[0].problems:
        return stated
    verdict = report.verdicts[0]
    by_topic = {answer.topic: answer for answer in verdict.answers}
    best = next(each.best for each in report.scenes if each.key in verdict.scenes)
    found = {
        question: getattr(best, question)
        for question in ("kind", "frame_lag", *(() if stated.offset_m else ("form",)))
        if by_topic[TOPICS[question]].status == "wrong" and by_topic[TOPICS[question]].is_sure
    }
    sources = {source for scene in scenes for source in scene.depth_unit_source}
    told = " ".join(scene.remark("depth") for scene in scenes)
    # Of numbers that are no plain lengths pictures would show a unit, too, and a wrong one.
    is_plain = not any(why in told for why in (MAY_BE_RANGE, NO_LENGTH))
    is_known = is_plain and verdict.quotient_error <= limits.MARGIN
    if sources <= {"default", "unreadable"} and stated.unit_m is None and is_known:
        unit = Unit(verdict.quotient * report.scenes[0].unit_m, verdict.quotient_error)
        found["unit_m"] = unit.rounded_m
    return replace(stated, **found)


def _note(
    surveyed: Survey, report: DoctorReport, *, cures: Mapping[str, str] | None = None
) -> None:
    """Note what pictures say of a contract; ``cures`` is what may be written below ``[depth]``."""
    for verdict in report.verdicts:
        line = f"pictures of {counted(len(verdict.scenes), 'scene')}: {verdict.in_a_line}"
        surveyed.verdicts.append(line)
        if verdict.is_wrong and cures and "unit_m" in cures:
            cure = ", ".join(f"{name} = {value}" for name, value in cures.items())
            line = f"no unit that is understood is stated; by pictures, write {cure} below [depth]"
        if verdict.is_wrong:
            told = f"depth, {', '.join(verdict.scenes[:3])}: {line}"
            surveyed.problems.append(Problem(told, "depth"))
    if report.left_out:
        key, reason = next(iter(report.left_out.items()))
        count = counted(len(report.left_out), "scene")
        surveyed.verdicts.append(f"{count} not compared with pictures, such as {key}: {reason}")


def _head(surveyed: Survey) -> list[str]:
    return [
        "Conventions: where quantities stand in the files of this dataset and how they are read.",
        f"Learned from {counted(len(surveyed.examined), 'scene')}.",
        "Use it: StereoPairs(..., conventions='conventions.toml'), or --conventions of a command.",
        "Edit it: what the data contradict is refused with the figures. Tables that it leaves out "
        "are the release's. Test it: `stereogenbench conventions ROOT --check FILE`.",
        *(f"NOT SETTLED: {problem}" for problem in surveyed.unsettled),
    ]
