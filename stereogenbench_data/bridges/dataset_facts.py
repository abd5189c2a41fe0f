"""What a descriptor and a card say of a dataset as a whole: authors, licence, limits, provenance.

The properties are those of Croissant, under their names. They are data, in the folder `facts`:

- `DRAWN` (drawn.json): scenes whose marks of completion say that `stereogenbench synth` drew them,
  from its own shapes.
- `RELEASE` (release.json): the scenes of the StereoGenBench paper, if the user says so: others may
  be rendered on maps of the same names. Source: the paper's sections on limitations, responsible
  use and release, and its appendices on hosting and on the generation environment.
- other scenes, also those that `synth` rendered from assets of the user: their maker states the
  properties, in a copy of `template` (questions.json).
"""

import json
from pathlib import Path
from typing import Any, Final, Literal

from stereogenbench_data.errors import DescriptorError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import COMPLETE_JSON
from stereogenbench_data.sources.members import MemberSource

Facts = dict[str, Any]
About = Path | Literal["release"]
"""What the user states of data: a JSON file, or that they are the scenes of the paper."""


def _stored(name: str) -> Facts:
    path = Path(__file__).with_name("facts") / f"{name}.json"
    facts: Facts = json.loads(path.read_text(encoding="utf-8"))
    return facts


RELEASE: Final = _stored("release")
"""The properties of the scenes of the paper."""
DRAWN: Final = _stored("drawn")
"""The properties of scenes that `stereogenbench synth` made."""

STEPS: Final = _stored("steps")
"""What packing, deriving and a description without the files add."""
_BUILT_IN: Final = "ray-casting"
"""How marks of completion name the renderer of `DRAWN` scenes; the earliest name none."""
_BLANK: Final = "FILL IN:"


def template() -> Facts:
    """Return the properties that the maker of other scenes must state, with blanks to fill in."""
    return _stored("questions")


def blanks(value: Any, *, at: str = "") -> list[str]:
    """Return the places below a value, such as "creator.name", that still have a blank."""
    if isinstance(value, dict):
        below = ((each, f"{at}.{name}" if at else name) for name, each in value.items())
    elif isinstance(value, list):
        below = ((each, at) for each in value)
    else:
        return [at] if isinstance(value, str) and value.startswith(_BLANK) else []
    return [place for each, name in below for place in blanks(each, at=name)]


