"""Small scenes to be scored, and right views of them on disk."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage.metrics import structural_similarity

from stereogenbench_data import evaluate
from stereogenbench_data.evaluation.predictions import frame_name, item_name, open_frames
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.evaluation.tables import Scores
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

FRAMES = 4
SIZE = (48, 64)
QUICK = EvaluationProtocol(metrics=("psnr",), size=SIZE)


@pytest.fixture(scope="session")
def scored_index(once) -> SceneIndex:
    """Three scenes of eval, two families and both subsets, 64 px and 4 frames."""

    def make(root: Path) -> None:
        for family, scenes, subset in (
            ("Uniform", 2, "seen_map"),
            ("IPD_Gaussian", 1, "unseen_map"),
        ):
            request = SynthRequest(
                family=family, scenes=scenes, size_px=64, frames=FRAMES, seed=7, split="eval",
                subset=subset, map_name="SynthYard" if subset == "unseen_map" else "SynthStage",
            )  # fmt: skip
            synthesise(root, request, workers=1)

    return SceneIndex.open(once("scored_scenes", make))


@pytest.fixture
def protocol() -> EvaluationProtocol:
    """Metrics that 64 px suffice for."""
    return EvaluationProtocol(metrics=("psnr", "ssim", "p_psnr"), size=SIZE, batch_frames=3)


def rendered(index: SceneIndex, scene: str, camera: int, frame: int, *, size=SIZE) -> np.ndarray:
    """Return a view as it is scored, uint8 (3, h, w)."""
    row = list(index.column("key")).index(scene)
    with open_frames(index, ("right",), size=size) as load:
        return load(row, (0 if camera else 1, camera), frame)["right"]


def write_pngs(folder: Path, index: SceneIndex, *, camera=1, size=SIZE, frames=range(FRAMES)):
    """Write a camera's views of every scene as predictions of the pair (0, 1)."""
    for scene in index.column("key"):
        target = folder / item_name(scene, (0, 1))
        target.mkdir(parents=True)
        for frame in frames:
            view = rendered(index, scene, camera, frame, size=size)
            Image.fromarray(view.transpose(1, 2, 0)).save(target / frame_name(frame))
    return folder


def scored(index, predictions, protocol, **options) -> Scores:
    """Return the scores of predictions, of tier G1 and in this process unless told otherwise."""
    options = {"tier": "G1", "workers": 1} | options
    return evaluate(index, predictions, protocol=protocol, **options)


def numbers(scores):
    """Return all that was scored as text that is equal only for equal last digits."""
    return [
        (pair.scene, pair.pair, pair.problem, repr(sorted(pair.tallies.items())))
        for pair in scores.pairs
    ]


def true_ssim(one: np.ndarray, two: np.ndarray) -> float:
    """Return the SSIM of two pictures (3, h, w) by scikit-image."""
    return structural_similarity(
        one, two, data_range=255, channel_axis=0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False,
    )  # fmt: skip


def photograph(path: Path) -> np.ndarray:
    """Return a picture of a file, uint8 (3, h, w)."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).transpose(2, 0, 1)


@pytest.fixture(scope="session")
def right_views(scored_index, once) -> Path:
    """The rendered right views of all scenes as predictions; not to be changed."""
    return once("right_views", lambda folder: write_pngs(folder, scored_index))


@pytest.fixture(scope="session")
def other_views(scored_index, once) -> Path:
    """The views of camera 2 as predictions of camera 1; not to be changed."""
    return once("other_views", lambda folder: write_pngs(folder, scored_index, camera=2))
