"""What limits a training: the formula by hand, its properties, and the command."""

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data import StereoPairs, forecast
from stereogenbench_data.datasets.forecast import measured_network, planned_bytes
from stereogenbench_data.datasets.scaling import (
    Machine,
    Network,
    SampleCost,
    decoding_s,
    fetching_s,
    loading_rate,
    scale,
)
from stereogenbench_data.errors import SelectionError, StorageError
from stereogenbench_data.index.table import SceneIndex
from tests.cli.command import invoke, one_line
from tests.servers.failing_server import Answer, serving

COST = SampleCost(cpu_s=0.02, bytes=400_000, requests=3)
FAR = Network(delay_s=0.06, connections=8)
FIELDS = ("left", "right", "disparity", "frame_index", "__key__")


def test_fetching_waits_for_each_request_and_sends_each_byte():
    network = Network(delay_s=0.06, connections=8, connection_bytes_s=20e6)

    # 3 requests of 60 ms and 400 kB at 20 MB/s, by 8 connections
    assert fetching_s(COST, network) == pytest.approx((0.18 + 0.02) / 8)


def test_decoding_slows_down_evenly_with_the_workers():
    cost = SampleCost(0.02, 0, 0, slowdown=1.5)
    found = [decoding_s(cost, workers=workers, cores=5) for workers in (1, 3, 5, 9)]

    assert found == pytest.approx([0.02, 0.025, 0.03, 0.03])


@pytest.mark.parametrize(
    ("network", "rate", "limit"),
    [
        pytest.param(Network(), 200, "processor", id="4 workers of 20 ms"),
        pytest.param(
            Network(delay_s=0.08, connections=1), 4 / 0.24, "delay x connections",
            id="3 requests of 80 ms, one at a time",
        ),
        pytest.param(
            Network(connection_bytes_s=1e6), 4 / 0.05, "connection bandwidth",
            id="0.4 s by 8 connections",
        ),
        pytest.param(
            Network(machine_bytes_s=40e6), 100, "machine bandwidth", id="40 MB/s by 0.4 MB"
        ),
        pytest.param(Network(total_bytes_s=20e6), 50, "total bandwidth", id="20 MB/s by 0.4 MB"),
        pytest.param(Network(requests_s=90), 30, "requests", id="90 requests/s by 3"),
    ],
)  # fmt: skip
def test_what_binds(network, rate, limit):
    found = loading_rate(COST, Machine(cores=4), network, workers=4)

    assert found == (pytest.approx(rate), limit)


def test_machines_share_the_server_and_nothing_else():
    network = Network(machine_bytes_s=40e6, total_bytes_s=100e6)
    rates = [
        loading_rate(COST, Machine(cores=4), network, workers=4, machines=machines)
        for machines in (1, 2, 3)
    ]

    assert rates == [
        (pytest.approx(100), "machine bandwidth"),
        (pytest.approx(200), "machine bandwidth"),
        (pytest.approx(250), "total bandwidth"),
    ]


def test_what_accelerators_need_is_added_up():
    found = scale(COST, Machine(cores=32), FAR, accelerators=20, samples_s=50)

    assert (found.machines, found.demand_s, found.cores) == (3, 1000, 20)
    # 1000 samples/s of 3 machines by workers of max(20 ms, 3 * 60 ms / 8)
    assert found.workers == math.ceil(1000 / 3 * 0.0225) == found.workers_used
    assert (found.bytes_s, found.requests_s) == (400e6, 3000)
    assert (found.rate_s, found.share, found.limit) == (1000, 1, "accelerators")


def test_accelerators_that_are_not_fed_name_what_binds():
    found = scale(COST, Machine(cores=4), Network(), accelerators=8, samples_s=50)

    assert (found.cores, found.workers, found.workers_used) == (8, 8, 4)
    assert (found.rate_s, found.limit) == (pytest.approx(200), "processor")
    assert found.share == pytest.approx(0.5)


def test_more_workers_than_cores_hide_a_delay():
    slow = Network(delay_s=1.0, connections=8)
    of = {"accelerators": 1, "samples_s": 50}

    assert scale(COST, Machine(cores=4), slow, **of).limit == "delay x connections"
    assert scale(COST, Machine(cores=4, workers=32), slow, **of).limit == "accelerators"


