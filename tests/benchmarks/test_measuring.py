"""What measures, run once on tiny data; what came out is written, tabled and drawn."""

import json
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import (
    __main__,
    accuracy,
    clock,
    derive,
    evaluation,
    generation,
    profile,
    race,
    start,
    tables,
    training,
    tried,
)
from benchmarks.__main__ import chosen, parse
from benchmarks.contestants import limit
from benchmarks.material import facts
from benchmarks.plots import plot_all
from benchmarks.results import Results, Spread, ratios, shares
from benchmarks.ways import WAYS
from benchmarks.workloads import WORKLOADS, Job, tiny
from stereogenbench_data import StereoPairs

TINY = {workload.name: tiny(workload) for workload in WORKLOADS}


@pytest.fixture(scope="module")
def results(material, tmp_path_factory):
    """Return results of one round of a race, and of all else that is measured in this process."""
    found = Results(tmp_path_factory.mktemp("out") / "results.json")
    found.put("data", facts(material))
    found.put("machine", {"cores": 2, "cpu": "a processor", "versions": {"av": "18.1"}})
    found.put("accuracy", accuracy.measure_accuracy(material, rounds=1, cases=6, report=str))
    plan = race.Plan(rounds=1)
    found.put("tried", tried.measure_tried(material, rounds=1, report=str))
    found.put("evaluation", evaluation.measure(frames=1, size_px=64, workers=1))
    found.put(
        "generation",
        generation.measure(sizes_px=(64,), frames=1, scenes=1, maps=("SynthHall",)),
    )
    workloads = [TINY["all-frames"], TINY["all-frames-crf26"]]
    race.run_races(workloads, material, found, plan=plan, report=str)
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


def test_the_limit_of_two_processes_counts_the_samples_of_both(material):
    job = Job(TINY["all-frames"], material)

    measured = clock.measured("limit", job, workers=2)

    assert measured.samples == len(job.wanted) == 4


def test_a_contestant_that_fails_says_so(material):
    def fail():
        raise ValueError("no such thing")

    with pytest.raises(clock.MeasurementError, match="ValueError: no such thing"):
        clock.in_a_fork(fail)


def test_a_contestant_that_hangs_is_stopped():
    with pytest.raises(clock.MeasurementError, match=r"took longer than 0\.05 s"):
        clock.in_a_fork(lambda: time.sleep(60), longest_s=0.05)


def test_every_way_has_an_error_and_a_speed(results):
    ways = results.sections["accuracy"]["ways"]

    assert [way["name"] for way in ways] == [way.name for way in WAYS]
    assert all(way["ns_a_pixel"]["median"] > 0 for way in ways)


def test_the_default_is_within_an_ulp_and_the_quantum_and_float16_is_not(results):
    ways = {way["name"]: way for way in results.sections["accuracy"]["ways"]}
    (default,) = [way for way in ways.values() if way["offered"] == "default"]

    assert default["worst_ulps"] <= 1
    assert default["worst_of_bound"] <= 1
    assert ways["closed form stored as float16"]["worst_ulps"] > 100
    assert ways["pose chain, all float32 (textbook)"]["worst_on_screen_px"] > 0.01


def test_depth_that_is_averaged_belongs_to_no_surface(results):
    shares = {way["name"]: way["invented_share"] for way in results.sections["accuracy"]["resized"]}

    assert shares["nearest-exact, depth"] == 0
    assert shares["bilinear, depth"] > 0


def test_the_functions_that_the_profile_times_are_there():
    assert clock.in_a_fork(lambda: profile.Spans().install()) == []


def test_the_parts_of_a_profile_add_up_to_the_whole(material):
    job = Job(TINY["all-frames"], material)

    found = clock.in_a_fork(lambda: profile.profiled(job, job.tree))

    assert found["ms"]["decoding depth"] > 0
    assert found["ms"]["decoding colour"] > 0
    assert found["ms"]["queueing"] > 0


def test_pairs_in_the_loader_are_compared_with_views_that_become_pairs(material, monkeypatch):
    monkeypatch.setattr(derive, "SIZES", {"as stored": None, "smaller": (24, 40)})
    found = derive.measure_derive(material, rounds=1, report=str)

    text = tables.tables({"derive": found})
    for size in ("as stored", "smaller"):
        ways = found[size]["ways"]
        pixels = 64 * 64 if size == "as stored" else 24 * 40
        # Six pictures and six maps of two bytes, and numbers of cameras beside them.
        assert ways["views and stored depth"]["bytes"] == pytest.approx(30 * pixels, abs=6000)
        assert ways["15 pairs in the loader"]["bytes"] == 15 * (2 * 3 + 2 * 4 + 5 + 3) * pixels
        assert all(way["cpu_s"] > 0 for way in ways.values())
        assert f"views and stored depth, {size}" in text


