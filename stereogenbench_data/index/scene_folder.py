"""One scene's folder: whether it is finished, whole and consistent, and its row of the index.

Everything that an index says of a scene comes from its JSON files and the heads of its videos. No
picture is decoded unless the share of measured depth is asked for. `row_check` compares files with
an existing row.
"""

import functools
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from stereogenbench_data.errors import (
    MediaError,
    SchemaError,
    StereoGenBenchError,
    StorageError,
    text_without_secrets,
)
from stereogenbench_data.geometry.camera import recorded_intrinsics
from stereogenbench_data.geometry.pose_evidence import (
    MatchedPoses,
    SidesError,
    declared_poses,
    settled_poses,
)
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px
from stereogenbench_data.index.clocks import require_one_clock
from stereogenbench_data.index.tree import FILES, Files, SceneFolder, folder_of
from stereogenbench_data.media.container import (
    StreamFacts,
    VideoFile,
    depth_coding,
)
from stereogenbench_data.media.decoder import MOST_EXTRA_FRAMES
from stereogenbench_data.media.depth import (
    ANY_DEPTH,
    DEPTH_CURES,
    grey_format,
    measured,
    open_video,
    read_depth_units,
    require_depth_stream,
    stated_unit,
)
from stereogenbench_data.media.depth_frames import CODEC_NAME
from stereogenbench_data.media.heads import heads_of
from stereogenbench_data.media.seek_table import SeekTable, packed_tables, read_seek_table
from stereogenbench_data.media.video import NO_COLOUR, probe, require_pixel_aspect
from stereogenbench_data.schema.conventions import Conventions, keys_of
from stereogenbench_data.schema.declaration import BUILT_IN, UNKNOWN, Declaration
from stereogenbench_data.schema.depth_contract import Statement, stated_in_json
from stereogenbench_data.schema.document import (
    brief,
    parse_object,
)
from stereogenbench_data.schema.parse import (
    is_of_family,
    parse_caption,
    parse_complete,
    parse_rig,
    parse_scene_key,
    require_unit,
)
from stereogenbench_data.schema.records import (
    DepthUnitSource,
    Member,
    Remark,
    Rig,
    Scene,
    SceneLabels,
)
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    DESCRIPTION_JSON,
    DESCRIPTION_TXT,
    PACKED_DEPTH_NAMES,
    RELEASED_NAMES,
    TRAINING_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
    depth_name,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.schema.training import TrainingDocument, parse_training

ValidDepth = Literal["skip", "sample"]

DESCRIPTIONS: Final = (DESCRIPTION_JSON, DESCRIPTION_TXT)
_DEPTHS: Final = frozenset(name for name in VIDEO_FILES if name.endswith("_depth.mkv"))
_LONGEST_REMARK: Final = 2000
_NO_DEPTH: Final = StreamFacts(CODEC_NAME, "gray16le", 0, 0, 0, 0.0, {})
"""What the index says of depth of a scene of training shards that has none."""
_DEVIATION_CM: Final = 0.1
_DEVIATION_SHARE: Final = 0.001
_UNREADABLE: Final[tuple[float, DepthUnitSource]] = (math.nan, "unreadable")
"""The unit of depth of a camera whose files do not tell it."""
_SAME_UNIT: Final = 1.005
"""Units of depth of one rig that differ by a larger factor are several, and not rounded."""
_SQUARE: Final = 0.01
"""How far the sides of a pixel may differ, as a share: lengths of a sensor are rounded."""


class IncompleteScene(StorageError):
    """A scene that is not finished, or of which only metadata were fetched."""


def describe_scene(
    root: str | Path,
    key: str,
    *,
    conventions: Conventions | None = None,
    folder: SceneFolder | None = None,
    videos: Collection[str] | None = None,
) -> Scene:
    """Return the index row of a finished scene.

    What no sample needs, or only some fields, becomes a remark of the row: poses that are not
    understood (the rig is then assumed rectified), videos that cannot be opened, odd texts.

    Args:
        root: The folder that holds ``train`` and ``eval``, or its URL.
        key: The scene's path below it.
        conventions: Where quantities stand and how they are read, in place of the release's.
        folder: Its folder, where that is listed already.
        videos: Names of the videos to open; None is all. The row then holds for these alone.

    Raises:
        IncompleteScene: If the scene has no video at all.
        StorageError: If files that every sample needs are missing, unreadable or contradict each
            other or the conventions, or `SchemaError` or `MediaError` if one of them is not
            understood. All problems of all files are in one message.
    """
    described = Description(folder or folder_of(root, key), key)
    return described.scene(conventions, videos=videos)


