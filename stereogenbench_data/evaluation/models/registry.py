"""The measuring systems by name: each is loaded when it is asked for, with what it needs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.models.interfaces import (
    ImageFeatures,
    KeypointMatcher,
    PairMetric,
    StereoMatcher,
    VideoFeatures,
)

System = TypeVar("System")


@dataclass(frozen=True, slots=True)
class Where:
    """Where learned systems find their parts and compute.

    Attributes:
        device: As torch names it.
        weights: The folder of weights files; None for that of torch.hub's checkpoints, and for
            FoundationStereo that in its checkout.
        checkout: The folder of FoundationStereo's repository.
    """

    device: str = "cpu"
    weights: Path | None = None
    checkout: Path | None = None


_ON_CPU: Final = Where()


def load_keypoint_matcher(name: str, where: Where = _ON_CPU) -> KeypointMatcher:
    """Return a keypoint matcher, of `KEYPOINT_MATCHERS`.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    return _loaded("keypoint matcher", name, where, _KEYPOINT_MATCHERS)


def load_stereo_matcher(name: str, where: Where = _ON_CPU) -> StereoMatcher:
    """Return a stereo matcher, of `STEREO_MATCHERS`.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    return _loaded("stereo matcher", name, where, _STEREO_MATCHERS)


def load_pair_metric(name: str, where: Where = _ON_CPU) -> PairMetric:
    """Return a metric of pictures against targets, of `PAIR_METRICS`.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    return _loaded("pair metric", name, where, _PAIR_METRICS)


def load_image_features(name: str, where: Where = _ON_CPU) -> ImageFeatures:
    """Return an extractor of pictures' features, of `IMAGE_FEATURES`.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    return _loaded("image features", name, where, _IMAGE_FEATURES)


def load_video_features(name: str, where: Where = _ON_CPU) -> VideoFeatures:
    """Return an extractor of clips' features, of `VIDEO_FEATURES`.

    Raises:
        EvaluationError: If there is none of this name, or its weights are damaged.
        ExtraError: If a package or weights that it needs are missing.
    """
    return _loaded("video features", name, where, _VIDEO_FEATURES)


def _loaded(
    kind: str, name: str, where: Where, known: dict[str, Callable[[Where], System]]
) -> System:
    if name not in known:
        raise EvaluationError(f"{kind} must be one of {', '.join(known)}, got {name!r}.")
    return known[name](where)


def _sift(where: Where) -> KeypointMatcher:
    from stereogenbench_data.evaluation.models.opencv import Sift

    return Sift()


def _dedode(where: Where) -> KeypointMatcher:
    from stereogenbench_data.evaluation.models.dedode import DeDoDeMatcher

    return DeDoDeMatcher(weights=where.weights, device=where.device)


def _sgbm(where: Where) -> StereoMatcher:
    from stereogenbench_data.evaluation.models.opencv import Sgbm

    return Sgbm()


def _foundation_stereo(where: Where) -> StereoMatcher:
    from stereogenbench_data.evaluation.models.foundation_stereo import FoundationStereoMatcher

    return FoundationStereoMatcher(
        checkout=where.checkout, weights=where.weights, device=where.device
    )


def _lpips(where: Where) -> PairMetric:
    from stereogenbench_data.evaluation.models.lpips import Lpips

    return Lpips(weights=where.weights, device=where.device)


def _colour_statistics(where: Where) -> ImageFeatures:
    from stereogenbench_data.evaluation.models.picture_statistics import ColourStatistics

    return ColourStatistics()


def _inception(where: Where) -> ImageFeatures:
    from stereogenbench_data.evaluation.models.inception import InceptionFeatures

    return InceptionFeatures(weights=where.weights, device=where.device)


def _motion_statistics(where: Where) -> VideoFeatures:
    from stereogenbench_data.evaluation.models.picture_statistics import MotionStatistics

    return MotionStatistics()


def _i3d(where: Where) -> VideoFeatures:
    from stereogenbench_data.evaluation.models.i3d import I3dFeatures

    return I3dFeatures(weights=where.weights, device=where.device)


_KEYPOINT_MATCHERS: Final[dict[str, Callable[[Where], KeypointMatcher]]] = {
    "sift": _sift,
    "dedode": _dedode,
}
_STEREO_MATCHERS: Final[dict[str, Callable[[Where], StereoMatcher]]] = {
    "sgbm": _sgbm,
    "foundation-stereo": _foundation_stereo,
}
_PAIR_METRICS: Final[dict[str, Callable[[Where], PairMetric]]] = {"lpips": _lpips}
_IMAGE_FEATURES: Final[dict[str, Callable[[Where], ImageFeatures]]] = {
    "colour-statistics": _colour_statistics,
    "inception": _inception,
}
_VIDEO_FEATURES: Final[dict[str, Callable[[Where], VideoFeatures]]] = {
    "motion-statistics": _motion_statistics,
    "i3d": _i3d,
}

KEYPOINT_MATCHERS: Final = tuple(_KEYPOINT_MATCHERS)
STEREO_MATCHERS: Final = tuple(_STEREO_MATCHERS)
PAIR_METRICS: Final = tuple(_PAIR_METRICS)
IMAGE_FEATURES: Final = tuple(_IMAGE_FEATURES)
VIDEO_FEATURES: Final = tuple(_VIDEO_FEATURES)
