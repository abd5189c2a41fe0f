"""Title, authors, licences, citation and responsible use of the dataset.

The descriptor and the dataset card quote these texts.

Source: the StereoGenBench paper, its sections on limitations, responsible use and release, and its
appendices on hosting and on the generation environment.
"""

from typing import Any, Final

TITLE: Final = "StereoGenBench"
VERSION: Final = "1.0.0"
HOME: Final = "https://huggingface.co/datasets/stereo-dataset/stereo-dataset"
DATA_LICENCE: Final = "https://creativecommons.org/licenses/by/4.0/"
CODE_LICENCE: Final = "MIT"
AUTHORS: Final = ("Yangzhi Cui", "Feng Qiao", "Nathan Jacobs")
AFFILIATION: Final = "Washington University in St. Louis"
DESCRIPTION: Final = (
    "Synthetic stereo scenes, each filmed by six cameras on one rigid lateral rig: RGB and metric "
    "depth as videos, intrinsics, the baselines of all 15 camera pairs, and a pose for every "
    "camera and frame. Two families of baselines for evaluation (IPD_Gaussian, Uniform) and one "
    "for training alone (Pairwise_Uniform); eval scenes on maps that training has seen and on "
    "maps that it has not."
)
DERIVED: Final = (
    "These shards were derived from the release for training, and do not replace it: pictures are "
    "smaller and were encoded again, with an error; depth has the nearest pixels of the released "
    "depth, without loss. Scores of the benchmark need the released pictures."
)
LICENCE_NOTE: Final = (
    "The rendered RGB and depth, the scene manifests and the authored metadata are CC-BY-4.0; the "
    "authors' code is MIT. Third-party Unreal Engine maps, character meshes, animations, textures "
    "and materials are not part of the dataset and keep their own licences."
)
KEYWORDS: Final = (
    "stereo", "disparity", "depth", "multi-camera", "synthetic", "view synthesis", "video",
    "benchmark",
)  # fmt: skip
CITATION: Final = (
    "@article{cui2026stereogenbench, title={StereoGenBench: A Synthetic Multi-Camera Benchmark for "
    "Stereo Generation under Controlled Baseline Regimes}, author={Cui, Yangzhi and Qiao, Feng and "
    "Jacobs, Nathan}, year={2026}}"
)

RESPONSIBLE_USE: Final[dict[str, str | list[str] | bool]] = {
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
}
"""Responsible AI properties, with the names of the RAI 1.0 specification and hasSyntheticData."""

PROVENANCE: Final[dict[str, Any]] = {
    "prov:wasGeneratedBy": [
        {
            "@type": "prov:Activity",
            "prov:type": {"@id": "https://www.wikidata.org/wiki/Q4929239"},
            "prov:label": "Rendering",
            "description": (
                "Scenes rendered with Unreal Engine 5.5.4, Movie Render Pipeline and PCG, on one "
                "workstation (Intel Core i7-13700K, AMD Radeon RX 7900 XTX)."
            ),
            "prov:wasAttributedTo": {"@type": "prov:Agent", "prov:label": AFFILIATION},
        },
        {
            "@type": "prov:Activity",
            "prov:type": {"@id": "https://www.wikidata.org/wiki/Q1172378"},
            "prov:label": "Checking and encoding",
            "description": (
                "Automated filters, a manual pass over previews, a final audit; RGB and depth "
                "encoded as videos."
            ),
            "prov:wasAttributedTo": {"@type": "prov:Agent", "prov:label": AFFILIATION},
        },
        {
            "@type": "prov:Activity",
            "prov:type": {"@id": "https://www.wikidata.org/wiki/Q109719325"},
            "prov:label": "Scene descriptions",
            "description": "Written by Qwen/Qwen2.5-VL-3B-Instruct from pictures of camera 00.",
            "prov:wasAttributedTo": {"@type": "prov:Agent", "prov:label": "Qwen2.5-VL-3B-Instruct"},
        },
    ],
    "prov:wasDerivedFrom": [
        {
            "@type": "prov:Entity",
            "prov:label": "Third-party Unreal Engine maps, characters and animations",
            "description": (
                "15 character and 30 animation files and third-party environments. They are not "
                "redistributed and keep their own licences."
            ),
        }
    ],
}
