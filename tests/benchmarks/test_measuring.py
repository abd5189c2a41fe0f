"""What measures, run once on tiny data; what came out is written, tabled and drawn."""

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import (
    accuracy,
    clock,
    race,
    tables,
    training,
)
from benchmarks.contestants import limit
from benchmarks.material import facts
from benchmarks.plots import plot_all
from benchmarks.results import Results, Spread, ratios
from benchmarks.workloads import WORKLOADS, Job, tiny
from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.index.scene_folder import describe_scene

TINY = {workload.name: tiny(workload) for workload in WORKLOADS}


@pytest.fixture(scope="module")
def results(material, tmp_path_factory):
    """Return results of one round of a race, and of all else that is measured in this process."""
    found = Results(tmp_path_factory.mktemp("out") / "results.json")
    found.put("data", facts(material))
    found.put("machine", {"cores": 2, "cpu": "a processor", "versions": {"av": "18.1"}})
    found.put("accuracy", accuracy.measure_accuracy(material, rounds=1, cases=6, report=str))
    plan = race.Plan(rounds=1)
    race.run_races([TINY["all-frames"]], material, found, plan=plan, report=str)
    return found


def test_a_round_holds_every_entrant_that_can_race(results):
    section = results.race("all-frames")
    (found,) = section["rounds"]

    assert {"limit/0", "naive/0", "ours/0", "ours-stream/0", "webdataset/0"} <= found.keys()
    assert all(run["samples"] > 0 and run["seconds"] > 0 for run in found.values())
    assert not {"limit/0", "ours/0", "naive/0"} & section["failed"].keys()


def test_rounds_that_are_there_are_not_run_again_when_resumed(results, material):
    before = results.race("all-frames")["rounds"]
    reported = []

    plan = race.Plan(rounds=1, resume=True)
    race.run_races([TINY["all-frames"]], material, results, plan=plan, report=reported.append)

    assert reported == []
    assert results.race("all-frames")["rounds"] == before


@pytest.fixture(scope="module")
def release_size():
    """The races at the release's size, of 40 scenes."""
    wanted = {"scenes": 40, "batch": 2, "window": range(2), "few": 2, "part": 4, "begun": 2}
    first, second = (each for each in WORKLOADS if each.name in ("release-size", "workers"))
    return replace(first, **wanted, workers=(0,)), replace(second, **wanted, workers=(1, 2))


def test_ours_has_all_scenes_and_others_a_part_for_as_many_samples(release_size, material, results):
    plan, names = race.Plan(rounds=1), ("release-size", "workers")
    assert race.run_races([*release_size], material, results, plan=plan, report=str) == []
    whole, by_workers = (results.race(name)["rounds"][0] for name in names)

    for name in ("limit/0", "ours/0", "ours-stream/0", "webdataset/0"):
        assert whole[name]["samples"] == 8
    assert {name: run["samples"] for name, run in by_workers.items()} == {
        "limit/1": 8, "ours/1": 8, "limit/2": 8, "ours/2": 8,
    }  # fmt: skip
    assert min(run["cpu_s"] for run in (*whole.values(), *by_workers.values())) > 0
    text = tables.tables({"races": {name: results.race(name) for name in names}})
    assert "8 samples of 7754 scenes by ours, once it has begun, and of 16 of them by th" in text
    assert "| ours, StereoPairs.loader | 2 |" in text


def test_whole_rounds_of_workers_are_timed(release_size, material, monkeypatch):
    """Batches that workers make side by side come together, so others would be timed wrongly."""
    job, seconds = Job(release_size[1], material), iter(range(100))
    monkeypatch.setattr(clock, "_started", lambda make, workers: (make(), np.zeros(1)))
    monkeypatch.setattr(clock, "_cpu_s", lambda: 0.0)
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=lambda: next(seconds) // 3))
    loader = [{"scene": [0, 1]}] * 100
    found = clock.part_of_pass(lambda: loader, job=job, workers=3)

    assert (found.samples, found.seconds) == (12, 2)


def test_the_index_of_links_says_what_their_files_say(material):
    index = SceneIndex.open(material.whole)

    assert len(index) == 40
    for row in (0, 13, 39):
        scene = index.scene(row)
        assert scene == replace(describe_scene(material.whole, scene.id.key), seek_tables=None)


def test_a_contestant_that_hangs_is_stopped():
    with pytest.raises(clock.MeasurementError, match=r"took longer than 0\.05 s"):
        clock.in_a_fork(lambda: time.sleep(60), longest_s=0.05)


def test_the_default_is_within_an_ulp_and_the_quantum_and_float16_is_not(results):
    ways = {way["name"]: way for way in results.sections["accuracy"]["ways"]}
    (default,) = [way for way in ways.values() if way["offered"] == "default"]

    assert default["worst_ulps"] <= 1
    assert default["worst_of_bound"] <= 1
    assert ways["closed form stored as float16"]["worst_ulps"] > 100
    assert ways["pose chain, all float32 (textbook)"]["worst_on_screen_px"] > 0.01


def test_training_shards_are_compared_with_bare_loops_over_the_same_samples(material, monkeypatch):
    drawn = {"random frames": ("random", 3), "random clip": ("random clips", 1, 2)}
    chosen = [
        (replace(workload, frames=drawn[workload.name], window=drawn[workload.name]), mark)
        for workload, mark in training.WORKLOADS
        if workload.name in drawn
    ]
    monkeypatch.setattr(training, "WORKLOADS", chosen)
    found = training.measure_training(material, rounds=1, report=str)

    assert found["rows"].keys() == {"random frames", "random clip"}
    assert all(cost_s > 0 for row in found["rows"].values() for cost_s in row["cpu_s"].values())
    text = tables.tables({"training": found})
    assert "| 8 random frames a scene |" in text
    shards = material.root / "training"
    job = Job(replace(chosen[0][0], size=(32, 32)), material)
    pairs = StereoPairs(shards, **job.selection)
    loop = limit.samples(job, job.of_scene, opened=training.opener(shards))
    for number, bare in enumerate(loop):
        own = pairs[number]
        np.testing.assert_array_equal(bare["left"], own["left"])
        seen = own["disparity"][0].numpy() > 0
        np.testing.assert_allclose(bare["disparity"][0][seen], own["disparity"][0][seen], rtol=1e-6)


def test_the_tables_and_the_plots_are_made_of_the_results(results, tmp_path):
    text = tables.tables(results.sections)
    made = plot_all(results.sections, tmp_path)

    assert "primary pair, 12 frames of each of 8 scenes" in text
    assert "float32 closed form" in text
    assert {path.name for path in made} == {"speed.png", "accuracy.png"}
    assert all(path.stat().st_size > 10_000 for path in made)


def test_a_ratio_is_taken_within_each_round():
    rounds = [
        {"a/2": {"samples": 10, "seconds": 1}, "b/2": {"samples": 10, "seconds": 2}},
        {"a/2": {"samples": 10, "seconds": 4}, "b/2": {"samples": 10, "seconds": 16}},
        {"a/2": {"samples": 10, "seconds": 1}},
    ]

    assert ratios(rounds, "a/2", to="b/2") == Spread(3.0, 2.5, 3.5, 2)
