"""Record sets of files that both layouts have: videos as bytes, JSON files as text."""

from typing import Final

from stereogenbench_data.bridges.croissant_terms import (
    Node,
    field,
    of_file,
    record_set,
    refers_to,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import BASELINE_JSON, COMPLETE_JSON, TRAJECTORY_JSON

RELEASED_SUFFIXES: Final = {"rgb": "mp4", "depth": "mkv"}
ENCODINGS: Final = {"mp4": "video/mp4", "mkv": "video/x-matroska"}
"""Suffix of videos to media type; depth packed by blosc2 has none of its own."""
UNKNOWN_ENCODING: Final = "application/octet-stream"

TEXT_FILES = {
    "baseline": (BASELINE_JSON, "Intrinsics and baselines"),
    "trajectory": (TRAJECTORY_JSON, "Poses"),
    "scene_complete": (COMPLETE_JSON, "Marks of completion"),
}


def suffixes_of(index: SceneIndex | None) -> dict[str, str]:
    """Return how names end by kind of video, "rgb" and "depth", of the kinds that there are.

    A part of the release may hold one kind alone, and depth may be packed. Without an index it is
    the release.
    """
    if index is None:
        return dict(RELEASED_SUFFIXES)
    names = index.scene(0).held_videos
    ends = {kind: [name for name in names if f"_{kind}." in name] for kind in RELEASED_SUFFIXES}
    return {kind: found[0].rpartition(".")[2] for kind, found in ends.items() if found}


def video_records(kind: str, *, key: str) -> Node:
    """Return the record set of all "rgb" or "depth" videos, joined to their scenes.

    Args:
        kind: "rgb" or "depth"; the files are those of the set ``rgb-files`` or ``depth-files``.
        key: Regex whose first group is the scene of a path. A join applies it twice, so it must
            leave a scene's key as it is; and no other field may read the path.
    """
    name, files = f"{kind}_videos", f"{kind}-files"
    camera = rf"^.*?cam_(\d{{2}})_{kind}\.\w+$"
    return record_set(
        name, f"Every {kind} video, joined to its scene.", [
            field(
                f"{name}/scene_id", "sc:Text", "Path of the scene.",
                **of_file(files, "fullpath", regex=key), **refers_to("scenes/scene_id"),
            ),
            field(
                f"{name}/camera", "sc:Integer", "Number of the camera.",
                **of_file(files, "filename", regex=camera),
            ),
            field(f"{name}/content", "sc:VideoObject", "The file.", **of_file(files, "content")),
        ],
    )  # fmt: skip


def text_records(*, scene_of: str) -> list[Node]:
    """Return the record sets of all JSON files as text.

    Args:
        scene_of: Regex whose first group is the scene of a path, with ``{file}`` where the file's
            name stands.
    """
    return [
        record_set(
            f"{name}_json", f"{about}, one a scene, as text.", [
                field(
                    f"{name}_json/scene_id", "sc:Text", "Path of the scene.",
                    **of_file(
                        f"{name}-files", "fullpath",
                        regex=scene_of.format(file=file.replace(".", r"\.")),
                    ),
                ),
                field(
                    f"{name}_json/content", "sc:Text", "The file.",
                    **of_file(f"{name}-files", "content"),
                ),
            ],
        )
        for name, (file, about) in TEXT_FILES.items()
    ]  # fmt: skip
