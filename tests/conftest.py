"""Fixtures of all tests: drawn scenes, the shared material beside the project, and usual signals.

If the material is missing, pytest's first and last lines say so. In CI its tests then fail, unless
SHARED_MATERIAL=none says that it is not available.
"""

import gc
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.servers.tools import Once

pytest_plugins = ("tests.servers.fixtures", "tests.servers.scene_fixtures")

os.environ[CACHE_VARIABLE] = "off"  # no test leaves anything in the user's cache

# An example may take long where other work takes the processor.
settings.register_profile("tests", deadline=None)
settings.load_profile("tests")

SHARED = Path(__file__).resolve().parents[2] / "shared"


MATERIAL = ("scenes", "ground_truth")
_CURE = f"put it at {SHARED}: without it no test compares with data from elsewhere"


def _missing_material() -> list[str]:
    return [name for name in MATERIAL if not (SHARED / name).is_dir()]


def _is_ci() -> bool:
    return os.environ.get("CI", "").lower() not in ("", "0", "false", "no")


def pytest_report_header() -> str:
    """Print at the start whether the shared material exists."""
    missing = _missing_material()
    if not missing:
        return f"shared material: {SHARED}"
    return f"shared material: {' and '.join(missing)} MISSING: {_CURE}"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print at the end which tests did not run without it."""
    missing = _missing_material()
    if missing:
        terminalreporter.write_sep("!", "shared material is missing", red=True, bold=True)
        terminalreporter.write_line(
            f"Tests with {' and '.join(missing)} did not run: {_CURE}.", red=True
        )


def pytest_collection_finish() -> None:
    """Leave all that was imported to no later garbage collection, which forks would copy it for."""
    gc.collect()
    gc.freeze()


def _shared_folder(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        reason = f"needs {name} beside the project: {_CURE}"
        is_needed = _is_ci() and os.environ.get("SHARED_MATERIAL") != "none"
        pytest.fail(reason) if is_needed else pytest.skip(reason)
    return folder


@pytest.fixture
def usual_signals() -> Iterator[None]:
    """Let commands that a test starts handle Ctrl-C and SIGTERM as in a terminal.

    Background jobs of a script ignore Ctrl-C, and their children inherit that.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """The root of a tree in the released layout with one scene that was rendered elsewhere."""
    return _shared_folder("scenes")


@pytest.fixture(scope="session")
def ground_truth() -> Path:
    """Middlebury pictures with measured disparities."""
    return _shared_folder("ground_truth")


@pytest.fixture(scope="session")
def small_release(once: Once) -> Path:
    """A tree of small scenes in the released layout: two families in train, one in eval.

    Of those seeds each family has a scene with sky, whose depth is not measured.
    """

    def make(root: Path) -> None:
        for request in (
            SynthRequest(family="IPD_Gaussian", scenes=1, size_px=64, frames=7, seed=2),
            SynthRequest(family="Uniform", scenes=2, size_px=64, frames=7, seed=13),
            SynthRequest(
                family="Uniform", scenes=1, size_px=64, frames=7, seed=6, split="eval",
                subset="seen_map",
            ),
        ):  # fmt: skip
            synthesise(root, request, workers=1)

    return once("small_release", make)


@pytest.fixture(scope="session")
def indexed_release(small_release: Path, once: Once) -> Path:
    """The same tree with an index, which opens at once, for tests that only read it."""

    def make(root: Path) -> None:
        shutil.copytree(small_release, root, copy_function=os.link)
        SceneIndex.open(root).write(root / INDEX_NAME)

    return once("indexed_release", make)


@pytest.fixture(scope="session")
def detailed_release(once: Once) -> Path:
    """A tree with one scene of 160 x 160 pixels, large enough for textures to warp well."""
    request = SynthRequest(family="IPD_Gaussian", scenes=1, size_px=160, frames=2, seed=6)
    return once("detailed_release", lambda root: synthesise(root, request))
