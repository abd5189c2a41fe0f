"""The errors of a disparity map, frame by frame, and their mean over the frames of a validation.

Disparity d is positive: x_right = x_left - d. A pixel is scored where the truth is valid; of these,
"visible" are those that the right camera sees (KITTI's noc), "occluded" the rest. No answer is nan
or inf. With the error e = |found - true| in px:

    epe, rms             mean of e, root of the mean of e**2, over answered pixels
    a50 a90 a95 a99      quantiles of e over answered pixels, linear between neighbours
    bad_t                share of scored pixels with e > t px, or without an answer
    d1                   share of scored pixels with e > 3 px and e > 5 % of the truth, or without
                         an answer
    invalid              share of scored pixels without an answer

Sources: Middlebury's evaluation, version 3 (avgErr, rms, quantiles, bad, invalid) and KITTI 2015's
development kit (D1). Two things are otherwise than there: KITTI fills what is not answered before
it scores, and pools the pixels of all images; Middlebury clips answers to the search range. Here
nothing is filled, pooled, clipped or rounded.
"""

import math
from typing import Final

import numpy as np
import torch

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.columns import BAD_PX, QUANTILES

D1_PX: Final = 3.0
D1_SHARE: Final = 0.05
"""An error counts in D1 where it is above both."""

MEASURES: Final = ("epe", "rms", *QUANTILES, *BAD_PX, "d1", "invalid")

RANGES_PX: Final = {
    "[0,16)": (0.0, 16.0),
    "[16,32)": (16.0, 32.0),
    "[32,64)": (32.0, 64.0),
    "[64,128)": (64.0, 128.0),
    "[128,256)": (128.0, 256.0),
    "[256,inf)": (256.0, math.inf),
}
"""Ranges of the true disparity, from the first number up to the second."""

REGIONS: Final = ("visible", "occluded")
"""The parts of all scored pixels: what the right camera sees (KITTI's noc), and the rest."""


