"""What a descriptor and a card say of a dataset as a whole: authors, licence, limits, provenance.

The properties are those of Croissant, under their names. They differ by where the data come from:

- `DRAWN`: scenes whose marks of completion say that `stereogenbench synth` drew them, from its own
  shapes.
- `RELEASE`: the scenes of the StereoGenBench paper, if the user says so: others may be rendered
  on maps of the same names. Source: the paper's sections on limitations, responsible use and
  release, and its appendices on hosting and on the generation environment.
- other scenes, also those that `synth` rendered from assets of the user: their maker states the
  properties, in a copy of `template`.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

from stereogenbench_data.errors import DescriptorError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import COMPLETE_JSON
from stereogenbench_data.sources.members import MemberSource

Facts = dict[str, Any]
About = Path | Literal["release"]
"""What the user states of data: a JSON file, or that they are the scenes of the paper."""

TITLE: Final = "StereoGenBench"
HOME: Final = "https://huggingface.co/datasets/stereo-dataset/stereo-dataset"
ARXIV: Final = "2605.23237"
PAPER: Final = f"https://arxiv.org/abs/{ARXIV}"
BIBTEX: Final = """\
@article{cui2026stereogenbench,
  title   = {StereoGenBench: A Synthetic Multi-Camera Benchmark for Stereo Generation under
             Controlled Baseline Regimes},
  author  = {Cui, Yangzhi and Qiao, Feng and Jacobs, Nathan},
  journal = {arXiv preprint arXiv:2605.23237},
  year    = {2026},
  url     = {https://arxiv.org/abs/2605.23237}
}
"""
"""The paper, as `CITATION.bib` has it."""
DERIVED: Final = (
    "These shards were derived from other scenes for training, and do not replace them: pictures "
    "are smaller and were encoded again, with an error; depth has the nearest pixels of the source "
    "depth, without loss. Scores of the benchmark need the released pictures."
)
_CONTENT: Final = (
    "Synthetic stereo scenes, each filmed by six cameras on one rigid lateral rig: RGB and metric "
    "depth as videos, intrinsics, the baselines of all 15 camera pairs, and a pose for every "
    "camera and frame."
)
_CC_BY: Final = "https://creativecommons.org/licenses/by/4.0/"
_MIT: Final = "https://opensource.org/license/mit"
LICENCE_NAMES: Final = {_CC_BY: "cc-by-4.0", _MIT: "mit"}
"""The Hub's name of a licence, by its URL."""
_AFFILIATION: Final = "Washington University in St. Louis"
_DEVELOPERS: Final = "The stereogenbench_data developers"
_COLLECTING, _PROCESSING, _ANNOTATING = (
    {"@id": f"https://www.wikidata.org/wiki/{item}"}
    for item in ("Q4929239", "Q1172378", "Q109719325")
)


def activity(label: str, about: str, *, by: str, kind: Mapping[str, str] = _PROCESSING) -> Facts:
    """Return what was done to make data, and who or what did it."""
    return {
        "@type": "prov:Activity",
        "prov:type": dict(kind),
        "prov:label": label,
        "description": about,
        "prov:wasAttributedTo": {"@type": "prov:Agent", "prov:label": by},
    }


def entity(label: str, about: str) -> Facts:
    """Return what data were made from."""
    return {"@type": "prov:Entity", "prov:label": label, "description": about}


def _person(name: str) -> Facts:
    organisation = {"@type": "sc:Organization", "name": _AFFILIATION}
    return {"@type": "sc:Person", "name": name, "affiliation": organisation}


RELEASE: Final[Facts] = {
    "name": TITLE,
    "description": (
        f"{_CONTENT} Two families of baselines for evaluation (IPD_Gaussian, Uniform) and one for "
        "training alone (Pairwise_Uniform); eval scenes on maps that training has seen and on maps "
        "that it has not."
    ),
    "url": HOME,
    "license": _CC_BY,
    "usageInfo": (
        "The rendered RGB and depth, the scene manifests and the authored metadata are CC-BY-4.0; "
        "the authors' code is MIT. Third-party Unreal Engine maps, character meshes, animations, "
        "textures and materials are not part of the dataset and keep their own licences."
    ),
    "citeAs": BIBTEX,
    "keywords": [
        "stereo", "disparity", "depth", "multi-camera", "synthetic", "view synthesis", "video",
        "benchmark",
    ],
    "creator": [_person(name) for name in ("Yangzhi Cui", "Feng Qiao", "Nathan Jacobs")],
    "rai:dataCollection": (
        "No camera recorded anything: every scene is rendered in Unreal Engine 5.5.4 by six "
        "virtual cameras that move together along a trajectory of 81 poses, with avatars and "
        "animations from a fixed pool of assets."
    ),
    "rai:dataCollectionType": ["Others: synthetic rendering"],
    "rai:dataPreprocessingProtocol": [
        "Automated filters while scenes are made: collisions, visibility, framing and motion.",
        "After rendering: checks of depth payload, darkness, flat or frozen pictures and occluders "
        "at the border; a manual pass over previews; a final audit of geometry and files.",
        "RGB and metric depth are encoded as videos of 81 frames; depth is stored as whole numbers "
        "with a scale.",
    ],
    "rai:dataAnnotationProtocol": [
        "Depth, intrinsics, baselines and poses are taken from the renderer. Scene descriptions "
        "are written by a model and were not verified by people.",
    ],
    "rai:machineAnnotationTools": ["Qwen/Qwen2.5-VL-3B-Instruct (scene descriptions)"],
    "rai:dataUseCases": [
        "Training and evaluation of stereo generation, stereo geometry, view synthesis and depth "
        "methods under known baselines, focal lengths and poses.",
        "Not recommended: surveillance, biometric identification, inference of identity, "
        "demographic analysis, recognition of human behaviour, synthetic media made to "
        "impersonate.",
    ],
    "rai:dataLimitations": [
        "Synthetic: results are no evidence of performance on real pictures without a separate "
        "study of how the two relate.",
        "Passed checks mean only that no failure was detected; they certify neither that all views "
        "are free of artefacts, nor exact physics of motion, nor unambiguous depth of all "
        "materials.",
        "How stored depth numbers become metres is given by a scale tag, else 0.1 m a unit: "
        "measure it against the pictures before relying on it.",
    ],
    "rai:dataBiases": [
        "A finite pool of Unreal maps (some stylised), 15 characters and 30 animations; lighting "
        "and materials of one engine; heuristics that choose places, framing and motion.",
        "Avatars come from a limited pool and represent no population.",
    ],
    "rai:personalSensitiveInformation": [
        "None: all people shown are synthetic avatars; no real person was recorded.",
    ],
    "rai:dataSocialImpact": (
        "Better stereo generation serves film, displays and robotics, and could also serve "
        "synthetic media that deceive. No likeness of a real person is in the data, and "
        "impersonation, surveillance and biometrics are named as uses not recommended."
    ),
    "rai:dataReleaseMaintenancePlan": (
        "Published on the Hugging Face Hub, where questions and corrections are taken; a change of "
        "files is a new revision of the repository."
    ),
    "rai:hasSyntheticData": True,
    "prov:wasGeneratedBy": [
        activity(
            "Rendering",
            "Scenes rendered with Unreal Engine 5.5.4, Movie Render Pipeline and PCG, on one "
            "workstation (Intel Core i7-13700K, AMD Radeon RX 7900 XTX).",
            by=_AFFILIATION, kind=_COLLECTING,
        ),
        activity(
            "Checking and encoding",
            "Automated filters, a manual pass over previews, a final audit; RGB and depth encoded "
            "as videos.",
            by=_AFFILIATION,
        ),
        activity(
            "Scene descriptions",
            "Written by Qwen/Qwen2.5-VL-3B-Instruct from pictures of camera 00.",
            by="Qwen2.5-VL-3B-Instruct", kind=_ANNOTATING,
        ),
    ],
    "prov:wasDerivedFrom": [
        entity(
            "Third-party Unreal Engine maps, characters and animations",
            "15 character and 30 animation files and third-party environments. They are not "
            "redistributed and keep their own licences.",
        )
    ],
}  # fmt: skip
"""The properties of the scenes of the paper."""

RELEASE_ITSELF: Final[Facts] = RELEASE | {
    "datePublished": "2026-05",
    "version": "1.0.0",
    "description": (
        f"{RELEASE['description']} This descriptor is made from the paper, without the files: the "
        "release states no version and no day of publication, so 1.0.0 and the month of the paper "
        "stand for them; how many scenes each part has are the paper's counts."
    ),
}
"""The properties of the public release as a whole, described without its files."""

DRAWN: Final[Facts] = {
    "name": "Drawn stereo scenes in the layout of StereoGenBench",
    "description": (
        f"{_CONTENT} The scenes are drawn by the command `stereogenbench synth`, to try and test "
        "software with. They have the layout and the families of baselines of StereoGenBench, but "
        "are not part of it."
    ),
    "license": _MIT,
    "usageInfo": (
        "Drawn by a program under the MIT licence, from no material of others; whoever drew the "
        "scenes may state another licence."
    ),
    "citeAs": (
        "@software{stereogenbench_data, title={stereogenbench_data}, "
        f"author={{{{{_DEVELOPERS}}}}}, year={{2026}}}}"
    ),
    "keywords": ["stereo", "disparity", "depth", "multi-camera", "synthetic", "video", "sample"],
    "creator": [{"@type": "sc:Organization", "name": _DEVELOPERS}],
    "rai:dataCollection": (
        "No camera recorded anything: a program draws each scene, and films it with six virtual "
        "cameras that move together along a path."
    ),
    "rai:dataCollectionType": ["Others: synthetic rendering"],
    "rai:dataPreprocessingProtocol": [
        "RGB and metric depth are encoded as videos. Scenes may be filtered while they are made.",
    ],
    "rai:dataAnnotationProtocol": [
        "Depth, intrinsics, baselines and poses are those of the drawing. Scene descriptions are "
        "sentences filled in by the same program; no model wrote them.",
    ],
    "rai:dataUseCases": [
        "Trying, testing and teaching software for stereo data.",
        "Not recommended: training of models that are put to use, scores of the benchmark.",
    ],
    "rai:dataLimitations": [
        "Simple shapes and procedural textures: no evidence of performance on StereoGenBench or on "
        "real pictures.",
        "Few scenes, which cover no range of contents.",
    ],
    "rai:dataBiases": [
        "One style of drawing: simple shapes and procedural textures, a few built-in places and "
        "figures.",
    ],
    "rai:personalSensitiveInformation": ["None: figures are made of simple shapes."],
    "rai:dataSocialImpact": "None is expected of scenes that serve to test software.",
    "rai:hasSyntheticData": True,
    "prov:wasGeneratedBy": [
        activity(
            "Drawing", "Scenes drawn and filmed by `stereogenbench synth`.",
            by="stereogenbench_data", kind=_COLLECTING,
        )
    ],
    "prov:wasDerivedFrom": [
        entity(
            "Procedural shapes and textures",
            "Parts of the program; no picture, model or animation of others is used.",
        ),
        entity(
            f"Layout of {TITLE}", f"Names of files and families of baselines, as in {PAPER}.",
        ),
    ],
}  # fmt: skip
"""The properties of scenes that `stereogenbench synth` made."""

_BUILT_IN: Final = "ray-casting"
"""How marks of completion name the renderer of `DRAWN` scenes; the earliest name none."""
_BLANK: Final = "FILL IN: "
_QUESTIONS: Final[Facts] = {
    "name": "the dataset's name",
    "description": "what the scenes show, how many there are, what they are for",
    "license": "the URL of its licence",
    "usageInfo": "what the licence covers and what it does not, such as assets of others",
    "citeAs": "how to cite it, as BibTeX",
    "keywords": ["stereo", "depth", "synthetic", "video"],
    "creator": [{"@type": "sc:Person", "name": "who made it"}],
    "rai:dataCollection": "how the scenes were rendered or recorded, by what",
    "rai:dataUseCases": ["what it is for, and what it is not recommended for"],
    "rai:dataLimitations": ["where results on it do not hold"],
    "rai:dataBiases": ["what it shows too much or too little of"],
    "rai:personalSensitiveInformation": ["whether real people can be seen or identified"],
    "rai:dataSocialImpact": "what good and what harm its use may do",
    "rai:hasSyntheticData": True,
    "prov:wasGeneratedBy": [
        activity("Rendering", "with what program and settings", by="who", kind=_COLLECTING)
    ],
    "prov:wasDerivedFrom": [
        entity("Assets", "maps, characters and animations, and their licences")
    ],
}  # fmt: skip
_AS_THEY_ARE: Final = frozenset({"@type", "@id", "prov:type", "keywords"})
_STATED: Final = frozenset(
    {*RELEASE, *DRAWN, *_QUESTIONS, "version", "datePublished", "inLanguage"}
)


def template() -> Facts:
    """Return the properties that the maker of other scenes must state, with blanks to fill in."""
    return {name: _with_blanks(value, name) for name, value in _QUESTIONS.items()}


def _with_blanks(value: Any, name: str) -> Any:
    if isinstance(value, dict):
        return {key: _with_blanks(each, key) for key, each in value.items()}
    if name in _AS_THEY_ARE or not isinstance(value, str | list):
        return value
    if isinstance(value, list):
        return [_with_blanks(each, name) for each in value]
    return f"{_BLANK}{value}"


def blanks(value: Any, *, at: str = "") -> list[str]:
    """Return the places below a value, such as "creator.name", that still have a blank."""
    if isinstance(value, dict):
        return [
            place
            for name, each in value.items()
            for place in blanks(each, at=f"{at}.{name}" if at else name)
        ]
    if isinstance(value, list):
        return [place for each in value for place in blanks(each, at=at)]
    return [at] if isinstance(value, str) and value.startswith(_BLANK.strip()) else []


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
    facts = RELEASE_ITSELF if index is None else _known(index, about)
    if isinstance(about, Path):
        facts = facts | _stated(about)
    missing = [name for name in _QUESTIONS if name not in facts]
    if index is not None and missing:
        raise DescriptorError(
            f"{about or index.where}: who made the data, how, and under which licence is not "
            f"known, because `stereogenbench synth` did not draw them. Not stated: "
            f"{', '.join(missing)}. If they are the scenes of the StereoGenBench paper, add "
            "`--about release`. If not, write the questions into a file with `stereogenbench "
            "croissant --template -o about.json`, answer them, and add `--about about.json`."
        )
    return facts


def _stated(about: Path) -> Facts:
    try:
        facts = json.loads(about.read_bytes())
    except (OSError, ValueError) as error:
        raise DescriptorError(
            f"{about}: cannot be read as JSON ({error}). Write one with `stereogenbench croissant "
            "--template -o about.json`."
        ) from error
    if not isinstance(facts, dict):
        raise DescriptorError(f"{about}: must be a JSON object, found a {type(facts).__name__}.")
    unknown = sorted(facts.keys() - _STATED)
    if unknown:
        raise DescriptorError(
            f"{about}: has {', '.join(map(repr, unknown))}, which a file of this kind does not "
            f"state; it may state {', '.join(sorted(_STATED))}."
        )
    if places := blanks(facts):
        raise DescriptorError(
            f"{about}: {', '.join(places)} must be filled in: what stands there is the question."
        )
    return facts


def derivation_facts(index: SceneIndex) -> dict[str, Any]:
    """Return from what, how and with what error training shards were derived, as JSON.

    Several values of a fact, as of scenes that were derived with several settings, are a list.
    """
    scenes = [index.scene(row) for row in range(len(index))]
    known = [(scene.rig, scene.training) for scene in scenes if scene.training is not None]
    facts: dict[str, Any] = {}
    for name, values in (
        ("size", {f"{rig.image_width_px}x{rig.image_height_px}" for rig, _ in known}),
        ("quality", {training.quality for _, training in known}),
        ("codec", {training.codec for _, training in known}),
        ("settings", {training.settings for _, training in known}),
        ("source_digest", {training.source_digest for _, training in known}),
    ):
        found = sorted(values)
        found = [json.loads(each) for each in found] if name == "settings" else found
        facts[name] = found[0] if len(found) == 1 else found
    mean_db = [each for _, training in known for each in training.psnr_db if each == each]
    worst_db = [each for _, training in known for each in training.worst_psnr_db if each == each]
    facts["psnr_db"] = {
        "mean": round(sum(mean_db) / max(len(mean_db), 1), 3),
        "worst_frame": min(worst_db, default=0.0),
    }
    return facts


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
