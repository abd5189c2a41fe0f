"""The server for measuring and the races over a network, run once on tiny data."""

import asyncio

import pytest

import benchmarks.server
from benchmarks.network import LOCAL, OURS, Plan, network_tables, run_network
from benchmarks.plots import plot_all
from benchmarks.results import Results
from benchmarks.server import Network

DATA = bytes(range(256)) * 4000


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "x.tar").write_bytes(DATA)
    return tmp_path / "web"


@pytest.fixture
def waits_s(monkeypatch):
    """What a server waits, in seconds, by a clock that only its waits move."""
    found = []

    async def sleep(seconds):
        found.append(seconds)

    monkeypatch.setattr(benchmarks.server, "sleep", sleep)
    monkeypatch.setattr(benchmarks.server, "monotonic", lambda: sum(found))
    return found


def bodies_of_two_responses(folder, network):
    """Return how often the file comes whole from a server in this process, asked twice."""

    async def ask():
        server = benchmarks.server._Server(folder, network)
        async with await asyncio.start_server(server.answer, "127.0.0.1", 0) as listening:
            reader, writer = await asyncio.open_connection(*listening.sockets[0].getsockname())
            for keeps in ("keep-alive", "close"):
                writer.write(f"GET /x.tar HTTP/1.1\r\nConnection: {keeps}\r\n\r\n".encode())
            found = await reader.read()
            writer.close()
        return found

    return asyncio.run(ask()).count(DATA)


@pytest.mark.parametrize(
    ("network", "waited_s"),
    [(Network(0.05), 2 * 0.05), (Network(connection_mb_s=4.0), 2 * len(DATA) / 4e6)],
)
def test_the_server_waits_before_each_response_and_for_its_bytes(
    folder, waits_s, network, waited_s
):
    assert bodies_of_two_responses(folder, network) == 2
    assert sum(waits_s) == pytest.approx(waited_s)


@pytest.fixture(scope="module")
def results(material, tmp_path_factory):
    """Return the results of one round of a race over two networks."""
    found = Results(tmp_path_factory.mktemp("out") / "results.json")
    plan = Plan(
        rounds=1, workers=1, scenes=10, workloads=("first",),
        networks=(Network(0.001, connection_mb_s=20.0), Network(0.001, refused=0.05)),
    )  # fmt: skip
    assert run_network(material, found, plan=plan, report=str) == []
    return found


def test_every_contestant_loads_as_many_samples(results):
    races = results.sections["network"]["races"]

    assert [race["refused"] for race in races] == [0.0, 0.05]
    for race in races:
        samples = {name: turn["samples"] for name, turn in race["found"].items()}
        assert set(samples.values()) == {10}
        assert {LOCAL, OURS} <= samples.keys()
        if not race["refused"]:
            failed = results.sections["network"]["failed"].keys()
            assert {"webdataset", "HF datasets", "Mosaic Streaming"} == (
                samples.keys() - {LOCAL, OURS}
            ) | failed


def test_a_server_counts_less_for_ours_than_for_those_that_read_whole_shards(results):
    for race in results.sections["network"]["races"]:
        found = race["found"]
        if not race["refused"]:
            assert 0 < found[OURS]["sent_mb"] < found["webdataset"]["sent_mb"]
            assert found["webdataset"]["requests"] == 10
            assert found[LOCAL]["requests"] == 0


def test_the_races_are_tabled_and_drawn(results, tmp_path):
    text = network_tables(results.sections["network"])
    made = plot_all(results.sections, tmp_path)

    assert "| 1 ms, 20 MB/s a connection | ours |" in text
    assert "| 1 ms, 5% of requests refused | ours |" in text
    assert [path.name for path in made] == ["network.png"]
