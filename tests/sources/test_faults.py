"""Servers that are dead, busy or slow: named errors in bounded time, reads that end at once."""

import base64
import json
import logging
import multiprocessing
import os
import socket
import stat
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.connections import close_connections
from stereogenbench_data.sources.http import signed_for_s
from stereogenbench_data.sources.pauses import begin_pause, pause_end_s
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import Cancellation, ReadCancelled, RetryPolicy
from tests.servers.failing_server import Answer, serving
from tests.servers.raw import raw_serving
from tests.sources.policies import LONGEST_S, ended, retry_policy

DATA = bytes(range(256)) * 1000
FORK = multiprocessing.get_context("fork")


@pytest.fixture
def served(web):
    (web.folder / "x.tar").write_bytes(DATA)
    return web


def answering_head(start, stop):
    lines = [f"Content-Range: bytes {start}-{stop - 1}/{len(DATA)}", f"Content-Length: {stop}"]
    return "\r\n".join(["HTTP/1.1 206 x", *lines, "", ""]).encode()


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
    yield answering_head(start, stop)


@contextmanager
def without_room():
    """A server that never takes a connection, and has no room for another to wait."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen(0)
        place = listening.getsockname()
        waiting = []
        for _ in range(4):
            connection = socket.socket()
            connection.setblocking(False)  # noqa: FBT003 - the socket's own
            connection.connect_ex(place)
            waiting.append(connection)
        time.sleep(0.05)
        try:
            yield f"http://127.0.0.1:{place[1]}"
        finally:
            for connection in waiting:
                connection.close()


@contextmanager
def refusing():
    yield "http://127.0.0.1:1"


DEAD = {
    "refusing": refusing,
    "without room": without_room,
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


def connections_to(url):
    """Return the connections of this process to a server, as the system numbers them."""
    port = f":{int(url.rpartition(':')[2]):04X}"
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    there = {f"socket:[{line[9]}]" for line in lines if line[2].endswith(port)}
    own = set()
    for path in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            own.add(str(path.readlink()))
    return own & there


def reason_of(url, policy):
    try:
        RemoteObject(f"{url}/x.tar", retry=policy).read(0, 65536)
    except StorageError as error:
        return str(error)
    return "no error"


def test_a_dead_server_is_a_named_error_within_the_longest_outage(dead):
    policy = retry_policy(attempts=999, timeout_s=0.4, window_s=0.3, longest_outage_s=1.0)

    text = ended(lambda: reason_of(dead, policy))

    assert f"{dead}/x.tar : cannot be read, at byte" in text
    assert "slower than timeout_s=0.4" in text


def test_a_dead_server_is_a_named_error_in_a_forked_worker_too(dead, served):
    RemoteObject(f"{served.url}/x.tar").read(0, 9)  # its connection is inherited
    policy = retry_policy(attempts=999, timeout_s=0.4, window_s=0.3, longest_outage_s=1.0)
    here, there = FORK.Pipe(duplex=False)
    worker = FORK.Process(target=lambda: there.send(reason_of(dead, policy)))
    worker.start()
    try:
        assert here.poll(LONGEST_S)
        assert "cannot be read, at byte" in here.recv()
    finally:
        worker.kill()
        worker.join()


def test_by_default_a_dead_server_is_an_error_within_a_minute():
    assert RetryPolicy().longest_outage_s + RetryPolicy().first_wait_s < 60


def test_a_slow_server_that_keeps_the_least_rate_has_no_outage():
    def steady(start, stop):
        yield answering_head(start, stop)
        for place in range(start, stop, 4096):
            yield DATA[place : min(place + 4096, stop)]
            yield 0.02

    policy = retry_policy(
        attempts=1, window_s=0.1, least_rate_bytes_s=10_000.0, longest_outage_s=0.15
    )
    with raw_serving(steady) as url:
        remote = RemoteObject(f"{url}/x.tar", retry=policy)

        assert remote.read(0, 131_072) == DATA[:131_072]


def test_a_cancelled_read_ends_at_once_whatever_it_waits_for(dead):
    cancellation, cancelled = Cancellation(), []
    policy = retry_policy(attempts=999, timeout_s=999, first_wait_s=999.0, longest_wait_s=999.0)

    def read():
        with pytest.raises(ReadCancelled, match=r"x.tar : reading was cancelled, at byte"):
            RemoteObject(f"{dead}/x.tar", retry=policy).read(0, 65536, cancellation=cancellation)
        cancelled.append(True)

    before = connections_to(dead)
    threads = [threading.Thread(target=read) for _ in range(3)]
    for thread in threads:
        thread.start()
    time.sleep(0.2)
    cancellation.cancel()
    for thread in threads:
        thread.join(LONGEST_S)

    assert len(cancelled) == 3
    close_connections()
    assert connections_to(dead) == before


def test_what_is_read_after_cancelling_is_not_requested(served):
    cancellation = Cancellation()
    remote = RemoteObject(f"{served.url}/x.tar")
    assert remote.read(0, 9, cancellation=cancellation) == DATA[:9]
    cancellation.cancel()

    with pytest.raises(ReadCancelled, match=r"x.tar : reading was cancelled, at byte 9 of 18"):
        remote.read(9, 18, cancellation=cancellation)
    assert len(served.asked) == 1
    assert remote.read(9, 18) == DATA[9:18]


def test_a_wait_that_a_server_asks_for_is_cancelled(served):
    served.always["x.tar"] = Answer(status=429, headers={"Retry-After": "100"})
    cancellation = Cancellation()
    threading.Timer(0.2, cancellation.cancel).start()

    with pytest.raises(ReadCancelled, match="reading was cancelled"):
        ended(lambda: RemoteObject(f"{served.url}/x.tar").read(0, 9, cancellation=cancellation))


def test_a_busy_server_is_left_alone_by_all_processes_until_it_said(served):
    served.answers = [Answer(status=429, headers={"Retry-After": "1"})]
    url, done = f"{served.url}/x.tar", []

    def read(start):
        done.append((RemoteObject(url).read(start, start + 9), start))

    first = threading.Thread(target=read, args=(0,))
    first.start()
    while not served.asked:
        time.sleep(0.01)
    refused_s = time.monotonic()
    time.sleep(0.1)
    worker = FORK.Process(target=lambda: RemoteObject(url).read(0, 9))
    worker.start()
    others = [threading.Thread(target=read, args=(start,)) for start in (9, 18)]
    for other in others:
        other.start()
    time.sleep(0.4)
    asked = len(served.asked)
    assert asked == 1 or time.monotonic() - refused_s > 1
    for each in (first, *others, worker):
        each.join()

    assert all(data == DATA[start : start + 9] for data, start in done)
    assert len(done) == 3
    assert worker.exitcode == 0
    assert len(served.asked) == 5
    assert time.monotonic() - refused_s > 0.9


def test_a_pause_longer_than_the_policy_allows_is_an_error_and_not_kept(served):
    served.answers = [Answer(status=429, headers={"Retry-After": "301"})]
    remote = RemoteObject(f"{served.url}/x.tar")

    with pytest.raises(StorageError, match=r"429 .*, which asks to wait 301 s; 1 try"):
        remote.read(0, 9)
    assert remote.read(0, 9) == DATA[:9]


def test_a_pause_that_no_budget_allows_is_an_error_at_once(served):
    begin_pause(served.url.removeprefix("http://"), wait_s=30.0)
    remote = RemoteObject(f"{served.url}/x.tar", retry=retry_policy(longest_read_s=5))

    with pytest.raises(StorageError, match=r"asked this machine to wait, which asks to wait \d+ s"):
        remote.read(0, 9)
    assert served.asked == []


@pytest.fixture
def pauses(tmp_path, monkeypatch):
    """The folder of pauses, not made yet."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "stereogenbench-pauses"


