"""Videos with several key frames: what lies between two of them is shuffled by itself."""

import shutil
from collections import defaultdict

import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.selection import plan
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.datasets.conftest import same, write_again

FRAMES = 20
KEY_FRAMES = (0, 8, 16)


def encode_again(path, *, key_every):
    """Encode a video once more, without loss, with a key frame every so many frames."""
    keys = f"keyint={key_every}:min-keyint={key_every}:scenecut=0"
    write_again(path, "-c:v", "libx264", "-qp", 0, "-x264-params", keys)


@pytest.fixture(autouse=True)
def runs_of_eight_frames(monkeypatch):
    """So short runs as these scenes have; scenes of 81 frames have longer ones."""
    monkeypatch.setattr(plan, "LEAST_RUN", 8)


@pytest.fixture(scope="module")
def whole(once):
    request = SynthRequest(map_name="SynthRoom", scenes=2, size_px=48, frames=FRAMES, seed=5)
    return once("without_keys", lambda root: synthesise(root, request))


@pytest.fixture(scope="module")
def keyed_release(whole, once):
    """The same scenes with a key frame every 8 frames."""

    def make(root):
        shutil.copytree(whole, root)
        for path in sorted(root.rglob("*_rgb.mp4")):
            encode_again(path, key_every=8)

    return once("with_keys", make)


def epoch_of(loader):
    """Return the samples of a pass by key."""
    return {
        key: {name: values[place] for name, values in batch.items()}
        for batch in loader
        for place, key in enumerate(batch["__key__"])
    }


FIELDS = ("left", "right", "disparity", "__key__")


def test_the_index_has_the_key_frames_that_all_cameras_share(whole, keyed_release, tmp_path):
    assert SceneIndex.open(whole).scene(0).key_frames == (0,)
    assert SceneIndex.open(keyed_release).scene(0).key_frames == KEY_FRAMES
    copied = shutil.copytree(keyed_release, tmp_path / "copied")
    encode_again(sorted(copied.rglob("cam_03_rgb.mp4"))[0], key_every=4)
    encode_again(sorted(copied.rglob("cam_04_rgb.mp4"))[0], key_every=16)

    assert SceneIndex.open(copied).scene(0).key_frames == (0, 16)


def test_runs_are_shuffled_by_themselves_and_hold_the_right_frames(whole, keyed_release):
    loader = StereoPairs(keyed_release, frames="all", fields=FIELDS).loader(4, drop_last=False)
    expected = StereoPairs(whole, frames="all", fields=FIELDS)
    found = epoch_of(loader)

    assert len(loader.batches.dataset.plan.runs.pairs) == 6 - 2  # 16 to 19 belongs to the run of 8
    assert len(found) == 2 * FRAMES
    assert all(same(found[sample["__key__"]], sample) for sample in expected)


def test_a_run_begins_decoding_at_its_key_frame(keyed_release, read):
    pairs = StereoPairs(keyed_release, frames="all", fields=("left",))
    for _ in pairs.loader(4, drop_last=False, shuffle_groups=1):
        pass

    assert {found[0] for _, found in read if found} <= {*KEY_FRAMES}


@pytest.mark.parametrize("open_frames", [1, 3])
def test_interleaved_frames_of_all_pairs_are_decoded_once(keyed_release, read, open_frames):
    pairs = StereoPairs(keyed_release, frames="all", pairs="all", fields=("left", "right"))
    for _ in pairs.loader(4, drop_last=False, shuffle_groups=1, open_frames=open_frames):
        pass
    frames = defaultdict(list)
    for name, found in read:
        frames[name] += found

    assert len(frames) == 6 * 2
    assert all(sorted(found) == list(range(len(found))) for found in frames.values())


@pytest.mark.parametrize(
    ("selection", "workers"), [({"pairs": "all"}, 0), ({"frames": ("clips", 3)}, 2)], ids=str
)
def test_every_sample_comes_once_and_as_by_number(keyed_release, selection, workers):
    options = {"frames": "all", "fields": FIELDS} | selection
    pairs = StereoPairs(keyed_release, **options)
    loader = pairs.loader(5, num_workers=workers, drop_last=False, open_frames=2)
    found = epoch_of(loader)

    assert len(found) == len(pairs)
    samples = [pairs[number] for number in range(0, len(pairs), 7)]
    assert all(same(found[sample["__key__"]], sample) for sample in samples)


def test_frames_drawn_at_random_are_dealt_to_as_many_runs(keyed_release):
    pairs = StereoPairs(keyed_release, frames=("random", 5), fields=FIELDS)

    assert pairs.plan.runs.lengths.tolist() == [2, 3] * 2
    assert len(epoch_of(pairs.loader(4, drop_last=False))) == 10