costs = st.builds(
    SampleCost,
    cpu_s=st.floats(1e-4, 1),
    bytes=st.floats(0, 1e8),
    requests=st.floats(0, 100),
    slowdown=st.floats(1, 50),
)
networks = st.builds(
    Network,
    delay_s=st.floats(0, 2),
    connections=st.integers(1, 64),
    connection_bytes_s=st.floats(1e5, 1e10),
    machine_bytes_s=st.floats(1e5, 1e10),
    total_bytes_s=st.floats(1e5, 1e12),
    requests_s=st.floats(1, 1e6),
)
machines = st.builds(Machine, cores=st.integers(1, 256))


@given(costs, machines, networks, st.integers(1, 300))
def test_one_more_worker_or_machine_is_never_slower(cost, machine, network, workers):
    rate, _ = loading_rate(cost, machine, network, workers=workers)
    by_worker, _ = loading_rate(cost, machine, network, workers=workers + 1)
    by_machine, _ = loading_rate(cost, machine, network, workers=workers, machines=2)

    assert by_worker >= rate * (1 - 1e-9)
    assert by_machine >= rate


@given(costs, machines, networks, st.floats(0, 2))
def test_a_longer_delay_is_never_faster(cost, machine, network, more_s):
    later = replace(network, delay_s=network.delay_s + more_s)
    of = {"workers": machine.workers}

    assert loading_rate(cost, machine, later, **of)[0] <= loading_rate(
        cost, machine, network, **of
    )[0] * (1 + 1e-9)


@given(costs, machines, networks, st.integers(1, 10_000), st.floats(0.1, 1e4))
def test_accelerators_get_no_more_than_they_take(cost, machine, network, accelerators, samples_s):
    found = scale(cost, machine, network, accelerators=accelerators, samples_s=samples_s)

    assert 0 < found.rate_s <= found.demand_s
    assert 1 <= found.workers_used <= machine.workers
    assert (found.limit == "accelerators") == (found.rate_s == found.demand_s)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SampleCost(0, 1, 1), "cpu_s must be above 0, got 0"),
        (lambda: SampleCost(1, 1, 1, slowdown=0.5), "slowdown must be a number from 1, got 0.5"),
        (lambda: Network(delay_s=-1), "delay_s must be a number from 0, got -1"),
        (lambda: Network(delay_s=math.nan), "delay_s must be a number from 0, got nan"),
        (lambda: Network(total_bytes_s=0), "total_bytes_s must be above 0, got 0"),
        (lambda: Machine(cores=0), "cores must be a number from 1, got 0"),
        (
            lambda: scale(COST, Machine(1), Network(), accelerators=0, samples_s=1),
            "accelerators=0.*at least 1",
        ),
        (
            lambda: scale(COST, Machine(1), Network(), accelerators=1, samples_s=0),
            "samples_s=0.*above 0",
        ),
    ],
)
def test_a_number_out_of_its_range_is_named(make, message):
    with pytest.raises(SelectionError, match=message):
        make()


# What a sample takes.


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("frames", ["all", "first", ("random", 3), ("clips", 3)], ids=str)
def test_the_bytes_of_a_sample_are_those_that_are_fetched(frames, workers, large_shards):
    with serving(large_shards) as server:
        pairs = StereoPairs(server.url, fields=FIELDS, frames=frames, check="metadata")
        requests, count, counted = planned_bytes(pairs, 2, workers=workers, connections=8)
        loader = pairs.loader(2, num_workers=workers, tail="uneven", shuffle_groups=4)
        for _ in loader:
            pass
        stats = loader.stats()
        loader.close()

    assert counted == "epoch"
    assert count * len(pairs) == pytest.approx(stats.bytes_fetched, rel=0.01)
    # Neighbouring ranges are merged where their requests have to wait.
    assert 0.4 * requests * len(pairs) <= stats.requests <= 1.1 * requests * len(pairs)