def in_another_process(server):
    here, there = FORK.Pipe(duplex=False)
    worker = FORK.Process(target=lambda: there.send(pause_end_s(server)))
    worker.start()
    worker.join()
    return here.recv()


def test_the_folder_of_pauses_is_the_users_own(pauses):
    before_s = time.time()
    until_s = begin_pause("a:1", wait_s=20.0)

    (file,) = pauses.iterdir()
    assert stat.S_IMODE(pauses.stat().st_mode) == 0o700
    assert file.stat().st_size == 0
    assert before_s + 20 <= until_s <= time.time() + 21.1
    assert pause_end_s("a:1") == until_s
    assert pause_end_s("b:1") == 0
    assert begin_pause("a:1", wait_s=1.0) == until_s


@pytest.mark.parametrize("how", ["open to others", "a link", "a file"])
def test_a_folder_of_pauses_that_others_may_change_is_not_used(pauses, tmp_path, how):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    if how == "open to others":
        pauses.mkdir()
        pauses.chmod(0o777)
    elif how == "a link":
        pauses.symlink_to(elsewhere)
    else:
        pauses.touch()

    until_s = begin_pause("c:1", wait_s=20.0)

    assert pause_end_s("c:1") == until_s
    assert not any(elsewhere.iterdir())
    assert pauses.is_file() or not any(pauses.iterdir())


