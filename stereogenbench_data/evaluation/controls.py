"""Calibration controls: right views with predictable scores, which give the metrics a scale.

They are the rendered target, the left view itself, the same scene from the wrong camera, and the
right view of another scene. All are scored together, so each view is decoded once.

Source: the StereoGenBench paper, appendix on metric definitions and calibration controls.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.evaluate import (
    EVALUATION_DEFAULTS,
    EvaluationOptions,
    score_pairs,
    select_pairs,
)
from stereogenbench_data.evaluation.predictions import PairFrames, Read, open_frames
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.evaluation.scene_scores import Run, fields_of
from stereogenbench_data.evaluation.tables import CONTROL, Scores
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.signatures import list_options

TARGET: Final = "rendered target"
COPIED_LEFT: Final = "copied left"
WRONG_BASELINE: Final = "wrong baseline"
RANDOM_RIGHT: Final = "random right"
CONTROLS: Final = (TARGET, COPIED_LEFT, WRONG_BASELINE, RANDOM_RIGHT)
"""Names as in the paper's table of controls."""


@dataclass(frozen=True, slots=True)
class Control:
    """A source of right views that are frames of another place.

    Attributes:
        name: Which control it is.
        size: (height, width) that is scored.
        donors: For each scene, another one that stands in for it.
        inputs: Nothing of a sample but both views, which every sample has.
    """

    name: str
    size: tuple[int, int]
    donors: Mapping[str, str]
    inputs: tuple[str, ...] = ()

    def origin(self, wanted: PairFrames) -> tuple[str, int]:
        """Return the scene and the camera that the view of a pair is taken from."""
        left, right = wanted.pair
        return {
            TARGET: (wanted.scene, right),
            COPIED_LEFT: (wanted.scene, left),
            WRONG_BASELINE: (wanted.scene, wrong_camera(left, right)),
            RANDOM_RIGHT: (self.donors[wanted.scene], right),
        }[self.name]

    def stamp(self, wanted: PairFrames) -> str:
        """Return where its views are taken from."""
        scene, camera = self.origin(wanted)
        return f"camera {camera:02d} of {scene}"

    @contextmanager
    def open(self, index: SceneIndex) -> Iterator[Read]:
        """Yield a function that returns the views; a shorter scene's last frame is repeated."""
        rows = {str(key): row for row, key in enumerate(index.column("key"))}
        with open_frames(index, ("right",), size=self.size) as load:

            def read(wanted: PairFrames, samples: Sequence[Sample]) -> list[Any]:
                scene, camera = self.origin(wanted)
                if scene == wanted.scene and camera in wanted.pair:  # The sample has it.
                    view = ("left", "right")[wanted.pair.index(camera)]
                    return [sample[view] for sample in samples]
                row = rows[scene]
                last = int(index.column("frames")[row]) - 1
                frames = (min(int(sample["frame_index"]), last) for sample in samples)
                pair = (0 if camera else 1, camera)
                return [load(row, pair, frame)["right"] for frame in frames]

            yield read


def wrong_camera(left: int, right: int) -> int:
    """Return the camera that stands in for the right one: the next to its right, else to its left.

    >>> wrong_camera(0, 1), wrong_camera(2, 5)
    (2, 4)
    """
    if right + 1 < CAMERA_COUNT:
        return right + 1
    return right - 1 if right - 1 != left else left - 1


def derangement(keys: Sequence[str], *, seed: int) -> dict[str, str]:
    """Map each scene to another one, each taken once: a permutation without a fixed point.

    Sattolo's algorithm: all scenes in one cycle, drawn by the seed.

    Raises:
        EvaluationError: If there are fewer than two scenes.
    """
    if len(keys) < 2:
        raise EvaluationError(
            f"the control '{RANDOM_RIGHT}' needs at least two scenes, {len(keys)} is selected. "
            f"Select more."
        )
    generator = np.random.default_rng(np.random.SeedSequence(seed))
    donors = sorted(keys)
    for place in range(len(donors) - 1, 0, -1):
        other = int(generator.integers(place))
        donors[place], donors[other] = donors[other], donors[place]
    return dict(zip(sorted(keys), donors, strict=True))


@list_options(EVALUATION_DEFAULTS)
def score_controls(
    data: Data,
    *,
    protocol: EvaluationProtocol | None = None,
    seed: int = 0,
    conventions: str | Path | Conventions | None = None,
    **options: Unpack[EvaluationOptions],
) -> list[Scores]:
    """Return the scores of the four controls, in the order of `CONTROLS`.

    Args:
        data: What `StereoPairs` takes.
        protocol: Which metrics and how; the paper's with what needs no weights unless given.
        seed: Decides which scene's right view stands in for which.
        conventions: How the files of a folder are read, as for `StereoPairs`.
        **options: How it is run (`RunOptions`) and what is scored (`Selection`).

    Raises:
        EvaluationError: If there are fewer than two scenes; or as `evaluate`.
    """
    require_options(score_controls, options)
    protocol = protocol or EvaluationProtocol()
    index, scenes = select_pairs(
        data,
        fields_of(protocol),
        protocol,
        options=options,
        conventions=conventions,
    )
    rows = {pairs[0].scene: row for row, pairs in scenes.items()}
    donors = derangement(sorted(rows), seed=seed)
    run = Run(
        index,
        scenes,
        protocol,
        sources=tuple(Control(name, protocol.size, donors) for name in CONTROLS),
        tier=CONTROL,
        donors={rows[scene]: rows[donor] for scene, donor in donors.items()},
        settings={"seed": seed},
    )
    return score_pairs(run, options)
