"""The texts of a scene: its path in the release, its identifiers, its description."""

import re
from typing import Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.nodes import Node
from stereogenbench_data.schema.problems import Problems, brief
from stereogenbench_data.schema.records import Description, SceneId, SceneLabels
from stereogenbench_data.schema.release import subset_of_folder

_FOLDER: Final = re.compile(r"[!-\-0-\[\]-~](?:[ -\-0-\[\]-~]*[!-\-0-\[\]-~])?\Z")
"""Printable ASCII without dot, slash and backslash, and without a space at either end."""


def parse_scene_key(key: str) -> SceneId:
    """Return what a scene's path in the release says about it.

    Args:
        key: ``train/<family>/<map>/<scene>`` or ``eval/<subset>/<family>/<map>/<scene>``, with
            forward slashes. In a tar shard the first dot of a base name ends the key, so no
            folder's name may hold one.

    Raises:
        SchemaError: If the path has another form.

    Source: the paper's loading example.

    >>> parse_scene_key("train/Uniform/Stylized_Egypt/scene_000041").map_name
    'Stylized_Egypt'
    >>> parse_scene_key("eval/MapSeenInTrain/Uniform/Car_Dealer/scene_000000").subset
    'seen_map'
    """
    folders = key.split("/")
    if "." in key:
        raise SchemaError(
            f"scene {key!r}: a folder's name holds a dot, which would end the scene's name "
            f"in a tar shard. Rename the folder."
        )
    bad = next((folder for folder in folders if not _FOLDER.match(folder)), None)
    if bad is not None:
        raise SchemaError(
            f"scene {key!r}: {bad!r} cannot be a folder of a scene's path: such a name is plain "
            f"ASCII without a backslash or a space at an end. Rename the folder."
        )
    if folders[0] == "train" and len(folders) == 4:
        return SceneId(key, "train", None, folders[1], folders[2])
    if folders[0] == "eval" and len(folders) == 5:
        return SceneId(key, "eval", subset_of_folder(folders[1]), folders[2], folders[3])
    raise SchemaError(
        f"scene {key!r}: a scene's path is train/<family>/<map>/<scene> or "
        f"eval/<subset>/<family>/<map>/<scene>, found {len(folders)} folders "
        f"that start with {folders[0]!r}."
    )


def labels_of(root: Node) -> SceneLabels:
    """Return the identifiers that a file records; each is optional."""

    def text(quantity: str) -> str | None:
        found = root.find(quantity)
        return None if found is None else found.text()

    index = root.find("scene_index")
    fstop = root.find("aperture_fstop")
    return SceneLabels(
        scene_label=text("scene_label"),
        scene_index=None if index is None else index.integer(),
        map_name=text("map_name"),
        map_path=text("map_path"),
        character=text("character"),
        animation=text("animation"),
        aperture_fstop=None if fstop is None else fstop.positive(),
    )


def parse_complete(text: bytes, *, where: str) -> SceneLabels:
    """Return the identifiers in a ``_scene_complete.json``, the mark of a finished scene.

    Raises:
        SchemaError: If the file is not a JSON object or an identifier has the wrong type.

    Source: the paper's appendix on the file schema.
    """
    problems = Problems(where)
    labels = labels_of(Node(parse_object(text, where=where), "$", problems))
    problems.require_none()
    return labels


def parse_description(text: bytes, *, where: str) -> Description:
    """Return a scene's machine-written description; what it lacks is empty.

    Raises:
        SchemaError: If the file is not a JSON object or a text has the wrong type.

    Source: the paper's appendix on the file schema.
    """
    problems = Problems(where)
    root = Node(parse_object(text, where=where), "$", problems)

    def words(quantity: str) -> str:
        found = root.find(quantity)
        return "" if found is None else found.text()

    description = Description(
        short_caption=words("short_caption"),
        detailed_caption=words("detailed_caption"),
        scene_type=words("scene_type"),
        setting=words("setting"),
        tags=_tags(root),
    )
    problems.require_none()
    return description


def _tags(root: Node) -> tuple[str, ...]:
    tags = root.find("tags")
    if tags is None:
        return ()
    if not isinstance(tags.value, list):
        tags.complain(f"must be a list of texts, found {brief(tags.value)}")
        return ()
    return tuple(tags.child(place).text() for place in range(len(tags.value)))
