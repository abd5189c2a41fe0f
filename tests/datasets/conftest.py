"""Samples that cost nothing to load: their keys, which tell them all apart."""

import itertools
import subprocess

import imageio_ffmpeg
import pytest
import torch
from torch.utils.data import default_collate

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.media import depth
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.servers.tools import fork_and as fork_and


@pytest.fixture(scope="session")
def small_index(small_release):
    return SceneIndex.open(small_release)


@pytest.fixture
def keyed(small_index):
    """All adjacent pairs of all frames, 140 samples of 4 scenes, with no field but their key."""
    return StereoPairs(small_index, fields=("__key__",), pairs="adjacent", frames="all")


TRUE_FIELDS = ("left", "disparity", "baseline_m", "frame_index", "__key__")
"""What `truth` has."""


@pytest.fixture(scope="session")
def truth(small_index):
    """Each sample of adjacent pairs by its key, read one by one."""
    pairs = StereoPairs(small_index, fields=TRUE_FIELDS, pairs="adjacent", frames="all")
    return {sample["__key__"]: sample for sample in pairs}


def is_true(batch, truth):
    """Return whether the samples of a batch are those of their keys, bit for bit."""
    expected = default_collate([truth[key] for key in batch["__key__"]])
    return same(batch, {name: expected[name] for name in batch})


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


def ffmpeg(*arguments):
    """Run ffmpeg, which may write over files."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *map(str, arguments)]
    subprocess.run(command, check=True, capture_output=True)


def write_again(path, *codec, source=None, before=()):
    """Write a video anew by options of ffmpeg, from itself or from another one."""
    aside = path.with_name(f"aside{path.suffix}")
    ffmpeg(*before, "-i", source or path, *codec, aside)
    aside.replace(path)


def same(one, other):
    """Return whether two samples or batches with the same fields are equal, bit for bit."""
    assert one.keys() == other.keys()
    return all(
        torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]
        for name, value in one.items()
    )


@pytest.fixture(scope="session")
def drawn(once):
    """A tree of one scene of 17 frames, of which tests alter copies."""
    request = SynthRequest(size_px=72, frames=17, seed=3)
    return once("drawn", lambda root: synthesise(root, request))
