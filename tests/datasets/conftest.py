"""Samples that cost nothing to load: their keys, which tell them all apart."""

import itertools

import pytest
import torch

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.media import depth
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest


@pytest.fixture(scope="session")
def small_index(small_release):
    return SceneIndex.open(small_release)


@pytest.fixture
def keyed(small_index):
    """All adjacent pairs of all frames, 140 samples of 4 scenes, with no field but their key."""
    return StereoPairs(small_index, fields=("__key__",), pairs="adjacent", frames="all")


@pytest.fixture
def read(monkeypatch):
    """The frames that are read by each reader that is opened: (name of the video, frames)."""
    opened = []

    class Recording(depth.VideoReader):
        def __init__(self, file, *, name, **options):
            super().__init__(file, name=name, **options)
            self.read = []
            opened.append((name, self.read))

        def frame(self, index):
            self.read.append(index)
            return super().frame(index)

    monkeypatch.setattr(depth, "VideoReader", Recording)
    return opened


def keys_of(batches):
    """Return the keys of each batch."""
    return [batch["__key__"] for batch in batches]


def flat(batches):
    """Return what the batches hold, as one list."""
    return list(itertools.chain.from_iterable(batches))


def in_turn(shares):
    """Return the batches of all ranks in the order of the training steps."""
    rows = itertools.zip_longest(*shares)
    return [batch for row in rows for batch in row if batch is not None]


def same(one, other):
    """Return whether two samples or batches with the same fields are equal, bit for bit."""
    assert one.keys() == other.keys()
    return all(
        torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]
        for name, value in one.items()
    )


class RefuseFrame:
    """A transform that fails at a frame."""

    swaps_views = False

    def __init__(self, number):
        self.number = number

    def __call__(self, views, generator):
        if self.number in views.frames:
            raise ArithmeticError(f"frame {self.number}")
        return views


@pytest.fixture(scope="session")
def drawn(tmp_path_factory):
    """A tree of one scene of 17 frames, of which tests alter copies."""
    root = tmp_path_factory.mktemp("drawn") / "scenes"
    synthesise(root, SynthRequest(size_px=72, frames=17, seed=3), workers=1)
    return root
