"""The benchmark's data, tiny: four scenes of 64 px and four frames."""

import pytest

from benchmarks.material import Material, prepared


@pytest.fixture(scope="session")
def material(tmp_path_factory) -> Material:
    """Everything that a race reads."""
    root = tmp_path_factory.mktemp("bench")
    wanted = Material(root, size_px=64, frames=4, scenes=40)
    return prepared(wanted, report=lambda _: None, workers=1)
