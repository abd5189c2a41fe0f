"""Whether a scene's row of an index is what its files say, read by what the row itself states."""

from collections.abc import Collection, Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Final

import numpy as np

from stereogenbench_data.errors import MediaError, SchemaError, StorageError
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.index.tree import Files, SceneFolder
from stereogenbench_data.media.container import SeekableFile
from stereogenbench_data.schema.conventions import Conventions, declaration_of
from stereogenbench_data.schema.declaration import BUILT_IN, PosesAt
from stereogenbench_data.schema.depth_contract import UNREAD
from stereogenbench_data.schema.document import brief
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    DESCRIPTION_JSON,
    TRAINING_JSON,
    TRAJECTORY_JSON,
    depth_name,
)
from stereogenbench_data.sources.members import MemberSource

Difference = tuple[str, str]
"""The file's name, empty for the scene's own path, and how it contradicts the row."""

_ROUNDING: Final = {"lateral_m": 1e-6, "rig_residual_px": 1e-3}
_RECORDS: Final = {
    "id": "", "rig": BASELINE_JSON, "labels": BASELINE_JSON, "training": TRAINING_JSON,
}  # fmt: skip
"""The records of a row, and the files that tell them."""


def compared_with_files(
    scene: Scene, source: MemberSource, *, videos: Collection[str] | None = None
) -> tuple[Scene, list[Difference]]:
    """Return what the files in a scene's row say, and how the row differs from that.

    Not compared is what the row does not know, and what may depend on files that are no members,
    such as a unit of depth stated elsewhere.

    Args:
        scene: The row.
        source: Opens its files.
        videos: Names of the videos to open; None is all.

    Returns:
        The scene, or the row itself if its files cannot be used; and the differences.
    """
    key, declared = scene.id.key, replace(declaration_of(scene), has=())
    if scene.pose_form and declared.poses is None:
        declared = replace(declared, poses=PosesAt.of_reading(scene.pose_form.split("|")[0]))
    stated = None if declared == BUILT_IN else Conventions((declared,))
    try:
        now = describe_scene(
            "", key, conventions=stated, folder=_MemberFolder(source, scene), videos=videos
        )
    except (SchemaError, MediaError, StorageError) as error:
        # The form is the row's, and no file of conventions states it.
        told = str(error).replace(" Correct [poses], or leave it out.", "")
        return scene, [_placed(key, told)]
    # What an earlier version understood and this one does not read is taken from the row.
    knows_depth = videos is None and {*scene.depth_unit_source} <= {"tag", "default"}
    knows_depth = knows_depth and not any(why in now.remark("depth") for why in UNREAD)
    new = [about for about in ("frames", "poses", *(["depth"] if knows_depth else []))
           if now.remark(about) and not scene.remark(about)]  # fmt: skip
    new += ["videos"] if scene.members.keys() != now.members.keys() else []
    found = [_placed(key, now.remark(about)) for about in new]
    unknown = set[str]()
    if scene.remark("poses") or "poses" in new:
        unknown = {"lateral_m", "rig_residual_px", "pose_form"}
    elif scene.pose_form:
        unknown = {"pose_form"}  # by which the files were read
    if "frames" in new or (scene.remark("frames") and now.frames > scene.frames):
        unknown.add("frames")
    if now.id.subset is None:
        unknown.add("subset")
    cameras = range(CAMERA_COUNT) if videos is None else ()
    before, after = (
        _facts(row, cameras=cameras, with_units=knows_depth and "depth" not in new)
        for row in (scene, now)
    )
    for (name, what), value in after.items():
        indexed = before.get((name, what))
        if what not in unknown and not _same(value, indexed, within=_ROUNDING.get(what, 1e-9)):
            text = f"tells {what} {brief(value)}, and by the index it is {brief(indexed)}"
            found.append((name, text) if name in scene.members else ("", f"its path {text}"))
    return now, found


def _facts(
    scene: Scene, *, cameras: Iterable[int], with_units: bool
) -> dict[tuple[str, str], object]:
    """Return what files say of a scene, by the file's name and that of the quantity."""
    facts: dict[tuple[str, str], object] = {
        (name, each.name): getattr(record, each.name)
        for part, name in _RECORDS.items() if (record := getattr(scene, part)) is not None
        for each in fields(record)
    }  # fmt: skip
    facts[DESCRIPTION_JSON, "caption"] = scene.caption
    if scene.training is not None:
        facts[TRAINING_JSON, "key_frames"] = scene.key_frames
    for what in ("frames", "pose_form", "lateral_m", "rig_residual_px"):
        facts[TRAJECTORY_JSON, what] = getattr(scene, what)
    units = ("depth_unit_m", "depth_offset_m") if with_units else ()
    for what in ("depth_codec", "depth_pixel_format", *units):
        for camera in cameras:
            facts[scene.held_name(depth_name(camera)), what] = getattr(scene, what)[camera]
    return facts


def _same(found: object, indexed: object, *, within: float) -> bool:
    """Return whether two values are equal; numbers may differ by rounding, and nan equals nan."""
    one, other = np.asarray(found), np.asarray(indexed)
    if one.dtype.kind == other.dtype.kind == "f" and one.shape == other.shape:
        return np.allclose(one, other, rtol=within, atol=within, equal_nan=True)
    return found == indexed


def _placed(key: str, told: str) -> Difference:
    """Return a message about a scene as the name of its file and the rest."""
    name, _, rest = told.removeprefix(key).partition(": ")
    return (name[1:], rest.rstrip(".")) if told.startswith(key) else ("", told.rstrip("."))


class _MemberFolder(SceneFolder):
    """The files of a scene that an index lists: members of shards, or of a folder."""

    def __init__(self, source: MemberSource, scene: Scene) -> None:
        """Name the scene, and what opens its files; nothing is read yet."""
        self.key = scene.id.key
        self._source, self._scene = source, scene

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes of each file."""
        return {name: (each.size, 0) for name, each in sorted(self._scene.members.items())}

    def hollow(self, files: Files) -> dict[str, str]:
        """Return no file: members are compared with their checksums."""
        return {}

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole and compared with its checksum."""
        return self._source.read(self._scene, name)

    def video(self, name: str) -> Path | SeekableFile:
        """Return a video: its path, or an open file that the caller closes."""
        return self._source.open(self._scene, name)