def measures_of(errors: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    """Return every measure of some pixels of one frame; nan where there is none.

    Args:
        errors: (n,) float64, px, ascending; inf where there is no answer.
        truth: (n,) float64, px, their true disparity.
    """
    count, answered = errors.numel(), int(errors.isfinite().sum())
    measures = dict.fromkeys(MEASURES, math.nan)
    if answered:
        found = errors[:answered]
        measures |= {"epe": float(found.mean()), "rms": float(found.square().mean().sqrt())}
        measures |= {name: _quantile(found, share) for name, share in QUANTILES.items()}
    if count:
        limits_px = errors.new_tensor(list(BAD_PX.values()))
        within = torch.searchsorted(errors, limits_px, right=True).tolist()
        measures |= {name: 1 - each / count for name, each in zip(BAD_PX, within, strict=True)}
        is_wrong = (errors > D1_PX) & (errors > D1_SHARE * truth)
        measures |= {"d1": int(is_wrong.sum()) / count, "invalid": 1 - answered / count}
    return measures


def _quantile(ascending: torch.Tensor, share: float) -> float:
    """Return a quantile, between two numbers a part of both, as numpy does by default.

    torch's own takes 16 million numbers at the most.
    """
    place = share * (ascending.numel() - 1)
    low = math.floor(place)
    below, above = float(ascending[low]), float(ascending[math.ceil(place)])
    return below + (place - low) * (above - below)


def require_positive(predicted: torch.Tensor, scored: torch.Tensor) -> None:
    """Raise where most answers are negative: those of another sign convention.

    Args:
        predicted: (h, w) float, px.
        scored: (h, w) bool.

    Raises:
        EvaluationError: If more than half of the answers are below 0.
    """
    answers = predicted[scored]
    answers = answers[answers.isfinite()]
    negative = int((answers < 0).sum())
    if 2 * negative > answers.numel():
        raise EvaluationError(
            f"{negative} of {answers.numel()} disparities are negative, and here disparity is "
            "positive: x_right = x_left - disparity. RAFT-Stereo and its followers return the "
            "flow, whose sign is the other one: pass -flow."
        )


class DisparityError:
    """The errors of a network's disparity over the frames of a validation.

    Every measure is computed for each frame, and then averaged over frames; a frame without a
    number (no pixel of a region, no answer) is left out of that mean. So it equals the report of
    `evaluate_disparity` where all scenes have as many frames, and pairs: there frames are averaged
    within a pair, pairs within a scene, and then scenes. Sums are float64. With
    ``torch.distributed``, `compute` adds those of all ranks in one ``all_reduce``, which every rank
    has to call.

    >>> error = DisparityError()
    >>> truth = torch.tensor([[10.0, 20.0], [30.0, 40.0]])
    >>> error.update(truth + torch.tensor([[0.0, 1.0], [2.0, 9.0]]), truth, truth > 0)
    >>> found = error.compute()
    >>> found["epe"], found["bad_1"], found["d1"]
    (3.0, 0.5, 0.25)
    """

    def __init__(self, *, max_disparity_px: float | None = None) -> None:
        """Begin with no frame.

        Args:
            max_disparity_px: Pixels whose true disparity is this or more are not scored.
        """
        self.max_disparity_px = max_disparity_px
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._sums, self._counts = np.zeros((2, len(COLUMNS_OF_FRAMES)))
        self._frames = 0

    @torch.no_grad()
    def update(
        self,
        predicted: torch.Tensor,
        truth: torch.Tensor,
        valid: torch.Tensor,
        visible: torch.Tensor | None = None,
    ) -> None:
        """Add frames.

        Args:
            predicted: (n, 1, h, w), (n, h, w) or (h, w) float, px; nan or inf: no answer.
            truth: As many frames, px: the field ``disparity`` of a batch.
            valid: As many frames, bool: the field ``valid``.
            visible: As many frames, bool: the field ``visible``; without it visible and occluded
                pixels are not told apart.

        Raises:
            EvaluationError: If the shapes differ, or most answers are negative.
        """
        given = {"predicted": predicted, "truth": truth, "valid": valid}
        given |= {} if visible is None else {"visible": visible}
        frames = {name: _frames(name, value) for name, value in given.items()}
        shapes = {name: tuple(each.shape) for name, each in frames.items()}
        if len(set(shapes.values())) > 1:
            told = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise EvaluationError(f"the maps have different shapes as (frames, h, w): {told}.")
        for maps in zip(*frames.values(), strict=True):
            scores = frame_scores(*maps, max_disparity_px=self.max_disparity_px)
            numbers = np.array([scores.get(name, math.nan) for name in COLUMNS_OF_FRAMES])
            self._sums += np.where(np.isfinite(numbers), numbers, 0)
            self._counts += np.isfinite(numbers)
            self._frames += 1

    def compute(self) -> dict[str, float]:
        """Return the mean of every measure over all frames of all ranks; nan where none has one.

        Keys are the measures; with ``visible`` also those of each region (``epe_visible``,
        ``epe_occluded``); by ranges of the true disparity (``epe_[16,32)``); ``beyond``, the share
        of valid pixels that ``max_disparity_px`` leaves out; and ``frames``, how many there were.
        """
        packed = torch.from_numpy(np.concatenate([self._sums, self._counts, [self._frames]]))
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            is_nccl = torch.distributed.get_backend() == "nccl"
            where = torch.device("cuda", torch.cuda.current_device()) if is_nccl else "cpu"
            packed = packed.to(where)
            torch.distributed.all_reduce(packed)
        *numbers, frames = packed.tolist()
        sums, counts = np.reshape(numbers, (2, -1))
        means = np.divide(sums, counts, out=np.full_like(sums, math.nan), where=counts > 0)
        return dict(zip(COLUMNS_OF_FRAMES, means.tolist(), strict=True)) | {"frames": frames}


def _frames(name: str, maps: torch.Tensor) -> torch.Tensor:
    """Return maps as (n, h, w)."""
    if maps.dim() == 4 and maps.shape[1] == 1:
        maps = maps[:, 0]
    if maps.dim() == 2:
        maps = maps[None]
    if maps.dim() != 3:
        raise EvaluationError(
            f"{name} has the shape {tuple(maps.shape)}; expected (n, 1, h, w), (n, h, w) or (h, w)."
        )
    return maps.cpu() if maps.device.type == "mps" else maps  # which has no float64


COLUMNS_OF_FRAMES: Final = (
    *MEASURES,
    *(f"{name}_{region}" for region in REGIONS for name in MEASURES),
    *(f"{name}_{part}" for part in RANGES_PX for name in MEASURES),
    "beyond",
)
"""The columns of a frame: of all pixels, of a region, of a range of the true disparity, and the
share of valid pixels that are not scored."""


def frame_scores(
    predicted: torch.Tensor,
    truth: torch.Tensor,
    valid: torch.Tensor,
    visible: torch.Tensor | None = None,
    *,
    max_disparity_px: float | None,
) -> dict[str, float]:
    """Return the columns of one frame (`COLUMNS_OF_FRAMES`).

    Args:
        predicted: (h, w) float, px; nan or inf where there is no answer.
        truth: (h, w) float, px.
        valid: (h, w) bool, where the truth is known.
        visible: (h, w) bool, what the right camera sees; None where that is not known.
        max_disparity_px: Pixels whose true disparity is this or more are not scored.

    Raises:
        EvaluationError: If most answers are negative.
    """
    valid = valid.bool()
    scored = valid if max_disparity_px is None else valid & (truth < max_disparity_px)
    require_positive(predicted, scored)
    true = truth[scored].double()
    errors = (predicted[scored].double() - true).abs()
    errors, order = torch.where(errors.isfinite(), errors, math.inf).sort()
    true = true[order]
    scores = measures_of(errors, true)
    parts = {name: (true >= low) & (true < high) for name, (low, high) in RANGES_PX.items()}
    if visible is not None:
        is_seen = visible.bool()[scored][order]
        parts |= {"visible": is_seen, "occluded": ~is_seen}
    for part, inside in parts.items():
        found = measures_of(errors[inside], true[inside])
        scores |= {f"{name}_{part}": number for name, number in found.items()}
    count = int(valid.sum())
    scores["beyond"] = 1 - int(scored.sum()) / count if count else math.nan
    return scores