def test_training_shards_are_compared_with_bare_loops_over_the_same_samples(material, monkeypatch):
    drawn = {"random frames": ("random", 3), "random clip": ("random clips", 1, 2)}
    chosen = [
        (replace(workload, frames=drawn[workload.name], window=drawn[workload.name]), mark)
        for workload, mark in training.WORKLOADS
        if workload.name in drawn
    ]
    monkeypatch.setattr(training, "WORKLOADS", chosen)
    found = training.measure_training(material, rounds=1, workers=1, report=str)

    assert found["rows"].keys() == {"random frames", "random clip"}
    assert all(cost_s > 0 for row in found["rows"].values() for cost_s in row["cpu_s"].values())
    text = tables.tables({"training": found})
    assert "| 8 random frames a scene |" in text
    shards = material.root / "training"
    job = Job(replace(chosen[0][0], size=(32, 32)), material)
    pairs = StereoPairs(shards, **job.selection)
    loop = limit.samples(job, job.of_scene, opened=training._Shards(shards))
    for number, bare in enumerate(loop):
        own = pairs[number]
        np.testing.assert_array_equal(bare["left"], own["left"])
        seen = own["disparity"][0].numpy() > 0
        np.testing.assert_allclose(bare["disparity"][0][seen], own["disparity"][0][seen], rtol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU with CUDA")
def test_the_rate_on_a_gpu_stands_beside_its_memorys(material):
    gpu = derive.measure_derive(material, rounds=1, report=str)["832x480"]["gpu"]

    assert 0 < gpu["eager"] < gpu["limit"]


def test_starting_and_memory_are_measured(material):
    index = start.open_and_select(material)
    watched = clock.in_a_fork(lambda: start.watch_memory(material, batches=2, report=str))

    assert index["pairs"] == 15 * round(774 * material.scale)
    assert watched["batches"] == 2
    assert watched["peak_mb"] > 50


def test_the_tables_and_the_plots_are_made_of_the_results(results, tmp_path):
    text = tables.tables(results.sections)
    made = plot_all(results.sections, tmp_path)

    assert "primary pair, all frames shuffled" in text
    assert "float32 closed form" in text
    assert "each camera decoded once for all its pairs" in text
    assert "## Scoring" in text
    assert "| SynthHall, Uniform, 64 px |" in text
    assert "| primary pair, all frames shuffled, 1280 | 26 |" in text
    assert {path.name for path in made} == {
        "speed.png", "contestants.png", "workers.png", "accuracy.png", "rates.png",
    }  # fmt: skip
    assert all(path.stat().st_size > 10_000 for path in made)


def test_results_outlive_the_process(results):
    again = Results(results.path)

    assert again.sections == json.loads(json.dumps(results.sections))


def test_threads_and_planes_make_the_same_pictures(results):
    groups = results.sections["tried"]["groups"]
    decoding = groups["decoding colour, one picture after another"]
    stored = groups["colour conversion, stored size"]

    assert [way["psnr_db"] for way in decoding[:3]] == [None, None, None]
    assert [way["psnr_db"] for way in stored[:4]] == [None, None, None, None]


def test_a_ratio_is_taken_within_each_round():
    rounds = [
        {"a/2": {"samples": 10, "seconds": 1}, "b/2": {"samples": 10, "seconds": 2}},
        {"a/2": {"samples": 10, "seconds": 4}, "b/2": {"samples": 10, "seconds": 16}},
        {"a/2": {"samples": 10, "seconds": 1}},
    ]

    assert ratios(rounds, "a/2", to="b/2") == Spread(3.0, 2.5, 3.5, 2)


def test_a_share_is_what_leaving_out_a_part_saves():
    rounds = [{"a/2": {"samples": 10, "seconds": 4}, "b/2": {"samples": 10, "seconds": 1}}]

    assert shares(rounds, "a/2", without="b/2") == Spread(0.75, 0.75, 0.75, 1)


def test_pictures_at_another_rate_are_smaller_and_their_depth_the_same(material):
    other = material.at_rate(26)
    sizes = {
        kind: [
            sum(file.stat().st_size for file in made.release.rglob(f"cam_*_{kind}"))
            for made in (material, other)
        ]
        for kind in ("rgb.mp4", "depth.mkv")
    }

    assert sizes["rgb.mp4"][1] < sizes["rgb.mp4"][0]
    assert sizes["depth.mkv"][1] == sizes["depth.mkv"][0] > 0
    assert material.at_rate(18) == material


def test_the_slice_of_those_that_start_anew_is_spread_over_the_places_in_a_video(material):
    workload = replace(TINY["all-frames"], few=4)

    job = Job(workload, material, reading="anywhere")

    assert sorted(wanted.frames[0] for wanted in job.wanted) == [0, 1, 2, 3]
    assert [wanted.frames[0] for wanted in job.wanted] == [0, 1, 3, 2]


def test_a_step_that_fails_is_reported_and_the_others_are_measured(material, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise ValueError("no such thing")

    monkeypatch.setattr(__main__, "measure_memory", fail)
    monkeypatch.setattr(__main__, "measure_profile", lambda *_, **__: {"all": 1})
    results, reported = Results(tmp_path / "results.json"), []

    failed = __main__.measure_others(
        ["memory", "profile"],
        material,
        results,
        options=parse(["--rounds", "1"]),
        report=reported.append,
    )

    assert failed == ["memory: ValueError: no such thing"]
    assert Results(results.path).sections["profile"] == {"all": 1}


def test_rates_stand_for_all_their_races():
    workloads, others = chosen(parse(["--only", "rates"]))

    assert {workload.crf for workload in workloads} == {26, 34}
    assert len(workloads) == 6
    assert others == []


def test_options_choose_workloads_and_workers():
    workloads, others = chosen(parse(["--only", "clips", "--only", "memory", "--workers", "4,1"]))

    assert [(workload.name, workload.workers) for workload in workloads] == [("clips", (4, 1))]
    assert others == ["memory"]


def test_the_command_names_the_checkout_that_it_needs(tmp_path):
    code = (
        "import sys, pathlib, stereogenbench_data.cli.bench as bench; "
        "bench.__file__ = '/nowhere/at/all/bench.py'; bench.bench()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )

    assert done.returncode == 1
    assert "StorageError: benchmarks/: is neither in /nowhere" in done.stderr


def test_the_spread_of_nothing_is_none():
    assert Spread.of([]) is None
    assert np.isclose(Spread.of([1, 2, 3, 4]).median, 2.5)
