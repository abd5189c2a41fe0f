"""The Hub and S3, each by its real client or protocol, behind a network that delays and fails."""

import threading

import fsspec
import pytest

from benchmarks.server import Network
from benchmarks.server import serving as delayed_serving
from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.remote import RemoteObject
from tests.servers.gate import Gate
from tests.servers.hub import COMMIT, REPOSITORY
from tests.servers.raw import raw_serving
from tests.sources.policies import ended, retry_policy


@pytest.fixture
def before(tmp_path):
    """Put a network before a server of this machine."""

    def begin(url, **how):
        return delayed_serving(tmp_path, network=Network(**how), to=url)

    return begin


@pytest.fixture
def shard(small_shards):
    return min(small_shards.glob("*.tar"))


@pytest.fixture(params=["hub", "s3"])
def store(request, monkeypatch, s3_endpoint):
    """A store of `small_shards`: its server, and how to point its URLs to another address."""
    if request.param == "hub":
        hub = request.getfixturevalue("hub")

        def point(url):
            conf = {"endpoint": url, "token": False}
            monkeypatch.setitem(fsspec.config.conf, "hf", conf)
            return f"hf://datasets/{REPOSITORY}@{COMMIT}"

        return hub.url, point
    root = request.getfixturevalue("s3")

    def point(url):
        conf = fsspec.config.conf["s3"] | {"endpoint_url": url}
        monkeypatch.setitem(fsspec.config.conf, "s3", conf)
        return root

    return s3_endpoint, point


def test_a_range_costs_one_request_once_the_object_is_known(store, shard):
    url, point = store
    with Gate(url) as server:
        remote = RemoteObject(f"{point(server.url)}/{shard.name}")
        remote.read(0, 9)
        known = server.asked

        assert remote.read(1000, 3000) == shard.read_bytes()[1000:3000]
        assert server.asked == known + 1


def test_threads_wait_for_their_answers_together(store, shard):
    """No request is answered before all are asked."""
    url, point = store
    wrong = []
    with Gate(url) as gate:
        remote = RemoteObject(f"{point(gate.url)}/{shard.name}")
        remote.read(0, 9)
        gate.hold_until(8)

        def read(start):
            if remote.read(start, start + 500) != shard.read_bytes()[start : start + 500]:
                wrong.append(start)

        threads = [threading.Thread(target=read, args=(500 * each,)) for each in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert gate.came_together
    assert wrong == []


def test_lost_connections_cost_no_byte(store, before, shard):
    url, point = store
    with before(url, lost=0.1) as server:
        retry = retry_policy(first_wait_s=0.001)
        remote = RemoteObject(f"{point(server.url)}/{shard.name}", retry=retry)
        whole = shard.read_bytes()

        for start in range(0, 30_000, 1000):
            assert remote.read(start, start + 1000) == whole[start : start + 1000]


@pytest.mark.parametrize("how", ["refusing", "never answering"])
def test_a_dead_store_is_a_named_error_within_the_longest_outage(store, how):
    def never(start, stop):
        yield 60.0

    _, point = store
    policy = retry_policy(attempts=999, timeout_s=0.2, longest_outage_s=0.4)
    with raw_serving(never) as silent:
        root = point("http://127.0.0.1:1" if how == "refusing" else silent)
        remote = RemoteObject(f"{root}/x.tar", retry=policy)

        with pytest.raises(StorageError, match=rf"{root}/x.tar : cannot be read, at byte 0 of 9 "):
            ended(lambda: remote.read(0, 9))
