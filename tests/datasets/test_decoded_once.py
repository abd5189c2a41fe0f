"""At the size of the release each video is decoded about once, counted on real files."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.datasets import workers as processes
from stereogenbench_data.schema.parse import parse_scene_key
from tests.datasets.conftest import keys_of
from tests.servers.tools import open_files

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")

SCENES = 7754
FIELDS = ("left", "right", "depth", "__key__")


@pytest.fixture(scope="module")
def of_real_size(small_release):
    """As many scenes as the release has to train on, all of which lie in the files of two."""
    drawn = SceneIndex.open(small_release)
    two, scenes = [drawn.indexed_scene(row) for row in range(2)], []
    for number in range(SCENES):
        key = f"{two[number % 2].id.key.rpartition('/')[0]}/scene_{number:06d}"
        scenes.append(replace(two[number % 2], id=parse_scene_key(key)))
    return SceneIndex.from_scenes(scenes, small_release)


@pytest.fixture
def tasks(monkeypatch):
    """For each run of each group the workers that were given samples of it."""
    given = {}

    class Recording(processes.PartedBatches):
        def _parts(self, batch, number):
            firsts = self._global_batches.runs.first_sample
            for worker, part in enumerate(parts := super()._parts(batch, number)):
                for run in np.searchsorted(firsts, part.batch, side="right").tolist():
                    given.setdefault((batch.group, run), set()).add(worker)
            return parts

    monkeypatch.setattr(processes, "PartedBatches", Recording)
    return given


@pytest.mark.parametrize(
    ("selection", "workers", "cameras"),
    [({}, 0, 2), ({}, 3, 2), ({"pairs": "all"}, 2, 6)],
    ids=str,
)
def test_each_frame_is_decoded_about_once(of_real_size, selection, workers, cameras, tasks):
    """At the epoch's beginning, when all scenes are begun inside."""
    pairs = StereoPairs(of_real_size, frames="all", fields=FIELDS, **selection)
    loader = pairs.loader(8, num_workers=workers)
    shown = set()
    for batch in itertools.islice(loader, 151):
        for key in batch["__key__"]:
            scene, pair, frame = key.rsplit("/", 2)
            left, right = pair.split("-")
            shown |= {(scene, left, frame), (scene, right, frame), (scene, left, frame, "depth")}
    found = loader.stats()
    loader.close()

    assert (loader.batches.rule.shuffle_groups, loader.batches.rule.open_scenes) == (8, 8)
    # Workers have read ahead of the loop.
    assert len(shown) <= found.frames_used <= len(shown) + 6 * 8 * 2 * cameras
    # Each open video was begun inside, and its decoder is some frames ahead: a run, at the most.
    assert 0 <= found.packets_decoded - found.frames_used < 64 * cameras * 7
    assert all(len(workers) == 1 for workers in tasks.values())


def test_the_order_is_the_same_for_any_number_of_workers(of_real_size):
    keyed = StereoPairs(of_real_size, frames="all", fields=("__key__",))
    orders = [
        keys_of(itertools.islice(keyed.loader(8, num_workers=workers), 40))
        for workers in (0, 1, 2, 3, 5)
    ]

    assert orders == [orders[0]] * 5


@pytest.mark.parametrize(("selection", "most"), [({}, 1), ({"pairs": "all"}, 3)])
def test_whole_runs_are_dealt_to_workers_where_nothing_is_shuffled(
    of_real_size, tasks, selection, most
):
    """Where an eighth of a run for each worker is on its way; else batches in turn."""
    pairs = StereoPairs(of_real_size, frames="all", fields=("__key__",), **selection)
    for _ in itertools.islice(pairs.loader(5, num_workers=3, shuffle=False), 101):
        pass

    assert max(map(len, tasks.values())) == most


def test_a_loader_says_where_its_workers_time_goes(of_real_size):
    pairs = StereoPairs(of_real_size, frames="all", fields=FIELDS)
    loader = pairs.loader(8, num_workers=2)
    assert loader.stats().time == ""
    for _ in itertools.islice(loader, 51):
        pass

    said = loader.stats().time
    assert all(word in said for word in ("reading", "decoding", "making samples", "waiting"))
    assert said.endswith("is the limit")
    assert loader.work().samples >= 400


def test_samples_of_many_open_scenes_are_described_once(of_real_size, monkeypatch):
    pairs = StereoPairs(of_real_size, frames="all", fields=("left", "world_from_left"))
    described = []
    real = SceneIndex.scene

    def scene(self, row, **options):
        described.append(row)
        return real(self, row, **options)

    monkeypatch.setattr(SceneIndex, "scene", scene)
    loader = pairs.loader(128, open_scenes=500, shuffle_groups=1)
    for _ in itertools.islice(loader, 21):
        pass

    assert len(described) == len(set(described)) >= 500


def test_many_datasets_hold_few_files_open(small_index):
    first = StereoPairs(small_index)
    before = len(open_files())
    many = [StereoPairs(small_index) for _ in range(200)]

    assert len(open_files()) <= before + 2  # one block of memory for many of them
    many[7].set_epoch(3)
    assert [many[6].epoch, many[7].epoch, first.epoch] == [0, 3, 0]