class Description:
    """What is read of a scene's files, and what is odd about them.

    Attributes:
        remarks: What is odd.
        facts: What the videos that can be used are, by their names.
        understood: The poses; None where there are none.
    """

    def __init__(self, folder: SceneFolder, key: str, settled: MatchedPoses | None = None) -> None:
        """List the files; a scene of training shards says what it was derived from."""
        self.folder, self.key, self.files = folder, key, folder.stamps()
        self.settled = settled
        self.remarks: list[Remark] = []
        self.shape: Declaration | None = None
        self.facts: dict[str, StreamFacts] = {}
        self.understood: MatchedPoses | None = None
        self.tables: dict[str, SeekTable] = {}
        self.unread: dict[str, str] = {}
        self.document: TrainingDocument | None = None
        names = VIDEO_FILES
        if TRAINING_JSON in self.files:
            where = self.where(TRAINING_JSON)
            self.document = parse_training(folder.read(TRAINING_JSON), where=where)
            there = self.document.files
            names = tuple(name for name in names if PACKED_DEPTH_NAMES.get(name, name) in there)
        self.names = names
        require_finished(key, self.files, videos=names)
        self.hollow = folder.hollow(self.files)
        if BASELINE_JSON in self.hollow:
            raise StorageError(self.hollow[BASELINE_JSON])

    def where(self, name: str) -> str:
        """Return a file's path, for messages."""
        return f"{self.key}/{name}"

    def remark(self, about: str, text: str) -> None:
        """Note what is odd."""
        self.remarks.append(Remark(about, text))

    def scene(
        self,
        conventions: Conventions | None,
        *,
        videos: Collection[str] | None = None,
        valid_depth: ValidDepth = "skip",
    ) -> Scene:
        """Return the row; `describe_scene` says more."""
        problems: list[StereoGenBenchError] = []
        rig, labels = None, SceneLabels()
        small = BASELINE_JSON, COMPLETE_JSON, TRAJECTORY_JSON, *DESCRIPTIONS
        self.folder.fetch([*small, *(self.names if videos is None else videos)])
        self.probe(videos)
        try:
            rig, labels = self.rig(conventions)
        except StereoGenBenchError as error:
            problems.append(error)
        marked = SceneLabels()
        odd: tuple[Remark, ...] = (Remark("marker", f"{self.key}: has no {COMPLETE_JSON}"),)
        if COMPLETE_JSON in self.files:
            text, where = self.folder.read(COMPLETE_JSON), self.where(COMPLETE_JSON)
            marked, odd = parse_complete(text, where=where)
        self.remarks += odd
        texts: dict[str, bytes] = {
            name: self.folder.read(name) for name in DESCRIPTIONS if name in self.files
        }
        caption, odd = caption_of(texts, key=self.key)
        self.remarks += odd
        try:
            frames = self.common_frames()
            if self.document is None:  # derived frames are numbered anew
                self.remarks += require_one_clock(self.key, self.facts)
            self.require_one_size()
            if rig is not None:
                first = next(iter(self.facts.values()))
                size_px = first.width_px, first.height_px
                recorded_px = size_px if self.document is None else self.document.source_size_px
                rig = sized_as_videos(
                    self.key, rig, recorded_px, remarks=self.remarks, shape=self.shape
                )
                self.require_kinds(rig)
        except StereoGenBenchError as error:
            problems.append(error)
        if len(problems) > 1:
            listed = "\n  ".join(str(problem) for problem in problems)
            told = f"{self.key}: {len(problems)} of its files cannot be used:\n  {listed}"
            raise StorageError(told)
        if rig is None or problems:
            raise problems[0]
        if self.unread:
            self.remark("videos", "; ".join(self.unread.values()))
        found = self.understood = self.poses(rig, frames)
        poses, pose_form = (None, None) if found is None else (found.poses, found.form)
        frames = frames if poses is None else min(frames, poses.frame_count)
        used = ((name, facts) for name, facts in self.facts.items() if name in _DEPTHS)
        some = next(used, (depth_name(0), _NO_DEPTH))
        names = map(depth_name, range(CAMERA_COUNT))
        depths = [(name, self.facts[name]) if name in self.facts else some for name in names]
        units_m, offsets_m, sources = zip(*self.depth_units(depths), strict=True)
        scene = Scene(
            id=parse_scene_key(self.key),
            labels=merged_labels(labels, marked),
            caption=caption,
            rig=rig,
            frames=frames,
            frame_rate_hz=next(iter(self.facts.values())).frame_rate_hz,
            lateral_m=(
                assumed_places_m(rig) if poses is None else tuple(lateral_offsets_m(poses).tolist())
            ),
            rig_residual_px=(
                0.0 if poses is None else rectification_residual_px(poses, recorded_intrinsics(rig))
            ),
            depth_unit_m=units_m,
            depth_offset_m=offsets_m,
            depth_unit_source=sources,
            depth_codec=tuple(depth_coding(facts) for _, facts in depths),
            depth_pixel_format=tuple(facts.pixel_format for _, facts in depths),
            valid_depth_ratio=None if valid_depth == "skip" else self.valid_depth_ratio(frames),
            key_frames=self.common_key_frames(frames),
            remarks=as_kept(self.remarks),
            pose_form=pose_form,
            conventions=None if self.shape is None else self.shape.text(),
            members=members_of(self.key, self.files, without={**self.unread, **self.hollow}),
            seek_tables=packed_tables(self.tables),
        )
        return self.derived(scene)

    def probe(self, opened: Collection[str] | None) -> None:
        """Find what videos are, where their packets lie, and why others cannot be opened.

        A scene without the videos of one camera still has the pairs of the others.
        """
        for name in self.names:
            held = held_name(self.files, name)
            if held not in self.files:
                self.unread[name] = missing_video(self.key, name)
            elif held in self.hollow:
                self.unread[held] = self.hollow[held]
            elif opened is None or name in opened:
                video = self.folder.video(held)
                try:
                    with heads_of(video, name=self.where(held)) as known:
                        self.probe_video(name, held, known)
                except MediaError as error:
                    self.unread[held] = str(error)
                finally:
                    if not isinstance(video, Path):
                        video.close()

    def probe_video(self, name: str, held: str, video: VideoFile) -> None:
        """Find what a video is, and where its packets lie.

        Raises:
            MediaError: If it cannot be used.
        """
        where, is_picture = self.where(held), name.endswith(".mp4")
        facts = probe(video, name=where, pixel_format="later" if is_picture else "needed")
        if is_picture and facts.is_colour is None:
            facts = probe(video, name=where)
        if name in _DEPTHS:  # lossy depth passes: a `DepthEncoding` may accept it
            require_depth_stream(
                codec=depth_coding(facts), pixel_format=facts.pixel_format,
                encoding=ANY_DEPTH, name=where,
            )  # fmt: skip
        self.facts[name] = facts
        if (table := read_seek_table(video, name=where)) is not None:
            self.tables[held] = table

    def rig(self, conventions: Conventions | None) -> tuple[Rig, SceneLabels]:
        """Return what ``baseline.json`` says, by the conventions for its keys."""
        text, where = self.folder.read(BASELINE_JSON), self.where(BASELINE_JSON)

        if conventions is not None:
            parse_object(text, where=where)  # What is not JSON has no keys, and its own error.
            names = BASELINE_JSON, TRAJECTORY_JSON
            keys = functools.partial(keys_in, self.folder, names)
            self.shape = conventions.shape_of(keys, where=self.key)
        size_px = next(((each.width_px, each.height_px) for each in self.facts.values()), None)
        if self.document is not None:
            size_px = self.document.source_size_px
        declared = self.shape or BUILT_IN
        rig, labels, odd = parse_rig(text, where=where, declared=declared, size_px=size_px)
        family = parse_scene_key(self.key).family
        self.remarks += (*odd, *require_unit(rig, family=family, where=where))
        return rig, labels

    def common_frames(self) -> int:
        """Return how many frames all videos have."""
        if not self.facts:
            told = f"{self.key}: none of its videos can be opened. Fetch the scene again."
            raise MediaError(told)
        counts = {name: fact.frames for name, fact in self.facts.items()}
        told, frames = self.odd_ones(counts, "one number of frames"), min(counts.values())
        if max(counts.values()) - frames > MOST_EXTRA_FRAMES:
            raise StorageError(f"{told}. Fetch those again.")
        if told:
            assumed = f"The first {frames} of all are used, assumed to begin together"
            self.remark("frames", f"{told}. {assumed}")
        return frames

    def odd_ones(self, found: Mapping[str, object], what: str) -> str:
        """Return that files do not have alike what most of them have; "" where they do."""
        common = Counter(found.values()).most_common(1)[0][0]
        odd = [f"{name} has {value}" for name, value in found.items() if value != common]
        told = f"{len(found) - len(odd)} have {common}, but {', '.join(odd)}"
        return f"{self.key}: its videos must have {what}: {told}" if odd else ""

    def common_key_frames(self, frames: int) -> tuple[int, ...]:
        """Return the frames at which all videos of pictures have a key frame."""
        listed = [set(each.key_frames) for name, each in self.facts.items() if name[-4:] == ".mp4"]
        common = set(range(frames)).intersection(*listed) if listed else set()
        return tuple(sorted(common | {0}))

    def require_one_size(self) -> None:
        """Refuse videos of different picture sizes."""
        sizes = {name: f"{fact.width_px}x{fact.height_px}" for name, fact in self.facts.items()}
        if told := self.odd_ones(sizes, "one picture size in pixels"):
            raise StorageError(f"{told}. Fetch those again.")

    def require_kinds(self, rig: Rig) -> None:
        """Refuse views without colours, and depth videos that hold colours."""
        depths = [fact for name, fact in self.facts.items() if name in _DEPTHS]
        grey = sum(not fact.is_colour for fact in depths)
        for name, fact in self.facts.items():
            where, stored = self.where(name), fact.pixel_format or "grey"
            require_pixel_aspect(fact.pixel_aspect, rig, name=where)
            if name not in _DEPTHS and not fact.is_colour:
                raise MediaError(f"{where}: is stored by codec {fact.codec} as {stored}{NO_COLOUR}")
            if name in _DEPTHS and fact.is_colour and (grey or "matroska" not in fact.container):
                raise MediaError(
                    f"{where}: holds colours (codec {fact.codec}, {stored}), and depth is one "
                    f"number a pixel, as in {grey} other depth videos of the scene. Another video "
                    f"stands under this name: fetch it again."
                )

    def poses(self, rig: Rig, frames: int) -> MatchedPoses | None:
        """Return the poses that fit the rig.

        Raises:
            SchemaError: If conventions state how poses are read, and they do not fit the rig.
        """
        where = self.where(TRAJECTORY_JSON)
        found, reason = self.understand(rig, where, frames)
        count = frames if found is None else found.poses.frame_count
        told = f"{where}: has poses of {count} frames, and the videos have {frames}"
        # Without the last frame poses are those of the others; without the first they are not.
        fewest = 0 if found is None or found.at.first else -MOST_EXTRA_FRAMES
        if not fewest <= count - frames <= MOST_EXTRA_FRAMES:
            found, reason = None, f"{told}."
        if found is None:
            if not assumed_places_m(rig):
                raise StorageError(
                    f"{reason} Without poses the rig is assumed to be a straight line of cameras, "
                    f"and the baselines in {BASELINE_JSON} do not add up to one: correct either "
                    f"file."
                )
            self.remark("poses", reason)
            return None
        if count < frames or (
            count > frames and not any(each.about == "frames" for each in self.remarks)
        ):
            self.remark("frames", f"{told}. The first {min(count, frames)} are used")
        if len(found.names) > 1:
            listed = ", ".join(name.partition(" @ ")[0] for name in found.names)
            self.remark(
                "world",
                f"{where}: several readings of its poses fit the rig: {listed}; `stereogenbench "
                f"doctor` tells by depth which is right",
            )
        return found

    def understand(self, rig: Rig, where: str, frames: int) -> tuple[MatchedPoses | None, str]:
        """Return poses that fit the rig, or why there are none."""
        named = None if self.shape is None else self.shape.poses
        if named is not None and named.form == UNKNOWN:
            told = f"is not read: the conventions call the form of its poses {UNKNOWN!r}."
            return None, f"{where}: {told}"
        if TRAJECTORY_JSON not in self.files:
            return None, f"{where}: is missing."
        if TRAJECTORY_JSON in self.hollow:
            return None, f"{self.hollow[TRAJECTORY_JSON]}."
        try:
            text = self.folder.read(TRAJECTORY_JSON)
            if self.settled is not None:
                return declared_poses(text, rig, where=where, settled=self.settled), ""
            return settled_poses(text, rig, where=where, named=named, frames=frames), ""
        except SidesError as error:
            family, scale = parse_scene_key(self.key).family, error.scale
            # Poses in a unit by which the rig would be of no scene of the family are wrong.
            is_theirs = scale and not is_of_family(rig, family, scale=scale)
            if not (is_theirs and is_of_family(rig, family)):
                self.remark("left", str(error))
            return None, str(error)
        except SchemaError as error:
            if named is not None:
                raise
            return None, str(error)

    def depth_units(
        self, depths: Sequence[tuple[str, StreamFacts]]
    ) -> list[tuple[float, float, DepthUnitSource]]:
        """Return what files state of each camera's depth: unit and offset in m, and by what.

        Such a scene can still be used, for its colours or with the user's own unit.

        Raises:
            SchemaError: If conventions state another unit than a tag.
        """
        stated: list[Statement] = []
        read = BASELINE_JSON, TRAJECTORY_JSON, COMPLETE_JSON, DESCRIPTION_JSON
        for name in (name for name in self.files if name in read or name not in FILES):
            with suppress(SchemaError):
                text, stem = self.folder.read(name), name.rpartition(".")[0]
                if re.search(rb"(?i)depth|zbuffer", stem.encode() + text):
                    document = parse_object(text, where=name)
                    stated += stated_in_json(
                        document, name=self.where(name), about="" if name in read else stem,
                        is_prose=name == DESCRIPTION_JSON,
                    )  # fmt: skip
        found: list[tuple[float, DepthUnitSource]] = []
        problems: list[str] = []
        for name, facts in depths:
            try:
                found.append(stated_unit(facts, name=self.where(name), stated=stated))
            except MediaError as error:
                found.append(_UNREADABLE)
                problems.append(str(error))
        known = [each for each in found if each is not _UNREADABLE]
        units_m = [unit_m for unit_m, _ in known]
        if units_m and max(units_m) > _SAME_UNIT * min(units_m):
            found = [_UNREADABLE] * len(found)
            listed = ", ".join(
                f"{unit_m:g}{' by default' if source == 'default' else ''}"
                for unit_m, source in known
            )
            problems.append(
                f"{self.key}: its cameras' units of depth differ by a scale: {listed} m. "
                f"{DEPTH_CURES}"
            )
        depth = None if self.shape is None else self.shape.depth
        if depth is not None and depth.encoding.unit_m is not None:
            for (name, _), (unit_m, source) in zip(depths, found, strict=True):
                if source in ("tag", "metadata"):
                    depth.require(unit_m, where=self.where(name))
            return [(depth.encoding.unit_m, depth.encoding.offset_m, "conventions")] * len(found)
        if problems:
            others = len(problems) - 1
            more = f" ({counted(others, 'other video')} likewise.)" if others else ""
            self.remark("depth", problems[0] + more)
        return [(unit_m, 0.0, source) for unit_m, source in found]

    def valid_depth_ratio(self, frames: int) -> float:
        """Return the share of pixels of some depth pictures that have a depth."""
        shares = []
        for name in (held_name(self.files, depth_name(camera)) for camera in range(CAMERA_COUNT)):
            if name not in self.files:
                continue
            where = self.where(name)
            with open_video(self.folder.video(name), name=where, frames=frames) as reader:
                stored = reader.facts.pixel_format
                for frame in sorted({0, frames // 2, frames - 1}):
                    units = read_depth_units(reader, frame, encoding=ANY_DEPTH)
                    known = measured(units, encoding=ANY_DEPTH, pixel_format=stored)
                    shares.append(float(np.mean(known)))
        return float(np.mean(shares)) if shares else 0.0

    def derived(self, scene: Scene) -> Scene:
        """Return the row, which in training shards must be what their document says."""
        if self.document is None:
            return scene
        some, files = next(iter(self.facts.values())), self.document.files
        here = [name for name in files if name in self.files]
        sizes = (tuple(each[name][0] for name in here) for each in (self.files, files))
        for what, found, said in (
            ("key", self.key, self.document.key),
            ("sizes of files", *sizes),
            ("size", (some.width_px, some.height_px), self.document.size_px),
            ("key frames", scene.key_frames, self.document.key_frames),
        ):
            if found != said:
                raise StorageError(
                    f"{self.key}: {TRAINING_JSON} tells {what} {brief(said)}, and the scene has "
                    f"{brief(found)}. A file is of another scene: fetch the scene again."
                )
        return replace(derived_scene(scene, self.document), depth_codec=scene.depth_codec)


def keys_in(folder: SceneFolder, names: Iterable[str]) -> frozenset[str]:
    """Return the keys of a scene's files, as `keys_of` names them, without unreadable ones."""
    found: set[str] = set()
    for name in names:
        try:
            document = parse_object(folder.read(name), where=name)
        except (StereoGenBenchError, KeyError):
            continue
        found |= {f"{name}: {place}" for place in keys_of(document)}
    return frozenset(found)


def as_kept(remarks: list[Remark]) -> tuple[Remark, ...]:
    """Return remarks as a row keeps them: shortened, and without secrets."""
    return tuple(
        Remark(each.about, shortened(text_without_secrets(each.text), _LONGEST_REMARK))
        for each in remarks
    )


def median_depth_m(root: str | Path, scene: Scene) -> float:
    """Return the median depth in metres of a scene's first depth picture by its row's unit.

    nan where there is no such picture, or none that can be read.
    """
    name = next((name for name in scene.held_videos if name[6:12] == "_depth"), "")
    with suppress(StereoGenBenchError, KeyError):
        video = Path(root, scene.members[name].path)
        with open_video(video, name=name, frames=scene.frames) as reader:
            units = read_depth_units(reader, 0, encoding=ANY_DEPTH)
            known = measured(units, encoding=ANY_DEPTH, pixel_format=reader.facts.pixel_format)
        return float(np.median(units[known])) * scene.depth_unit_m[0] if known.any() else math.nan
    return math.nan


def missing_video(key: str, name: str) -> str:
    """Return what is remarked about a video that a scene lacks."""
    return f"{key}/{name}: is missing, and the scene is marked as complete"


def assumed_places_m(rig: Rig) -> tuple[float, ...]:
    """Return the distance of each camera to the right of camera 0 by the baselines alone.

    The cameras are assumed to stand on a line; () where the baselines are not those of a line.
    """
    of_pair = dict(zip(CAMERA_PAIRS, rig.baselines_cm, strict=True))
    _, (first, last) = max(zip(rig.baselines_cm, CAMERA_PAIRS, strict=True))
    along_cm = [
        of_pair.get((first, camera), of_pair.get((camera, first), 0.0))
        for camera in range(CAMERA_COUNT)
    ]
    for (a, b), baseline_cm in of_pair.items():
        allowed_cm = _DEVIATION_CM + _DEVIATION_SHARE * along_cm[last]
        if abs(abs(along_cm[b] - along_cm[a]) - baseline_cm) > allowed_cm:
            return ()
    left, right = rig.primary_pair
    sign = 1 if along_cm[right] > along_cm[left] else -1
    return tuple(sign * (place_cm - along_cm[0]) / 100 for place_cm in along_cm)


def members_of(key: str, files: Files, *, without: Collection[str] = ()) -> dict[str, Member]:
    """Return where a release's files of a scene's folder are."""
    return {
        name: Member(f"{key}/{name}", 0, size)
        for name, (size, _) in files.items()
        if name in FILES and name not in without
    }


def held_name(files: Mapping[str, object], name: str) -> str:
    """Return the name under which a folder holds a released file: depth may be packed."""
    return name if name in files else PACKED_DEPTH_NAMES.get(name, name)


def unfinished(key: str) -> IncompleteScene:
    """Return the error of a scene without its completion mark, in a tree that has such marks."""
    return IncompleteScene(f"{key}: has no {COMPLETE_JSON}, so it was never finished")


def require_finished(
    key: str, files: Mapping[str, object], *, videos: tuple[str, ...] = VIDEO_FILES
) -> None:
    """Refuse a scene of which the listing of its files shows that it cannot be used.

    Raises:
        IncompleteScene: If it has no video at all.
        StorageError: If it has no ``baseline.json``.
    """
    if not files:
        raise IncompleteScene(f"{key}: the folder is empty")
    if not any(held_name(files, name) in files for name in videos):
        raise IncompleteScene(f"{key}: has metadata only, and none of its {len(videos)} videos")
    if BASELINE_JSON not in files:
        raise StorageError(
            f"{key}: has no {BASELINE_JSON} (it has {', '.join(files)}). Fetch what is missing."
        )


def caption_of(texts: Mapping[str, bytes], *, key: str) -> tuple[str, tuple[Remark, ...]]:
    """Return a scene's caption from its files, that of the JSON if it has one; "" without any."""
    remarks: list[Remark] = []
    for name in (each for each in DESCRIPTIONS if each in texts):
        caption, odd = parse_caption(texts[name], where=f"{key}/{name}")
        remarks += odd
        if caption:
            return caption, tuple(remarks)
    return "", tuple(remarks)


def merged_labels(labels: SceneLabels, marked: SceneLabels) -> SceneLabels:
    """Return the labels of baseline.json; those it lacks come from the completion mark."""
    values = {each.name: getattr(labels, each.name) for each in fields(SceneLabels)}
    lacking = [name for name, value in values.items() if value is None]
    return SceneLabels(**(values | {name: getattr(marked, name) for name in lacking}))


def sized_as_videos(
    key: str,
    rig: Rig,
    size_px: tuple[int, int],
    *,
    remarks: list[Remark],
    shape: Declaration | None,
) -> Rig:
    """Return the rig for pictures of the videos' size; that in baseline.json does not count.

    A principal point, in pixels of the recorded image, moves with the size.
    """
    known_px = rig.image_width_px, rig.image_height_px
    known, now = (f"{w}x{h}" for w, h in (known_px, size_px))
    is_recorded = rig.image_size_source == "recorded"
    if is_recorded and known_px != size_px:
        if shape is not None and not {"image_width", "image_height"}.isdisjoint(shape.stated):
            raise StorageError(
                f"{key}: by the conventions pictures have {known} pixels, and all videos have "
                f"{now}. Correct [image_width] and [image_height], or leave them out: the "
                f"videos' size counts."
            )
        told = f"is for pictures of {known} pixels, and all videos have {now}, which counts"
        remarks.append(Remark("size", f"{key}: {BASELINE_JSON} {told}"))
    point_px = rig.principal_point_px
    if point_px is not None and known_px != size_px:
        if is_recorded:  # else it is in pixels of the videos
            x, y = (own / known for own, known in zip(size_px, known_px, strict=True))
            point_px = (point_px[0] * x, point_px[1] * y)
        if all(abs(at - side / 2) <= 1 for at, side in zip(point_px, size_px, strict=True)):
            point_px = None
    height_mm = rig.sensor_height_mm
    if height_mm == rig.sensor_width_mm * known_px[1] / known_px[0]:
        # Recorded pixels are square, and Unreal renders square pixels at any size.
        height_mm = rig.sensor_width_mm * size_px[1] / size_px[0]
    aspect = rig.sensor_width_mm / height_mm * size_px[1] / size_px[0]
    if abs(aspect - 1) > _SQUARE:
        told = (
            f"{key}: a sensor of {rig.sensor_width_mm:.6g} x {height_mm:.6g} mm and pictures "
            f"of {now} pixels have pixels that are not square ({aspect:.4g} times as wide as "
            f"high)"
        )
        remarks.append(Remark("pixels", told))
    return replace(
        rig,
        principal_point_px=point_px,
        sensor_height_mm=height_mm,
        image_width_px=size_px[0],
        image_height_px=size_px[1],
    )


def derived_scene(scene: Scene, document: TrainingDocument) -> Scene:
    """Return the row of a scene of training shards, from its released row or its own.

    The rig keeps what ``baseline.json`` records, and knows the size of the derived pictures. The
    places of the files are not changed.
    """
    if not RELEASED_NAMES.keys().isdisjoint(document.files):
        formats = tuple(map(grey_format, scene.depth_pixel_format))
        codecs = (CODEC_NAME,) * CAMERA_COUNT
        scene = replace(scene, depth_codec=codecs, depth_pixel_format=formats)
    return replace(
        scene,
        rig=replace(
            scene.rig,
            image_width_px=document.size_px[0],
            image_height_px=document.size_px[1],
            recorded_size_px=document.source_size_px,
        ),
        key_frames=document.key_frames,
        training=document.facts,
    )