def listed(value: Any) -> list[Any]:
    """Return a single value, a list of values or None as a list."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]


def facts_of(index: SceneIndex | None, *, about: About | None = None) -> Facts:
    """Return the properties of a dataset.

    Args:
        index: The data; None for the release.
        about: "release" for the scenes of the paper. Or a JSON file with properties that their
            maker states: of scenes that `stereogenbench synth` drew those that differ, of others
            all of `template`.

    Raises:
        DescriptorError: If the file cannot be read, has a property with another name or a blank,
            or lacks one that is needed, or drawn scenes are said to be the paper's.
        StorageError: If the scenes' marks of completion cannot be read.
    """
    if index is None:
        description = f"{RELEASE['description']} {STEPS['without_files']}"
        stated = {"datePublished": "2026-05", "version": "1.0.0", "description": description}
        facts = RELEASE | stated
    else:
        facts = _known(index, about)
    if isinstance(about, Path):
        facts = facts | _stated(about)
    missing = [name for name in template() if name not in facts]
    if index is not None and missing:
        raise DescriptorError(
            f"{about or index.where}: who made the data, how, and under which licence is not "
            f"known, because `stereogenbench synth` did not draw them. Not stated: "
            f"{', '.join(missing)}. If they are the scenes of the StereoGenBench paper, add "
            "`--about release`. If not, write the questions into a file with `stereogenbench "
            "publish croissant --template -o about.json`, answer them, and add "
            "`--about about.json`."
        )
    return facts


def _stated(about: Path) -> Facts:
    try:
        facts = json.loads(about.read_bytes())
    except (OSError, ValueError) as error:
        raise DescriptorError(
            f"{about}: cannot be read as JSON ({error}). Write one with `stereogenbench publish "
            "croissant --template -o about.json`."
        ) from error
    if not isinstance(facts, dict):
        raise DescriptorError(f"{about}: must be a JSON object, found a {type(facts).__name__}.")
    known = {*RELEASE, *DRAWN, *template(), "version", "datePublished", "inLanguage"}
    unknown = sorted(facts.keys() - known)
    if unknown:
        raise DescriptorError(
            f"{about}: has {', '.join(map(repr, unknown))}, which a file of this kind does not "
            f"state; it may state {', '.join(sorted(known))}."
        )
    if places := blanks(facts):
        raise DescriptorError(
            f"{about}: {', '.join(places)} must be filled in: what stands there is the question."
        )
    return facts


def packing_facts(index: SceneIndex, facts: Facts) -> Facts:
    """Return what shards say besides, or instead: that files were packed, or how derived.

    Args:
        index: The index of the shards.
        facts: What is said of the scenes that are in them.
    """
    step = dict(STEPS["derived" if index.is_derived else "packed"])
    made = {"prov:wasGeneratedBy": [*listed(facts["prov:wasGeneratedBy"]), step]}
    if not index.is_derived:
        packed = any(name.endswith(".b2frame") for name in index.scene(0).held_videos)
        how = ", depth packed by blosc2 without loss" if packed else ""
        step["description"] = step["description"].format(how=how)
        return made
    derived = _derivation(index)
    step["description"] = step["description"].format(**derived)
    source = {
        "@type": "prov:Entity",
        "prov:label": facts["name"],
        "description": f"The scenes with the index {derived['source_digest']}.",
    }
    return made | {
        "description": f"{facts['description']} {STEPS['derived_text']}",
        "prov:wasDerivedFrom": [*listed(facts["prov:wasDerivedFrom"]), source],
    }


def _derivation(index: SceneIndex) -> dict[str, Any]:
    """Return from what, how and with what error training shards were derived.

    Several values of a fact, as of scenes that were derived with several settings, are all named.
    """
    scenes = [index.scene(row) for row in range(len(index))]
    records = [scene.training for scene in scenes if scene.training is not None]
    values = {
        "size": {f"{scene.rig.image_width_px}x{scene.rig.image_height_px}" for scene in scenes},
        **{
            name: {getattr(training, name) for training in records}
            for name in ("quality", "codec", "settings", "source_digest")
        },
    }
    mean_db = [each for training in records for each in training.psnr_db if each == each]
    worst_db = [each for training in records for each in training.worst_psnr_db if each == each]
    return {
        **{name: ", ".join(sorted(found)) for name, found in values.items()},
        "mean_db": sum(mean_db) / max(len(mean_db), 1),
        "worst_db": min(worst_db, default=0.0),
    }


def _known(index: SceneIndex, about: About | None) -> Facts:
    """Return what is known of data without their maker; one scene of each map is asked."""
    columns = (index.column(name) for name in ("split", "family", "map_name"))
    kinds = dict(zip(zip(*columns, strict=True), range(len(index)), strict=True))
    drawn = [row for row in kinds.values() if _is_drawn(index, row)]
    if about != "release":
        return DRAWN if len(drawn) == len(kinds) else {}
    if drawn:
        raise DescriptorError(
            f"{index.where}: {index.scene(drawn[0]).id.key} was drawn by `stereogenbench synth`, "
            "so these are not the scenes of the release. Leave out `--about release`."
        )
    return RELEASE


def _is_drawn(index: SceneIndex, row: int) -> bool:
    scene = index.scene(row)
    if COMPLETE_JSON not in scene.members:
        return False
    source = MemberSource(index.root, shards=index.shards, retry=index.retry)
    try:
        mark = json.loads(source.read(scene, COMPLETE_JSON))
    except ValueError:
        return False
    request = mark.get("synthesis") if isinstance(mark, dict) else None
    renderer = request.get("renderer", _BUILT_IN) if isinstance(request, dict) else ""
    return str(renderer).startswith(_BUILT_IN)
