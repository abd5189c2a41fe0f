"""The scores of frames: one candidate's right views of one pair, against the rendered ones."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from av.video.reformatter import VideoReformatter

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.frechet import Spread
from stereogenbench_data.evaluation.matching import TargetMatches, match_error, target_matches
from stereogenbench_data.evaluation.patches import PatchScore, outside_window, patch_psnr
from stereogenbench_data.evaluation.pixels import psnr_db, ssim
from stereogenbench_data.evaluation.predictions import scaled_rgb
from stereogenbench_data.evaluation.protocol import EvaluationProtocol, Tools
from stereogenbench_data.evaluation.protocols import KeypointMatcher
from stereogenbench_data.evaluation.scale import fit_scale
from stereogenbench_data.samples.fields import Sample


@dataclass(slots=True)
class PairScores:
    """The scores of one candidate's right views of one pair.

    Attributes:
        columns: For each column, a number for each frame; nan where there is none.
        predicted: For each distance, the spread of the features of the right views.
        target: The same of the rendered views.
        fault: "", or why there are no scores.
    """

    columns: dict[str, list[float]] = field(default_factory=dict)
    predicted: dict[str, Spread] = field(default_factory=dict)
    target: dict[str, Spread] = field(default_factory=dict)
    fault: str = ""


class TargetFrame:
    """One frame of one pair, with what of its scores does not depend on the prediction."""

    def __init__(
        self,
        sample: Sample,
        protocol: EvaluationProtocol,
        matcher: KeypointMatcher | None,
        *,
        stored_right: Callable[[], Any],
    ) -> None:
        """Take the sample; nothing is computed yet.

        Args:
            sample: Its fields, pictures at the evaluated size.
            protocol: How it is scored.
            matcher: The matcher of keypoints, if one is needed.
            stored_right: Returns the rendered right view at its stored size.
        """
        self.sample = sample
        self.protocol = protocol
        self._matcher = matcher
        self._stored_right = stored_right

    @cached_property
    def scaled_from_stored(self) -> "TargetFrame":
        """The frame whose right view is scaled in RGB, as predictions of the stored size are.

        The one of the sample is scaled before it becomes RGB, with other roundings.
        """
        right = scaled_rgb(
            self._stored_right(), size=self.right.shape[1:], scaler=VideoReformatter()
        )
        sample = {**self.sample, "right": right}
        return TargetFrame(sample, self.protocol, self._matcher, stored_right=self._stored_right)

    @property
    def left(self) -> Any:
        """The left view, uint8 (3, h, w)."""
        return self.sample["left"]

    @property
    def right(self) -> Any:
        """The rendered right view, uint8 (3, h, w)."""
        return self.sample["right"]

    @property
    def matcher(self) -> KeypointMatcher:
        """The matcher of keypoints."""
        if self._matcher is None:
            raise EvaluationError("keypoints are matched for e_match alone: ask for that metric.")
        return self._matcher

    @cached_property
    def ceiling(self) -> PatchScore:
        """P-PSNR of the rendered view."""
        return patch_psnr(self.left, self.right)

    @cached_property
    def outside(self) -> float:
        """The share of measured pixels whose disparity P-PSNR does not search."""
        return outside_window(self.sample["disparity"][0], self.sample["valid"][0])

    @cached_property
    def matches(self) -> TargetMatches:
        """The matches of left and rendered right view."""
        return target_matches(self.left, self.right, matcher=self.matcher)


class PairScorer:
    """Gathers the scores of one candidate's right views of one pair."""

    def __init__(self, tools: Tools) -> None:
        """Begin with no frame."""
        self.fault = ""
        self._tools = tools
        self._columns: dict[str, list[float]] = {name: [] for name in tools.protocol.columns}
        self._predicted: dict[str, Spread] = {}
        self._target: dict[str, Spread] = {}
        self._clip: list[tuple[Any, Any]] = []

    def add(self, given: Sequence[Any], frames: Sequence[TargetFrame]) -> None:
        """Score some frames: right views, and what they are compared with.

        A view of the stored size is scaled, and compared with the rendered one scaled likewise.
        """
        scaler = VideoReformatter()
        pictures = [
            scaled_rgb(picture, size=frame.right.shape[1:], scaler=scaler)
            for picture, frame in zip(given, frames, strict=True)
        ]
        targets = [
            frame if picture.shape == frame.right.shape else frame.scaled_from_stored
            for picture, frame in zip(given, frames, strict=True)
        ]
        for picture, target in zip(pictures, targets, strict=True):
            for name, number in self._frame(picture, target).items():
                self._columns[name].append(float(number))
        for name, metric in self._tools.pair_metrics.items():
            rendered = np.stack([target.right for target in targets])
            self._columns[name].extend(metric(np.stack(pictures), rendered).tolist())
        for name, features in self._tools.image_features.items():
            shown = features(np.stack(pictures))
            self._merge(name, shown, features(np.stack([target.right for target in targets])))
        if self._tools.video_features:
            rendered_views = (target.right for target in targets)
            self._clip.extend(zip(pictures, rendered_views, strict=True))

    def _frame(self, picture: Any, target: TargetFrame) -> dict[str, float]:
        found: dict[str, float] = {}
        for name in self._tools.protocol.metrics:
            if name in _OF_FRAME:
                found |= _OF_FRAME[name](picture, target, self._tools)
        return found

    def _merge(self, name: str, predicted: Any, target: Any) -> None:
        for spreads, features in ((self._predicted, predicted), (self._target, target)):
            new = Spread.of(features)
            spreads[name] = spreads[name].merged(new) if name in spreads else new

    def scores(self) -> PairScores:
        """Return what was gathered."""
        if self.fault:
            return PairScores(fault=self.fault)
        for name, features in self._tools.video_features.items():
            if len(self._clip) < features.min_frames:
                raise EvaluationError(
                    f"{name} needs clips of at least {features.min_frames} frames, and "
                    f"{len(self._clip)} are evaluated: ask for more frames."
                )
            predicted, target = (np.stack(views)[None] for views in zip(*self._clip, strict=True))
            self._merge(name, features(predicted), features(target))
        return PairScores(self._columns, self._predicted, self._target)


