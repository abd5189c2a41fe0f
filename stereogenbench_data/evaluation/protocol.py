"""The protocol: what methods of a tier are given, and every choice that scores depend on.

Scores of different inference tiers answer different questions, so they are never ranked together.

Source: the StereoGenBench paper, section "Benchmark Protocol" and its appendix on inference
conditions.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, Literal

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.columns import (
    COLUMNS,
    MATCHERS,
    OFFLINE_METRICS,
    require_metrics,
)
from stereogenbench_data.samples.fields import require_size
from stereogenbench_data.schema.records import DepthEncoding

PROTOCOL_VERSION: Final = 2
"""Raised whenever the same right views get other scores under the same settings."""

PAPER_SIZE: Final = (480, 832)
"""(height, width) at which the paper's frame-wise metrics are computed."""


@dataclass(frozen=True, slots=True)
class Tier:
    """One inference condition of the paper.

    Attributes:
        name: "G0", "G1" or "G2".
        meaning: What the tier measures.
        inputs: The fields of a sample (`PAIR_FIELDS`) that a method is given.
    """

    name: Literal["G0", "G1", "G2"]
    meaning: str
    inputs: tuple[str, ...]


TIERS: Final[dict[str, Tier]] = {
    "G0": Tier(
        "G0",
        "oracle geometry: rendering and inpainting under known target geometry",
        ("left", "disparity", "warped_right", "hole"),
    ),
    "G1": Tier(
        "G1",
        "calibrated target camera: no depth or disparity",
        ("left", "baseline_m", "intrinsics"),
    ),
    "G2": Tier("G2", "unaligned monocular: the left view alone", ("left",)),
}


def require_tier(name: object) -> Tier:
    """Return a tier by its name.

    Raises:
        EvaluationError: If there is no such tier.
    """
    if not isinstance(name, str) or name not in TIERS:
        known = "; ".join(f"{tier.name} ({tier.meaning})" for tier in TIERS.values())
        raise EvaluationError(f"there is no tier {name!r}: choose one of {known}.")
    return TIERS[name]


@dataclass(frozen=True, slots=True)
class DisparityProtocol:
    """How disparity is scored.

    Attributes:
        size: (height, width) in pixels at which it is; None: at the stored size of the scenes.
        max_disparity_px: Pixels whose true disparity is this or more are left out, and counted in
            the column "beyond"; None scores all.
        depth: A depth encoding instead of the one that files and release state.
        batch_frames: How many frames a callable is given at a time.
    """

    size: tuple[int, int] | None = None
    max_disparity_px: float | None = None
    depth: DepthEncoding | None = None
    batch_frames: int = 8
    plotted: ClassVar[tuple[str, ...]] = ("epe", "bad_2", "d1")
    """The columns that are drawn against the baseline."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.size is not None:
            object.__setattr__(self, "size", require_size(self.size))
        if self.max_disparity_px is not None and not self.max_disparity_px > 0:
            raise EvaluationError(
                f"max_disparity_px must be above 0, got {self.max_disparity_px!r}."
            )
        if self.batch_frames < 1:
            raise EvaluationError(f"batch_frames must be at least 1, got {self.batch_frames}.")

    def label(self, column: str) -> str:
        """Return what tables call a column."""
        return COLUMNS[column].label


@dataclass(frozen=True, slots=True)
class EvaluationProtocol:
    """What is computed and how.

    Attributes:
        metrics: Names of `METRICS`.
        size: (height, width) in pixels at which everything is scored.
        keypoint_matcher: What finds the matches of E_match: "sift", or a model of your own
            (`models.loading`).
        stereo_matcher: What finds the disparity of SD: "sgbm", or a model of your own.
        depth: A depth encoding instead of the one that files and release state.
        device: Where learned models run, as torch names it.
        weights: The folder of their weights; None for that of torch.hub's checkpoints.
        batch_frames: How many frames are held, and given to learned parts, at a time.
    """

    metrics: tuple[str, ...] = OFFLINE_METRICS
    size: tuple[int, int] = PAPER_SIZE
    keypoint_matcher: str = "sift"
    stereo_matcher: str = "sgbm"
    depth: DepthEncoding | None = None
    device: str = "cpu"
    weights: Path | None = None
    batch_frames: int = 8

    def __post_init__(self) -> None:
        """Put the metrics in order and check the values."""
        object.__setattr__(self, "metrics", require_metrics(self.metrics))
        object.__setattr__(self, "size", require_size(self.size))
        if self.batch_frames < 1:
            raise EvaluationError(f"batch_frames must be at least 1, got {self.batch_frames}.")

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of every frame, in the order of `COLUMNS`."""
        return tuple(name for name, each in COLUMNS.items() if each.metric in self.metrics)

    @property
    def plotted(self) -> tuple[str, ...]:
        """The columns that are drawn against the baseline."""
        return tuple(name for name in self.columns if COLUMNS[name].better != "neither")

    def label(self, column: str) -> str:
        """Return what tables call a column: with the backend, of a model of one's own its class."""
        known = COLUMNS[column]
        if known.metric not in MATCHERS:
            return known.label
        name: str = getattr(self, MATCHERS[known.metric])
        return f"{known.label} ({name.rpartition(':')[2]})"
