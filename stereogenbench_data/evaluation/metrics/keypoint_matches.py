"""E_match: how much the set of left keypoints matched in the right picture changes."""

import math
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


class MatchedOnce:
    """A matcher that detects the keypoints of one and the same array once, and matches two once."""

    def __init__(self, matcher: KeypointMatcher) -> None:
        """Take the matcher."""
        self._matcher = matcher
        self._keypoints: dict[int, tuple[Picture, Keypoints]] = {}
        self._matched: dict[tuple[int, int], Bool[np.ndarray, " n"]] = {}

    def matched(self, left: Picture, right: Picture) -> Bool[np.ndarray, " n"]:
        """Return which keypoints of a left picture are in nearly the same row of a right one."""
        place = id(left), id(right)
        if place not in self._matched:
            ours, theirs = self._detected(left), self._detected(right)
            pairs = self._matcher.match(ours, theirs)
            rows_apart = np.abs(ours.xy_px[pairs[:, 0], 1] - theirs.xy_px[pairs[:, 1], 1])
            self._matched[place] = np.zeros(len(ours.xy_px), dtype=bool)
            self._matched[place][pairs[rows_apart <= EPIPOLAR_PX, 0]] = True
        return self._matched[place]

    def _detected(self, picture: Picture) -> Keypoints:
        if id(picture) not in self._keypoints:
            # The picture is kept too, so that no other takes its identity.
            self._keypoints[id(picture)] = picture, self._matcher.detect(picture)
        return self._keypoints[id(picture)][1]


def match_error(
    predicted: Picture, *, left: Picture, target: Picture, matcher: MatchedOnce
) -> dict[str, float]:
    """Return E_match of a predicted right picture: how other its matches are than the target's.

    The left keypoints are detected once, so the two sets that are compared are of the same
    keypoints.

    Returns:
        e_match: 100 (1 - common / union), in percent; nan if neither right picture has a match.
        keypoints: How many keypoints the left picture has.
        target_matches: How many of them are found again in the target.
        predicted_matches: How many of them are found again in the prediction.
        common_matches: How many in both.
    """
    in_target, in_prediction = (matcher.matched(left, right) for right in (target, predicted))
    common = int(np.count_nonzero(in_prediction & in_target))
    union = int(np.count_nonzero(in_prediction | in_target))
    return {
        "e_match": 100 * (1 - common / union) if union else math.nan,
        "keypoints": len(in_target),
        "target_matches": int(np.count_nonzero(in_target)),
        "predicted_matches": int(np.count_nonzero(in_prediction)),
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
    return torch.stack([here, forward], dim=1)[mutual].numpy()


def _nearest(squared: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return which column is nearest to each row, and whether it passes the ratio test."""
    nearest, index = squared.clamp(min=0).topk(2, dim=1, largest=False)
    clear = (nearest[:, 0] <= RATIO**2 * nearest[:, 1]) & (nearest[:, 1] > 0)
    return index[:, 0], clear
