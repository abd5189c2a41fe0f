"""Servers that are dead, busy or slow: named errors in bounded time, reads that end at once."""

import contextlib
import logging
import multiprocessing
import socketserver
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import fsspec
import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.remote import RemoteObject
from tests.servers.failing_server import Answer, serving
from tests.servers.hub import COMMIT, REPOSITORY
from tests.sources.policies import ended, retry_policy, waits_noted

DATA = bytes(range(256)) * 1000
FORK = multiprocessing.get_context("fork")


@pytest.fixture
def served(web):
    (web.folder / "x.tar").write_bytes(DATA)
    return web


DEAD = {
    "refusing": None,
    "never answering": Answer(delay_s=60.0),
    "hanging after its head": Answer(pause_s=60.0),
    "trickling": Answer(pause_s=0.02, piece_bytes=1),
    "hanging up": Answer(stop_after=1),
}


@pytest.fixture
def dead(served):
    """Return the address of a server that is dead, in one way or another."""

    def make(how):
        served.answers = [DEAD[how]] * 1000
        return "http://127.0.0.1:1" if DEAD[how] is None else served.url

    return make


def reason_of(url, policy):
    try:
        RemoteObject(f"{url}/x.tar", retry=policy).read(0, 65536)
    except StorageError as error:
        return str(error)
    return "no error"


@pytest.mark.parametrize("how", DEAD)
def test_a_dead_server_is_a_named_error_within_the_longest_outage(dead, how):
    policy, url = retry_policy(attempts=999, timeout_s=0.2, longest_outage_s=0.4), dead(how)

    text = ended(lambda: reason_of(url, policy))

    assert f"{url}/x.tar : cannot be read, at byte" in text
    assert "slower than timeout_s=0.2: SceneIndex.open(..., retry=RetryPolicy(timeout_s=0" in text


class Trickling(socketserver.BaseRequestHandler):
    def handle(self):
        self.request.recv(65536)
        with contextlib.suppress(OSError):
            for letter in self.server.answer + b"x" * 5000:
                self.request.sendall(bytes([letter]))
                time.sleep(0.02)


REDIRECT = b"HTTP/1.1 302 x\r\nLocation: /y\r\nContent-Length: 5000\r\n\r\n"


@pytest.mark.parametrize(
    "answer", [b"HTTP/1.1 206 x\r\nX: ", REDIRECT], ids=["its head", "a redirect"]
)
def test_a_server_that_trickles_is_a_named_error_within_the_longest_outage(answer):
    policy = retry_policy(attempts=999, timeout_s=0.2, longest_outage_s=0.4)
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Trickling) as server:
        server.answer, server.daemon_threads = answer, True
        threading.Thread(target=server.serve_forever, daemon=True).start()

        text = ended(lambda: reason_of(f"http://127.0.0.1:{server.server_address[1]}", policy))
        server.shutdown()

    assert "cannot be read, at byte 0" in text


def test_a_slow_server_is_read_to_the_end_while_it_goes_on(served):
    served.always["x.tar"] = Answer(pause_s=0.02, piece_bytes=16_384)
    remote = RemoteObject(f"{served.url}/x.tar", retry=retry_policy(attempts=3, timeout_s=0.2))

    assert remote.read(0, len(DATA)) == DATA


@pytest.mark.parametrize("how", ["refusing", "never answering"])
@pytest.mark.parametrize(
    ("root", "conf"),
    [
        (f"hf://datasets/{REPOSITORY}@{COMMIT}", {"token": False, "endpoint": ...}),
        ("s3://bucket/shards", {"key": "key", "secret": "word", "endpoint_url": ...}),
    ],
)
def test_a_dead_store_is_an_error_within_the_longest_outage(monkeypatch, dead, root, conf, how):
    policy, url = retry_policy(attempts=999, timeout_s=0.2, longest_outage_s=0.4), dead(how)
    conf = {name: url if value is ... else value for name, value in conf.items()}
    monkeypatch.setitem(fsspec.config.conf, root.partition(":")[0], conf)

    text = ended(lambda: reason_of(root, policy))

    assert f"{root}/x.tar : cannot be read, at byte 0 of 65536" in text


@pytest.mark.parametrize("status", [429, 503])
def test_a_busy_server_is_left_alone_by_all_reads_of_a_process(served, monkeypatch, status):
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
    remote, starts = RemoteObject(f"{served.url}/x.tar"), range(0, 160_000, 1000)

    with caplog.at_level(logging.WARNING), ThreadPoolExecutor(32) as threads:
        found = list(threads.map(lambda start: remote.read(start, start + 500), starts))

    assert found == [DATA[start : start + 500] for start in starts]
    assert "pool is full" not in caplog.text
    assert served.connections <= 32


def test_a_forked_process_reads_over_a_connection_of_its_own(served):
    RemoteObject(f"{served.url}/x.tar").read(0, 9)
    with FORK.Pool(1) as pool:
        assert pool.apply(RemoteObject(f"{served.url}/x.tar").read, (9, 18)) == DATA[9:18]
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
