"""E_match: how much the set of left keypoints matched in the right picture changes."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Int64

from stereogenbench_data.evaluation.models.loading import (
    KeypointMatcher,
    Keypoints,
    Picture,
    Settings,
)

EPIPOLAR_PX: Final = 2.0
"""How many rows a match may be off."""
RATIO: Final = 0.9
KEYPOINTS: Final = 2048


@dataclass(frozen=True, slots=True, eq=False)
class TargetMatches:
    """The left keypoints, and which the target shows: the same for all predictions.

    Attributes:
        left: Keypoints of the left picture.
        matched: Which of them are found again in the target.
    """

    left: Keypoints
    matched: Bool[np.ndarray, " n"]


def target_matches(left: Picture, target: Picture, *, matcher: KeypointMatcher) -> TargetMatches:
    """Return the left keypoints and which of them the rendered target shows.

    The left keypoints are detected once, so the two sets that E_match compares are of the same
    keypoints.
    """
    keypoints = matcher.detect(left)
    return TargetMatches(keypoints, _matched(keypoints, target, matcher=matcher))


def match_error(
    predicted: Picture, *, against: TargetMatches, matcher: KeypointMatcher
) -> dict[str, float]:
    """Return E_match of a predicted right picture, by the matcher that matched the target.

    Returns:
        e_match: 100 (1 - common / union), in percent; nan if neither right picture has a match.
        keypoints: How many keypoints the left picture has.
        target_matches: How many of them are found again in the target.
        predicted_matches: How many of them are found again in the prediction.
        common_matches: How many in both.
    """
    matched = _matched(against.left, predicted, matcher=matcher)
    common = int(np.count_nonzero(matched & against.matched))
    union = int(np.count_nonzero(matched | against.matched))
    return {
        "e_match": 100 * (1 - common / union) if union else math.nan,
        "keypoints": len(matched),
        "target_matches": int(np.count_nonzero(against.matched)),
        "predicted_matches": int(np.count_nonzero(matched)),
        "common_matches": common,
    }


def match_settings(matcher: KeypointMatcher) -> Settings:
    """Return every choice that E_match depends on."""
    return {
        "matcher": matcher.name,
        "epipolar_px": EPIPOLAR_PX,
        "element": "a keypoint of the left picture, detected once",
        **matcher.settings,
    }


def mutual_matches(left: Keypoints, right: Keypoints) -> Int64[np.ndarray, "m 2"]:
    """Return mutual nearest neighbours that pass the ratio test in both directions.

    The distance of descriptors to the nearest must be at most 0.9 times that to the second
    nearest. Same as kornia's match_smnn, in float64.

    Returns:
        Pairs (left, right), the left ascending; none where a side has fewer than two keypoints
        and so no second nearest.
    """
    if min(len(left.xy_px), len(right.xy_px)) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    one, two = (
        torch.from_numpy(np.asarray(side.descriptors, dtype=np.float64)) for side in (left, right)
    )
    squared = (one @ two.T).mul_(-2)
    squared += (one**2).sum(dim=1)[:, None]
    squared += (two**2).sum(dim=1)
    forward, clear = _nearest(squared)
    backward, clear_back = _nearest(squared.T.contiguous())
    here = torch.arange(len(one))
    mutual = clear & clear_back[forward] & (backward[forward] == here)
    pairs: Int64[np.ndarray, "m 2"] = torch.stack([here, forward], dim=1)[mutual].numpy()
    return pairs


def _nearest(squared: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return which column is nearest to each row, and whether it passes the ratio test."""
    nearest, index = squared.clamp(min=0).topk(2, dim=1, largest=False)
    clear = (nearest[:, 0] <= RATIO**2 * nearest[:, 1]) & (nearest[:, 1] > 0)
    return index[:, 0], clear


def _matched(
    left: Keypoints, right: Picture, *, matcher: KeypointMatcher
) -> Bool[np.ndarray, " n"]:
    """Return which left keypoints are found again in nearly the same row of a right picture."""
    found = matcher.detect(right)
    pairs = matcher.match(left, found)
    rows_apart = np.abs(left.xy_px[pairs[:, 0], 1] - found.xy_px[pairs[:, 1], 1])
    matched = np.zeros(len(left.xy_px), dtype=bool)
    matched[pairs[rows_apart <= EPIPOLAR_PX, 0]] = True
    return matched
