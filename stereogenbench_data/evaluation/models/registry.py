"""The models that metrics are computed with, by name; each is imported when first used.

To add a model, write a class with the members of its kind in `interfaces` and name it here.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from stereogenbench_data.errors import EvaluationError

ModelKind = Literal[
    "keypoint matcher", "stereo matcher", "pair metric", "image features", "video features"
]


@dataclass(frozen=True, slots=True)
class ModelOptions:
    """Where learned models run, and where their files are.

    Attributes:
        device: As torch names it.
        weights: The folder of weights files; None for that of torch.hub's checkpoints, and for
            FoundationStereo that in its checkout.
        checkout: The folder of FoundationStereo's repository.
    """

    device: str = "cpu"
    weights: Path | None = None
    checkout: Path | None = None


class ModelEntry(NamedTuple):
    """The class of a model, as "module:class" of this folder, and the `ModelOptions` it takes."""

    path: str
    options: tuple[str, ...] = ()


_LEARNED: Final = ("device", "weights")

MODELS: Final[dict[ModelKind, dict[str, ModelEntry]]] = {
    "keypoint matcher": {
        "sift": ModelEntry("opencv:Sift"),
        "dedode": ModelEntry("dedode:DeDoDeMatcher", _LEARNED),
    },
    "stereo matcher": {
        "sgbm": ModelEntry("opencv:Sgbm"),
        "foundation-stereo": ModelEntry(
            "foundation_stereo:FoundationStereoMatcher", (*_LEARNED, "checkout")
        ),
    },
    "pair metric": {"lpips": ModelEntry("lpips:Lpips", _LEARNED)},
    "image features": {
        "colour-statistics": ModelEntry("picture_statistics:ColourStatistics"),
        "inception": ModelEntry("inception:InceptionFeatures", _LEARNED),
    },
    "video features": {
        "motion-statistics": ModelEntry("picture_statistics:MotionStatistics"),
        "i3d": ModelEntry("i3d:I3dFeatures", _LEARNED),
    },
}
"""Every model by kind and name."""


def load_model(kind: ModelKind, name: str, options: ModelOptions | None = None) -> Any:
    """Return a model of a kind, with the members that `interfaces` says.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    known = MODELS[kind]
    if name not in known:
        raise EvaluationError(f"{kind} must be one of {', '.join(known)}, got {name!r}.")
    entry = known[name]
    module, _, class_name = entry.path.partition(":")
    model = getattr(import_module(f"{__package__}.{module}"), class_name)
    options = options or ModelOptions()
    return model(**{option: getattr(options, option) for option in entry.options})