def _psnr(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    return {"psnr": psnr_db(picture, target.right)}


def _ssim(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    return {"ssim": ssim(picture, target.right)}


def _p_psnr(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    score = patch_psnr(target.left, picture)
    return {
        "p_psnr": score.mean_db,
        "p_psnr_pooled": score.pooled_db,
        "p_psnr_ceiling": target.ceiling.mean_db,
        "p_psnr_outside": target.outside,
    }


def _e_match(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    score = match_error(picture, against=target.matches, matcher=target.matcher)
    return {
        "e_match": score.error,
        "keypoints": score.keypoints,
        "target_matches": score.target_matches,
        "predicted_matches": score.predicted_matches,
        "common_matches": score.common,
    }


def _sd(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    """Return SD by each fit of the protocol, all of one disparity map."""
    estimated_px = tools.stereo_matcher(target.left, picture)
    found: dict[str, float] = {}
    for method in tools.protocol.fits:
        fit = fit_scale(
            estimated_px,
            target.sample["disparity"][0],
            scored=target.sample["visible"][0],
            method=method,
        )
        found |= {
            f"sd_{method}": fit.drift,
            f"sd_{method}_slope": fit.slope,
            f"sd_{method}_offset_px": fit.offset_px,
            f"sd_{method}_valid": fit.valid_ratio,
            f"sd_{method}_outliers": fit.outlier_ratio,
            f"sd_{method}_residual_px": fit.residual_std_px,
            f"sd_{method}_r2": fit.r_squared,
            "sd_answered": fit.answered_ratio,
        }
    return found


_OF_FRAME: Mapping[str, Any] = {
    "psnr": _psnr,
    "ssim": _ssim,
    "p_psnr": _p_psnr,
    "e_match": _e_match,
    "sd": _sd,
}
