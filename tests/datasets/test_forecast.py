"""What limits a training: the formula by hand, its properties, and the command."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

from stereogenbench_data import StereoPairs, forecast
from stereogenbench_data.datasets import forecast as forecasting
from stereogenbench_data.datasets.forecast import planned_bytes
from stereogenbench_data.errors import SelectionError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.load import Work
from tests.cli.command import succeed
from tests.servers.failing_server import Answer, serving
from tests.shards.shard_files import scenes_of

FIELDS = ("left", "right", "disparity", "frame_index", "__key__")


@pytest.fixture
def costs(monkeypatch):
    """Give each sample a cost that one can reckon with: 20 ms of a core, 3 requests of 400 kB."""
    monkeypatch.setattr(forecasting, "_decoding_s", lambda *args, **named: 0.02)
    monkeypatch.setattr(forecasting, "planned_bytes", lambda *args, **named: (3, 400_000))


@pytest.mark.parametrize(
    ("network", "rate", "limit"),
    [
        pytest.param({}, 200, "processor", id="4 workers of 20 ms"),
        pytest.param({"delay_ms": 640}, 4 / 0.24, "delay", id="3 requests of 640 ms, 8 at a time"),
        pytest.param({"connection_mb_s": 1}, 4 / 0.05, "connection bandwidth", id="0.4 s by 8"),
        pytest.param({"machine_mb_s": 40}, 100, "machine bandwidth", id="40 MB/s by 0.4 MB"),
        pytest.param({"total_mb_s": 20}, 50, "total bandwidth", id="20 MB/s by 0.4 MB"),
        pytest.param({"requests_s": 90}, 30, "requests", id="90 requests/s by 3"),
    ],
)
def test_what_binds(small_shards, costs, network, rate, limit):
    found = forecast(small_shards, samples_s=1000, accelerators=(1,), cores=4, **network).scales[0]

    assert found.share * 1000 == pytest.approx(rate)
    assert found.limit == limit


def test_machines_share_the_server_and_nothing_else(small_shards, costs):
    found = forecast(
        small_shards, samples_s=1000, accelerators=(1, 2, 3), per_machine=1, cores=4,
        machine_mb_s=40, total_mb_s=100,
    )  # fmt: skip

    assert [each.share * each.accelerators * 1000 for each in found.scales] == pytest.approx(
        [100, 200, 250]
    )
    assert [each.limit for each in found.scales] == [
        "machine bandwidth", "machine bandwidth", "total bandwidth",
    ]  # fmt: skip


def test_what_accelerators_need_is_added_up(small_shards, costs):
    of = {"samples_s": 50, "accelerators": (20,), "cores": 32, "delay_ms": 60}
    found = forecast(small_shards, **of).scales[0]

    assert (found.machines, found.share, found.limit) == (3, 1, "accelerators")
    # 1000 samples/s of 3 machines by cores of 20 ms and workers of max(20 ms, 3 * 60 ms / 8)
    assert (found.cores, found.workers) == (7, 8) == (
        math.ceil(1000 / 3 * 0.02), math.ceil(1000 / 3 * 0.0225),
    )  # fmt: skip
    assert (found.mb_s, found.requests_s) == pytest.approx((400, 3000))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples_s": 0}, "samples_s must be above 0, got 0"),
        ({"samples_s": 1, "accelerators": ()}, "accelerators must be above 0, got 0"),
        ({"samples_s": math.inf}, "samples_s must be a finite number from 0, got inf"),
        ({"samples_s": math.nan}, "samples_s must be above 0, got nan"),
        ({"samples_s": 1, "accelerators": (1, math.inf)}, "accelerators must be a finite .* inf"),
        ({"samples_s": 1, "delay_ms": -3}, "delay_ms must be a finite number from 0, got -3"),
    ],
)
def test_a_number_out_of_its_range_is_named(small_shards, options, message):
    with pytest.raises(SelectionError, match=message):
        forecast(small_shards, **options)


def test_samples_without_pictures_ask_nothing_of_the_network(small_shards):
    found = forecast(
        small_shards, samples_s=1e-3, accelerators=(1,), fields=("caption", "scene"), measure_s=0.1,
        delay_ms=60, machine_mb_s=1, total_mb_s=1, requests_s=1,
    )  # fmt: skip

    assert (found.bytes, found.requests, found.scales[0].limit) == (0, 0, "accelerators")


class Batches:
    """Batches of 8 samples, half of them of each of two workers, who take 4 s for their half."""

    def __init__(self, clock):
        """Move a clock."""
        self.clock, self.done = clock, Work()

    def __iter__(self):
        """Return those of a pass; the next one is made when one is given."""
        for _ in range(10):
            self.clock.now_s += 4
            self.done.add(Work(8, reading_s=1.0, decoding_s=5.0, making_s=2.0, waiting_s=9.0))
            yield {"frame_index": range(8)}

    def work(self):
        """Return what the workers have done."""
        return replace(self.done)

    def close(self):
        """Have no worker to end."""


@pytest.mark.parametrize("seconds", [1, 6, 30, 1000])
def test_decoding_is_timed_truly_whatever_a_batch_takes(small_shards, monkeypatch, seconds):
    clock = SimpleNamespace(now_s=0.0, perf_counter=lambda: clock.now_s)
    monkeypatch.setattr(forecasting, "time", clock)
    pairs = StereoPairs(small_shards, frames="all")
    monkeypatch.setattr(pairs, "loader", lambda *args, **named: Batches(clock))

    assert forecasting._decoding_s(pairs, 8, workers=2, seconds=seconds) == 1


# What a sample takes.


@pytest.mark.filterwarnings("ignore:1 of 2 workers have nothing to do")
@pytest.mark.parametrize(
    ("frames", "workers"), [("all", 1), (("random", 3), 2), (("clips", 3), 2)], ids=str
)
def test_the_bytes_of_a_sample_are_those_that_are_fetched(frames, workers, large_shards):
    with serving(large_shards) as server:
        pairs = StereoPairs(server.url, fields=FIELDS, frames=frames, check="metadata")
        requests, count = planned_bytes(pairs, 2, workers=workers)
        loader = pairs.loader(2, num_workers=workers, drop_last=False)
        server.asked.clear()
        for _ in loader:
            pass
        loader.close()
        asked = [each for each in server.asked if each.path.endswith(".tar") and each.stop > 1]

    assert count * len(pairs) == pytest.approx(sum(each.sent for each in asked), rel=0.01)
    # Neighbouring ranges are merged where their requests have to wait.
    assert 0.4 * requests * len(pairs) <= len(asked) <= 1.1 * requests * len(pairs)


def test_the_bytes_of_local_data_are_those_of_the_same_data_afar(small_shards):
    local = planned_bytes(StereoPairs(small_shards, frames="all"), 2, workers=2)
    with serving(small_shards) as server:
        afar = planned_bytes(StereoPairs(server.url, frames="all"), 2, workers=2)

    assert local == afar


def test_data_without_seek_tables_are_refused_with_the_cure(small_shards, tmp_path):
    shards = SceneIndex.open(small_shards).shards
    scenes = scenes_of(small_shards).values()
    plain = SceneIndex.from_scenes(scenes, small_shards, shards=shards)

    with pytest.raises(StorageError, match=r"where the packets.*`stereogenbench index`"):
        forecast(plain, samples_s=1)


def test_the_delay_of_a_server_is_measured(small_shards):
    with serving(small_shards) as server:
        server.always = {path: Answer(delay_s=0.05) for path in SceneIndex.open(server.url).shards}
        found = forecast(server.url, samples_s=1, batch_size=2, measure_s=0.1)

    assert found.delay_ms >= 50


def test_a_forecast_of_small_scenes_measures_and_adds_up(small_shards):
    found = forecast(
        small_shards, samples_s=10, accelerators=(1, 1000), batch_size=2, frames="all",
        measure_s=0.6, cores=4, delay_ms=50, requests_s=3000,
    )  # fmt: skip

    assert found.samples == 28
    assert found.decoding_s > 0
    assert found.bytes > 0
    assert [each.accelerators for each in found.scales] == [1, 1000]
    assert found.scales[1].requests_s * found.scales[1].share <= 3000 * (1 + 1e-9)


def test_the_command_prints_a_table(small_shards, monkeypatch):
    monkeypatch.setattr(forecasting, "_decoding_s", lambda *_, **__: 0.01)  # it takes seconds
    text = succeed(
        "forecast", small_shards, "--samples-s", "20", "--delay-ms", "60", "--total-mb-s", "0.001",
        "--batch-size", "2", "--frames", "random:2",
    )  # fmt: skip

    assert "each 60 ms until its first byte" in text.stdout
    lines = text.stdout.splitlines()
    assert "machines  cores each  workers each   MB/s in all  requests/s in all" in lines[2]
    assert lines[-1].split()[:2] == ["10,000", "1,250"]
    assert lines[-1].endswith("total bandwidth")
