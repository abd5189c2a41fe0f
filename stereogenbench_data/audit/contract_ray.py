"""Planar or ray depth, told by shape: with which power of the ray's length disparity grows.

The two differ by a few per cent towards the corners, and less behind a long lens. Their scores in
dB then hardly differ, and a unit that is a little off makes up for most of it. The power is fitted
beside the scale, so no unit can stand in for it: 0 is depth along the optical axis, 1 along the
ray.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from stereogenbench_data.audit.contract_fit import NEAR_PX, fit_terms, robust_weights, solved
from stereogenbench_data.audit.contract_scoring import Scored, differences
from stereogenbench_data.audit.contract_statistics import LEAST_ERRORS
from stereogenbench_data.audit.contract_views import SceneViews, Shot
from stereogenbench_data.schema.records import DepthKind

_STEPS: Final = 5
_LARGEST_STEP: Final = 0.5
_BIAS: Final = 0.15
"""How far the power may be off however many pixels agree; measured up to 0.19 at long focal."""


@dataclass(frozen=True, slots=True)
class RayPower:
    """The power of the ray's length, and its standard error."""

    power: float
    error: float

    @property
    def kind(self) -> DepthKind | None:
        """What it tells: None where it is unsure, or near neither 0 nor 1."""
        doubt = _BIAS + LEAST_ERRORS * self.error
        if not abs(self.power - 0.5) > doubt:
            return None
        kind: DepthKind = "ray" if self.power > 0.5 else "planar"
        away = self.power - (1 if kind == "ray" else 0)
        return kind if abs(away) <= 2 * _BIAS + LEAST_ERRORS * self.error else None

    @property
    def interval(self) -> tuple[float, float]:
        """The power and half its 95 % interval, what it is off by on any data included."""
        return self.power, math.hypot(1.96 * self.error, _BIAS)


def ray_power(views: SceneViews, shots: Sequence[Shot], contract: Scored) -> RayPower:
    """Return the power that fits a contract's pictures best, scale and its offsets fitted too."""
    terms = fit_terms(views, shots, contract.structure)
    pairs = list(contract.offsets_px)
    log_scale, bend = math.log(contract.scale), 0.0
    offsets_px = dict(contract.offsets_px)
    error = math.inf
    for _ in range(_STEPS):
        normals = np.zeros((len(terms), 2 + len(pairs), 2 + len(pairs)))
        rights = np.zeros((len(terms), 2 + len(pairs)))
        for number, term in enumerate(terms):
            shot = term.shot
            log_ray = np.log(views.ray_per_planar[shot.rows, shot.columns])[term.known]
            grown_px = term.predicted_px * np.exp(log_scale + bend * log_ray)
            full = np.zeros(len(shot.rows))
            full[term.known] = grown_px + shot.shift_px(offsets_px)
            difference, slope, inside = (
                part[term.known] for part in differences(views, shot, full)
            )
            usable = inside & (np.abs(full[term.known] - term.matched_px) < NEAR_PX)
            weight = robust_weights(difference, usable)
            if weight is None:
                continue
            columns = {0: slope * grown_px, 1: slope * grown_px * log_ray}
            if term.pair in offsets_px:
                columns[2 + pairs.index(term.pair)] = term.sign * slope
            for place, column in columns.items():
                rights[number, place] = (column * weight * difference).sum()
                for other, beside in columns.items():
                    normals[number, place, other] = (column * weight * beside).sum()
        step, spread = solved(normals, rights)
        log_scale += float(np.clip(step[0], -0.1, 0.1))
        bend += float(np.clip(step[1], -_LARGEST_STEP, _LARGEST_STEP))
        for pair, change in zip(pairs, step[2:], strict=True):
            offsets_px[pair] += float(np.clip(change, -1.0, 1.0))
        error = float(spread[1])
    return RayPower(bend + (contract.structure.kind == "ray"), error)
