"""The files and record sets of a repository with the release's folders of scenes.

JSON files outside tars can be parsed, so scenes and pairs are read from each ``baseline.json``, and
the descriptor does not depend on the number of scenes.
"""

from typing import Final

from stereogenbench_data.bridges.croissant.nodes import (
    ENCODINGS,
    GIT,
    GIT_CHECKSUM,
    RELEASED_SUFFIXES,
    TEXT,
    UNKNOWN_ENCODING,
    VIDEO_TEXTS,
    Node,
    enumerations,
    field,
    file_object,
    file_set,
    of_file,
    record_set,
    suffixes_of,
    text_records,
    video_records,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    COMPLETE_JSON,
    DESCRIPTION_TXT,
    SCENE_COUNTS,
    TRAJECTORY_JSON,
)

REPOSITORY: Final = "repository"
_KEY: Final = r"^.*?((?:train|eval)/.+?/[^/.]+?)(?:/[^/]*\.[^/]*)?$"
"""The scene of a file in a folder. It does not change a key: a join applies the regex twice."""


def release_nodes(*, repository_url: str) -> tuple[list[Node], list[Node]]:
    """Return the files and the record sets of the release, as the paper describes it.

    The record sets hold their data themselves: reading one through the repository would clone all
    of it.
    """
    files = [_repository(repository_url)]
    files += [
        file_set(name, within=[REPOSITORY], encoding=encoding, includes=f"**/{file}", about=about)
        for name, (encoding, file, about) in _release_sets().items()
    ]
    return files, [*enumerations(None), _parts()]


def _release_sets() -> dict[str, tuple[str, str, str]]:
    """Return, for each id, the encoding, the file name and the meaning."""
    json_files = {
        "baseline-files": (BASELINE_JSON, "Intrinsics and baselines."),
        "trajectory-files": (TRAJECTORY_JSON, "Poses."),
        "scene_complete-files": (COMPLETE_JSON, "Marks of completion."),
    }
    return {
        **{
            f"{kind}-files": (ENCODINGS[suffix], f"cam_??_{kind}.{suffix}", VIDEO_TEXTS[kind])
            for kind, suffix in RELEASED_SUFFIXES.items()
        },
        **{name: ("application/json", file, about) for name, (file, about) in json_files.items()},
        "description-files": (TEXT, DESCRIPTION_TXT, "Descriptions."),
    }


def _parts() -> Node:
    """Return the record set of the release's parts with their numbers of scenes."""
    fields = [
        field("parts/split", "sc:Text", "One of splits."),
        field("parts/eval_subset", "sc:Text", "One of eval_subsets; empty in train."),
        field("parts/family", "sc:Text", "One of families."),
        field("parts/scenes", "sc:Integer", "How many scenes the paper counts."),
    ]
    data = [
        dict(zip((each["@id"] for each in fields), (*part, count), strict=True))
        for part, count in SCENE_COUNTS.items()
    ]
    return record_set("parts", "Every part of the release once.", fields, data=data)


def _repository(url: str) -> Node:
    return file_object(
        REPOSITORY,
        url=url,
        encoding=GIT,
        sha256=GIT_CHECKSUM,
        about=(
            "The git repository that holds the scenes as folders. mlcroissant reads files of it by "
            "cloning the whole repository, with GitPython."
        ),
    )


def folder_nodes(index: SceneIndex, *, repository_url: str) -> tuple[list[Node], list[Node]]:
    """Return the files and the record sets of a tree in the released layout.

    Args:
        index: The index of the tree, for the names of families, maps and files.
        repository_url: URL of the git repository that holds it.
    """
    suffixes = suffixes_of(index)
    files = [_repository(repository_url)]
    files += [
        file_set(name, within=[REPOSITORY], encoding=encoding, includes=f"**/{file}", about=about)
        for name, (encoding, file, about) in _file_sets(suffixes).items()
    ]
    records = [
        *enumerations(index),
        _scenes(),
        _pairs(),
        _descriptions(),
        *(video_records(kind, key=_KEY) for kind in suffixes),
        *text_records(scene_of=_KEY),
    ]
    return files, records


def _file_sets(suffixes: dict[str, str]) -> dict[str, tuple[str | list[str], str, str]]:
    """Return, for each id, the encodings, the file name and the meaning.

    mlcroissant has no reader for videos. It reads them as bytes if they are also called text.
    """
    videos = {
        f"{kind}-files": (
            [ENCODINGS.get(suffix, UNKNOWN_ENCODING), TEXT],
            f"cam_??_{kind}.{suffix}",
            VIDEO_TEXTS[kind],
        )
        for kind, suffix in suffixes.items()
    }
    return {
        "scene-files": ("application/json", BASELINE_JSON, "Intrinsics of the scenes."),
        "pair-files": ("application/json", BASELINE_JSON, "Baselines of the pairs."),
        "description-files": (TEXT, DESCRIPTION_TXT, "Descriptions."),
        **videos,
        "baseline-files": (TEXT, BASELINE_JSON, "Intrinsics and baselines, as text."),
        "trajectory-files": (TEXT, TRAJECTORY_JSON, "Poses, as text."),
        "scene_complete-files": (TEXT, COMPLETE_JSON, "Marks of completion, as text."),
    }


def _in_json(files: str, path: str) -> Node:
    return {"source": {"fileSet": {"@id": files}, "extract": {"jsonPath": path}}}


def _scene_of(records: str, files: str, about: str = "Path of the scene.") -> Node:
    return field(f"{records}/scene_id", "sc:Text", about, **of_file(files, "fullpath", regex=_KEY))


def _scenes() -> Node:
    intrinsics = "$.camera_intrinsics"
    fields = [
        _scene_of(
            "scenes", "scene-files", "Path of the scene: split, subset, family, map, number."
        ),
        field(
            "scenes/focal_mm", "sc:Float", "Focal length of all six cameras, in mm.",
            **_in_json("scene-files", f"{intrinsics}.focal_length_mm"),
        ),
        field(
            "scenes/sensor_width_mm", "sc:Float", "Width of the sensor, in mm.",
            **_in_json("scene-files", f"{intrinsics}.sensor_width_mm"),
        ),
    ]  # fmt: skip
    return record_set("scenes", "Every scene once.", fields, key={"@id": "scenes/scene_id"})


def _pairs() -> Node:
    each_pair = "$.pairwise_pairs[*]"
    fields = [
        _scene_of("pairs", "pair-files"),
        *(
            field(f"pairs/{name}", kind, about, **_in_json("pair-files", f"{each_pair}.{key}"))
            for name, key, kind, about in (
                ("camera_left", "camera_index_a", "sc:Integer", "Number of the left camera."),
                ("camera_right", "camera_index_b", "sc:Integer", "Number of the right camera."),
                ("baseline_cm", "baseline_cm", "sc:Float", "Distance of the two cameras, in cm."),
            )
        ),
    ]
    return record_set("pairs", "Every stereo pair once: 15 a scene.", fields)


def _descriptions() -> Node:
    text = field(
        "descriptions/text", "sc:Text", "What is in the file.",
        **of_file("description-files", "content"),
    )  # fmt: skip
    fields = [_scene_of("descriptions", "description-files"), text]
    return record_set("descriptions", "Descriptions of scenes, where there are any.", fields)
