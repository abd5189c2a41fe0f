"""What all tests share: the material that stands beside the project, where it is at hand."""

from pathlib import Path

import pytest

from stereogenbench_data.synthesis import SynthRequest, synthesise

pytest_plugins = ("tests.servers.fixtures",)

SHARED = Path(__file__).resolve().parents[2] / "shared"


def _shared_folder(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"needs {name}, which stands beside the project and is not at hand here")
    return folder


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """The root of a released-layout tree with one scene that was rendered elsewhere."""
    return _shared_folder("scenes")


@pytest.fixture(scope="session")
def ground_truth() -> Path:
    """Middlebury pictures with measured disparities."""
    return _shared_folder("ground_truth")


@pytest.fixture(scope="session")
def small_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A released-layout tree of small scenes: two families in train, both eval subsets."""
    root = tmp_path_factory.mktemp("release")
    for request in (
        SynthRequest(family="IPD_Gaussian", scenes=1, size_px=64, frames=7, seed=1),
        SynthRequest(family="Uniform", scenes=2, size_px=64, frames=7, seed=2),
        SynthRequest(
            family="Uniform", scenes=1, size_px=64, frames=7, seed=3, split="eval",
            subset="seen_map",
        ),
    ):  # fmt: skip
        synthesise(root, request, workers=1)
    return root


@pytest.fixture(scope="session")
def detailed_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree with one scene of 160 x 160 pixels, large enough for textures to warp well."""
    root = tmp_path_factory.mktemp("detailed")
    synthesise(root, SynthRequest(family="IPD_Gaussian", scenes=1, size_px=160, frames=2, seed=4))
    return root
