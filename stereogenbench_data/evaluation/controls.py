"""Calibration controls: right views whose scores are known in kind, which give the metrics a scale.

The rendered target, the left view itself, the same scene from the wrong camera, and the right view
of another scene. They are no methods, and are scored together: each view is decoded once.

Source: the StereoGenBench paper, appendix on metric definitions and calibration controls.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Unpack

import numpy as np

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import LOCAL
from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.evaluate import EvaluationOptions, scored, selected
from stereogenbench_data.evaluation.predictions import Wanted
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.evaluation.results import CONTROL, Scores
from stereogenbench_data.evaluation.running import Run
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.load import Request, Sample, SampleLoader
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.plan import Address

TARGET: Final = "rendered target"
COPIED_LEFT: Final = "copied left"
WRONG_BASELINE: Final = "wrong baseline"
RANDOM_RIGHT: Final = "random right"
CONTROLS: Final = (TARGET, COPIED_LEFT, WRONG_BASELINE, RANDOM_RIGHT)
"""Names as in the package's table of the paper's controls."""


@dataclass(frozen=True, slots=True)
class SameFrame:
    """A control that is a view of the sample itself.

    Attributes:
        name: What tables call it.
        view: "right" or "left".
        inputs: The view.
    """

    name: str
    view: str

    @property
    def inputs(self) -> tuple[str, ...]:
        """The view."""
        return (self.view,)

    def stamp(self, wanted: Wanted) -> str:
        """Return what it is."""
        return f"its {self.view} view"

    def open(self, index: SceneIndex) -> "SameFrame":
        """Begin with a scene."""
        return self

    def read(self, wanted: Wanted, samples: Sequence[Sample]) -> list[Any]:
        """Return the view of each sample."""
        return [sample[self.view] for sample in samples]

    def close(self) -> None:
        """Nothing is kept open."""


@dataclass(frozen=True, slots=True)
class OtherView:
    """A control that is the same frame of another camera, or of another scene's right camera.

    Attributes:
        name: What tables call it.
        size: (height, width) that is scored.
        donors: For each scene, the scene that its views are taken from; none for the same one.
        inputs: Nothing of a sample.
    """

    name: str
    size: tuple[int, int]
    donors: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[str, ...] = ()

    def source(self, wanted: Wanted) -> tuple[str, int]:
        """Return the scene and the camera that the view of a pair is taken from."""
        if self.donors:
            return self.donors[wanted.scene], wanted.pair[1]
        return wanted.scene, wrong_camera(*wanted.pair)

    def stamp(self, wanted: Wanted) -> str:
        """Return where its views are taken from."""
        scene, camera = self.source(wanted)
        return f"camera {camera:02d} of {scene}"

    def open(self, index: SceneIndex) -> "_OtherViews":
        """Begin with a scene."""
        return _OtherViews(self, index)


class _OtherViews:
    def __init__(self, control: OtherView, index: SceneIndex) -> None:
        self._control = control
        self._index = index
        self._rows = {str(key): row for row, key in enumerate(index.column("key"))}
        request = Request(kind="pairs", fields=("right",), layout="single", size=control.size)
        self._loader = SampleLoader(index, request)

    def read(self, wanted: Wanted, samples: Sequence[Sample]) -> list[Any]:
        scene, camera = self._control.source(wanted)
        row = self._rows[scene]
        last = int(self._index.column("frames")[row]) - 1
        views = []
        for sample in samples:
            frame = min(int(sample["frame_index"]), last)
            address = Address(row, _another(camera), (camera,), (frame,))
            loaded = self._loader.load(address, clip="frame", generator=np.random.default_rng(0))
            views.append(loaded["right"])
        return views

    def close(self) -> None:
        self._loader.close()


def _another(camera: int) -> int:
    return 0 if camera else 1


def wrong_camera(left: int, right: int) -> int:
    """Return the camera that stands in for the right one: the next to its right, else to its left.

    >>> wrong_camera(0, 1), wrong_camera(2, 5)
    (2, 4)
    """
    if right + 1 < CAMERA_COUNT:
        return right + 1
    return right - 1 if right - 1 != left else left - 1


def derangement(keys: Sequence[str], *, seed: int) -> dict[str, str]:
    """Return for each scene another one, each taken once: a permutation without a fixed point.

    Sattolo's algorithm: all scenes in one cycle, drawn by the seed.

    Raises:
        EvaluationError: If there are fewer than two scenes.
    """
    if len(keys) < 2:
        raise EvaluationError(
            f"the control '{RANDOM_RIGHT}' takes its views from another scene, and {len(keys)} is "
            f"selected: select two or more."
        )
    generator = np.random.default_rng(np.random.SeedSequence(seed))
    donors = sorted(keys)
    for place in range(len(donors) - 1, 0, -1):
        other = int(generator.integers(place))
        donors[place], donors[other] = donors[other], donors[place]
    return dict(zip(sorted(keys), donors, strict=True))


def score_controls(
    data: Data,
    *,
    protocol: EvaluationProtocol | None = None,
    seed: int = 0,
    **options: Unpack[EvaluationOptions],
) -> list[Scores]:
    """Return the scores of the four controls, in the order of `CONTROLS`.

    Args:
        data: What `StereoPairs` takes.
        protocol: Which metrics and how; the paper's with what needs no weights unless given.
        seed: Decides which scene's right view stands in for which.
        **options: How it is run (`RunOptions`) and what is scored (`Selection`).

    Raises:
        EvaluationError: If there are fewer than two scenes; or as `evaluate`.
    """
    protocol = protocol or EvaluationProtocol()
    extent = selected(data, protocol, inputs=(), options=options)
    donors = derangement([pairs[0].scene for pairs in extent.wanted], seed=seed)
    run = Run(
        protocol=protocol,
        candidates=(
            SameFrame(TARGET, "right"),
            SameFrame(COPIED_LEFT, "left"),
            OtherView(WRONG_BASELINE, protocol.size),
            OtherView(RANDOM_RIGHT, protocol.size, donors=donors),
        ),
        workers=options.get("workers"),
        engine=options.get("engine", LOCAL),
        beside=donors,
    )
    return scored(extent, run, options=options, tier=CONTROL, about={"seed": seed})