def test_the_bytes_of_local_data_are_those_of_the_same_data_afar(small_shards):
    of = {"workers": 2, "connections": 8}
    local = planned_bytes(StereoPairs(small_shards, frames="all"), 2, **of)
    with serving(small_shards) as server:
        afar = planned_bytes(StereoPairs(server.url, frames="all"), 2, **of)

    assert local == afar


def test_a_long_epoch_is_counted_in_part(small_shards, monkeypatch):
    pairs = StereoPairs(small_shards, frames="all", pairs="all")
    of = {"workers": 1, "connections": 8}
    whole = planned_bytes(pairs, 2, **of)
    monkeypatch.setattr(f"{planned_bytes.__module__}._MOST_PLANNED", len(pairs) // 2)
    requests, count, counted = planned_bytes(pairs, 2, **of)

    assert counted == "part"
    assert 0 < requests < 2 * whole[0]
    assert 0 < count < 2 * whole[1]


def test_data_without_seek_tables_are_refused_with_the_cure(small_shards, tmp_path):
    index = SceneIndex.open(small_shards)
    scenes = [index.scene(row) for row in range(len(index))]
    plain = SceneIndex.from_scenes(scenes, index.root, shards=index.shards)

    with pytest.raises(StorageError, match=r"where the packets.*`stereogenbench index`"):
        forecast(plain, samples_s=1)


def test_the_delay_of_a_server_is_measured(small_shards):
    with serving(small_shards) as server:
        index = SceneIndex.open(server.url)
        paths = set(index.shards)
        server.always = {path: Answer(delay_s=0.05) for path in paths}
        found = measured_network(index)

    assert 0.05 <= found.delay_s < 1
    assert found.connection_bytes_s > 0


# The forecast.


def test_a_forecast_of_small_scenes_measures_and_adds_up(small_shards):
    found = forecast(
        small_shards, samples_s=10, accelerators=(1, 1000), batch_size=2, frames="all",
        measure_s=0.6, machine=Machine(cores=4), network=Network(delay_s=0.05, requests_s=3000),
    )  # fmt: skip

    assert found.samples == 28
    assert 0 < found.cost.cpu_s < 5
    assert found.cost.bytes > 0
    assert found.worker_bytes > 256_000_000
    assert [each.accelerators for each in found.scales] == [1, 1000]
    assert found.scales[1].rate_s * found.cost.requests <= 3000 * (1 + 1e-9)
    assert json.loads(json.dumps(found.to_json()))["network"]["total_bytes_s"] is None


def test_training_shards_are_made_of_a_scene_and_measured(small_release):
    found = forecast(
        small_release, samples_s=10, accelerators=(1,), batch_size=2, frames="all",
        measure_s=0.6, training=(32, 32), size=(32, 32),
    )  # fmt: skip

    assert found.training_cost.cpu_s > 0
    assert found.training_cost.bytes != found.cost.bytes
    assert len(found.training) == 1


def test_the_command_prints_a_table_or_json(small_shards):
    words = (
        "forecast", small_shards, "--samples-s", "20", "--delay-ms", "60", "--requests-s", "10",
        "--batch-size", "2", "--measure-s", "0.5", "--accelerators", "1,100",
        "--frames", "random:2",
    )  # fmt: skip
    text, document = invoke(*words), invoke(*words, "--json")

    assert text.exit_code == 0, text.output
    assert "60 ms until a first byte, 10 requests/s" in text.stdout
    lines = text.stdout.splitlines()
    assert lines[-1].split()[:2] == ["100", "13"]
    assert lines[-1].endswith("requests")
    found = json.loads(document.stdout)
    assert found["scales"][1]["limit"] == "requests"
    assert found["network"]["delay_s"] == 0.06


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--frames", "random"), "'random' is not all, first, every:K, random:N"),
        (("--accelerators", "1,x"), "write numbers from 1, such as 1,8,64"),
        (("--size", "big"), "size"),
    ],
)
def test_the_command_says_how_to_write_what_it_cannot_read(words, message, small_shards):
    ended = invoke("forecast", small_shards, "--samples-s", "20", *words)

    assert ended.exit_code == 2
    assert message in one_line(ended.output)
