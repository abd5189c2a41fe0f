"""What all tests share: the material that stands beside the project, where it is at hand."""

from pathlib import Path

import pytest

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
