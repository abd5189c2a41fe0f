"""The models that metrics are computed with, by name; each is imported when first used.

Your own is a class with the members of its kind in `interfaces`, named as "module:Class" or
"FILE.py:Class". Of the `ModelOptions` it is given those that its constructor has a parameter for.
`examples/dedode_matcher.py` and `examples/foundation_stereo_matcher.py` are the paper's.
"""

from dataclasses import asdict, dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from runpy import run_path
from typing import Any, Final

from stereogenbench_data.errors import EvaluationError, ExtraError


@dataclass(frozen=True, slots=True)
class ModelOptions:
    """Where learned models run, and where their files are.

    Attributes:
        device: As torch names it.
        weights: The folder of weights files; None for that of torch.hub's checkpoints.
    """

    device: str = "cpu"
    weights: Path | None = None


MODELS: Final[dict[str, dict[str, str]]] = {
    "keypoint matcher": {"sift": f"{__package__}.opencv:Sift"},
    "stereo matcher": {"sgbm": f"{__package__}.opencv:Sgbm"},
    "pair metric": {"lpips": f"{__package__}.lpips:Lpips"},
    "image features": {"inception": f"{__package__}.inception:InceptionFeatures"},
    "video features": {"i3d": f"{__package__}.i3d:I3dFeatures"},
}
"""The class of every model of this package, by kind and name, as "module:Class"."""


def load_model(kind: str, name: str, options: ModelOptions | None = None) -> Any:
    """Return a model of a kind, as defined in `interfaces`.

    Args:
        kind: What the model does.
        name: One of `MODELS`, or "module:Class" or "FILE.py:Class" for a model of your own.
        options: Where it runs, and where its weights are.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    known = MODELS[kind]
    place, _, class_name = known.get(name, name).rpartition(":")
    if not place:
        raise EvaluationError(
            f"{kind} must be one of {', '.join(known)}, or module:Class or FILE.py:Class of your "
            f"own, got {name!r}."
        )
    try:
        names = run_path(place) if place.endswith(".py") else vars(import_module(place))
        model = names[class_name]
    except (ImportError, OSError, KeyError) as error:
        raise ExtraError(f"{kind} {name}: cannot be imported ({error}).") from error
    taken = signature(model).parameters
    given = asdict(options or ModelOptions())
    return model(**{option: value for option, value in given.items() if option in taken})
