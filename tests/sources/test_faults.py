"""Servers that are dead, busy or slow: named errors in bounded time, reads that end at once."""

import logging
import multiprocessing
import threading
import time
from contextlib import contextmanager

import fsspec
import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.remote import RemoteObject
from tests.servers.failing_server import Answer, serving
from tests.servers.hub import COMMIT, REPOSITORY
from tests.servers.raw import raw_serving
from tests.sources.policies import ended, retry_policy, waits_noted

DATA = bytes(range(256)) * 1000
FORK = multiprocessing.get_context("fork")


@pytest.fixture
def served(web):
    (web.folder / "x.tar").write_bytes(DATA)
    return web


def answering_head(start, stop):
    told = f"bytes {start}-{stop - 1}/{len(DATA)}"
    lines = ["HTTP/1.1 206 x", f"Content-Range: {told}", f"Content-Length: {stop - start}"]
    return "\r\n".join([*lines, "", ""]).encode()


def never(start, stop):
    yield 60.0


def after_its_head(start, stop):
    yield answering_head(start, stop)
    yield 60.0


def trickling(start, stop):
    yield answering_head(start, stop)
    for place in range(start, stop):
        yield DATA[place : place + 1]
        yield 0.02


def hanging_up(start, stop):
    yield answering_head(start, stop) + DATA[start : start + 1]


@contextmanager
def refusing():
    yield "http://127.0.0.1:1"


DEAD = {
    "refusing": refusing,
    "never answering": lambda: raw_serving(never),
    "hanging after its head": lambda: raw_serving(after_its_head),
    "trickling": lambda: raw_serving(trickling),
    "hanging up": lambda: raw_serving(hanging_up),
}


@pytest.fixture(params=DEAD)
def dead(request):
    """The address of a server that is dead, in one way or another."""
    with DEAD[request.param]() as url:
        yield url


def reason_of(url, policy):
    try:
        RemoteObject(f"{url}/x.tar", retry=policy).read(0, 65536)
    except StorageError as error:
        return str(error)
    return "no error"


def test_a_dead_server_is_a_named_error_within_the_longest_outage(dead):
    policy = retry_policy(attempts=999, timeout_s=0.2, longest_outage_s=0.4)

    text = ended(lambda: reason_of(dead, policy))

    assert f"{dead}/x.tar : cannot be read, at byte" in text
    assert "slower than timeout_s=0.2: SceneIndex.open(..., retry=RetryPolicy(timeout_s=0" in text


def test_a_slow_server_is_read_to_the_end_while_it_goes_on():
    def steady(start, stop):
        yield answering_head(start, stop)
        for place in range(start, stop, 16_384):
            yield DATA[place : min(place + 16_384, stop)]
            yield 0.02

    with raw_serving(steady) as url:
        remote = RemoteObject(f"{url}/x.tar", retry=retry_policy(attempts=3, timeout_s=0.2))
        assert remote.read(0, len(DATA)) == DATA


@pytest.mark.parametrize("how", ["refusing", "never answering"])
@pytest.mark.parametrize("scheme", ["hf", "s3"])
def test_a_dead_store_is_a_named_error_within_the_longest_outage(monkeypatch, scheme, how):
    policy = retry_policy(attempts=999, timeout_s=0.2, longest_outage_s=0.4)
    with DEAD[how]() as dead:
        conf = {
            "hf": {"endpoint": dead, "token": False},
            "s3": {"key": "key", "secret": "word", "endpoint_url": dead},
        }
        monkeypatch.setitem(fsspec.config.conf, scheme, conf[scheme])
        root = {"hf": f"hf://datasets/{REPOSITORY}@{COMMIT}", "s3": "s3://bucket/shards"}[scheme]

        text = ended(lambda: reason_of(root, policy))

    assert f"{root}/x.tar : cannot be read, at byte 0 of 65536" in text


@pytest.mark.parametrize("status", [429, 503])
def test_a_busy_server_is_left_alone_by_all_reads_of_a_process_until_it_said(
    served, monkeypatch, status
):
    served.answers = [Answer(status=status, headers={"Retry-After": "30"})]
    waits = waits_noted(monkeypatch)
    url = f"{served.url}/x.tar"

    assert RemoteObject(url).read(0, 9) == DATA[:9]
    assert RemoteObject(url).read(9, 18) == DATA[9:18]

    assert waits == [pytest.approx(30, abs=2)] * 2


def test_a_wait_longer_than_the_policy_allows_is_an_error_and_not_kept(served):
    served.answers = [Answer(status=429, headers={"Retry-After": "601"})]
    remote = RemoteObject(f"{served.url}/x.tar")

    with pytest.raises(StorageError, match=r"429 .*, which asks to wait 601 s; 1 try"):
        remote.read(0, 9)
    assert remote.read(0, 9) == DATA[:9]


def test_many_threads_keep_their_connections(served, caplog):
    remote, wrong = RemoteObject(f"{served.url}/x.tar"), []

    def read(first):
        for start in range(first, first + 5000, 1000):
            if remote.read(start, start + 500) != DATA[start : start + 500]:
                wrong.append(start)

    with caplog.at_level(logging.WARNING):
        threads = [threading.Thread(target=read, args=(1000 * each,)) for each in range(32)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    assert wrong == []
    assert "pool is full" not in caplog.text
    assert served.connections <= 32


def test_a_forked_process_reads_over_a_connection_of_its_own(served):
    RemoteObject(f"{served.url}/x.tar").read(0, 9)
    here, there = FORK.Pipe(duplex=False)
    worker = FORK.Process(
        target=lambda: there.send(RemoteObject(f"{served.url}/x.tar").read(9, 18))
    )
    worker.start()
    worker.join()

    assert here.recv() == DATA[9:18]
    assert RemoteObject(f"{served.url}/x.tar").read(18, 27) == DATA[18:27]
    assert served.connections == 2


def test_an_address_is_used_again_until_it_is_refused_or_fails(served):
    with serving(served.folder) as other:
        until_s = int(time.time()) + 3600
        there = f"{other.url}/x.tar?Expires={until_s}&Signature=secret"
        served.always["x.tar"] = Answer(status=302, headers={"Location": there})
        remote = RemoteObject(f"{served.url}/x.tar", retry=retry_policy(attempts=2))
        assert remote.read(0, 9) + remote.read(9, 18) == DATA[:18]
        assert len(served.asked) == 1
        other.answers = [Answer(status=403)]

        assert remote.read(18, 27) == DATA[18:27]
        assert len(served.asked) == 2
        other.answers = [Answer(stop_after=0)]
        assert remote.read(27, 36) == DATA[27:36]