def test_a_pause_that_ends_in_a_far_future_is_none(pauses):
    begin_pause("d:1", wait_s=0.0)
    (file,) = pauses.iterdir()
    os.utime(file, (time.time() + 1e6,) * 2)

    assert pause_end_s("d:1") <= time.time() + 2


def test_a_server_with_an_ipv6_address_is_read():
    def whole(start, stop):
        yield answering_head(start, stop) + DATA[start:stop]

    with raw_serving(whole, host="::1") as url:
        assert url.startswith("http://[::1]:")
        assert RemoteObject(f"{url}/x.tar").read(0, 9) == DATA[:9]


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


def test_a_forked_process_closes_the_connections_that_it_inherits(served):
    RemoteObject(f"{served.url}/x.tar").read(0, 9)
    assert len(connections_to(served.url)) == 1
    here, there = FORK.Pipe(duplex=False)

    def count():
        inherited = connections_to(served.url)
        data = RemoteObject(f"{served.url}/x.tar").read(9, 18)
        there.send((inherited, connections_to(served.url), data))

    worker = FORK.Process(target=count)
    worker.start()
    worker.join()
    inherited, own, data = here.recv()

    assert inherited == set()
    assert len(own) == 1
    assert data == DATA[9:18]
    assert RemoteObject(f"{served.url}/x.tar").read(18, 27) == DATA[18:27]
    assert served.connections == 2


def test_a_server_that_fails_one_request_in_twenty_costs_no_byte(served):
    remote = RemoteObject(f"{served.url}/x.tar", retry=retry_policy(first_wait_s=0.001))
    faults = [Answer(status=503), Answer(stop_after=100), Answer(status=500)]
    served.answers = [
        faults[number // 20 % 3] if number % 20 == 19 else Answer() for number in range(200)
    ]
    starts = range(0, 200_000, 1000)

    assert all(remote.read(start, start + 1000) == DATA[start : start + 1000] for start in starts)
    assert 205 <= len(served.asked) <= 215


NOW = "Mon, 02 Feb 2026 07:00:00 GMT"
POLICY = {"Statement": [{"Condition": {"DateLessThan": {"AWS:EpochTime": 1770015700}}}]}
ENCODED = base64.b64encode(json.dumps(POLICY).encode()).decode()


@pytest.mark.parametrize(
    ("query", "left_s"),
    [
        ("X-Amz-Date=20260202T065900Z&X-Amz-Expires=100&X-Amz-Signature=s", 40),
        ("X-Goog-Date=20260202T070000Z&X-Goog-Expires=100&X-Goog-Signature=s", 100),
        ("Expires=1770015650&Signature=s&Key-Pair-Id=k", 50),
        (f"Policy={ENCODED.replace('+', '-').replace('=', '_')}&Signature=s", 100),
        (f"Expires=1770015650&Policy={ENCODED.replace('=', '_')}", 50),
        ("se=2026-02-02T07:00:30Z&sig=s", 30),
        ("Expires=1770015500", 0),
        ("X-Amz-Date=20260202T065900Z&X-Amz-Signature=s", 0),
        ("X-Amz-Date=yesterday&X-Amz-Expires=100", 0),
        ("Expires=nan", 0),
        ("Expires=x", 0),
        ("Policy=AAAA", 0),
        ("a=b", 0),
        ("", 0),
    ],
)
def test_a_signed_url_says_how_long_it_is_valid(query, left_s):
    assert signed_for_s(f"https://h/x?{query}", NOW) == left_s


def test_a_web_servers_signed_url_is_kept_and_resolved_again_when_it_is_refused(served):
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
