"""The models that metrics are computed with, by name; each is imported when first used.

To add a model, write a class with the members of its kind in `interfaces` and name it here. Of the
`ModelOptions` it is given those that its constructor has a parameter for.
"""

from dataclasses import asdict, dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, Final, Literal

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


MODELS: Final[dict[ModelKind, dict[str, str]]] = {
    "keypoint matcher": {
        "sift": "opencv:Sift",
        "dedode": "dedode:DeDoDeMatcher",
    },
    "stereo matcher": {
        "sgbm": "opencv:Sgbm",
        "foundation-stereo": "foundation_stereo:FoundationStereoMatcher",
    },
    "pair metric": {"lpips": "lpips:Lpips"},
    "image features": {"inception": "inception:InceptionFeatures"},
    "video features": {"i3d": "i3d:I3dFeatures"},
}
"""The class of every model, by kind and name, as "module:class" of this folder."""


def load_model(kind: ModelKind, name: str, options: ModelOptions | None = None) -> Any:
    """Return a model of a kind, as defined in `interfaces`.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    known = MODELS[kind]
    if name not in known:
        raise EvaluationError(f"{kind} must be one of {', '.join(known)}, got {name!r}.")
    module, _, class_name = known[name].partition(":")
    model = getattr(import_module(f"{__package__}.{module}"), class_name)
    taken = signature(model).parameters
    given = asdict(options or ModelOptions())
    return model(**{option: value for option, value in given.items() if option in taken})
