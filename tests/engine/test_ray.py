"""Batch commands on Ray, tested in a process of its own.

Forks of a process that used Ray 2.60 die in its library, and other tests fork.
"""

import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from stereogenbench_data import engine
from stereogenbench_data.engine import RayCluster
from stereogenbench_data.errors import ExtraError, StorageError
from tests.servers.tools import require_module


def test_every_case_of_ray_passes():
    require_module("ray")
    cases = Path(__file__).with_name("ray_cases.py")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-rs"]
    # Ray 2.45 leaves /dev/null open.
    command += ["-W", "ignore::pytest.PytestUnraisableExceptionWarning", str(cases)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


class RayStandIn:
    """In place of the module: it finds an address, is not connected, and cannot be."""

    def __init__(self, error, found):
        self.error, self.asked = error, []
        services = SimpleNamespace(canonicalize_bootstrap_address={"auto": found}.get)
        self._private = SimpleNamespace(services=services)

    def is_initialized(self):
        return False

    def init(self, **options):
        self.asked.append(options["address"])
        raise self.error


def refusal(monkeypatch, address, *, error=None, found=None):
    """Return what a cluster at an address is refused with, and the addresses that Ray was given."""
    ray = RayStandIn(error or ConnectionError("not reached"), found)
    monkeypatch.setitem(sys.modules, "ray", ray)
    with pytest.raises((StorageError, ExtraError)) as caught:
        list(RayCluster(address).map(print, [1], name=str))
    return str(caught.value), ray.asked


@contextmanager
def answering(answer):
    """Yield the address of a server that answers whoever connects, or says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            connection, _ = server.accept()
            with connection:
                connection.recv(100)
                if answer is not None:
                    connection.sendall(answer)
                    return
                connection.recv(1)  # until the other side gives up

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"127.0.0.1:{server.getsockname()[1]}"
        thread.join()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(engine, "_ANSWER_S", 0.2)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_at_which_nothing_is_is_refused_before_ray_waits_for_it(monkeypatch, scheme):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    address = f"{scheme}127.0.0.1:{port}"

    message, asked = refusal(monkeypatch, address)

    assert message.startswith(address)
    assert ": nothing answers there (" in message
    assert "Start a cluster with `ray start --head`" in message
    assert asked == []
    assert refusal(monkeypatch, "auto", found=address) == (message, [])
    with monkeypatch.context() as there:
        there.setenv("RAY_ADDRESS", address)
        assert refusal(there, "auto") == (message, [])
    for nowhere in ("no-such-host.invalid:6379", "127.0.0.1:99999"):
        assert refusal(monkeypatch, nowhere)[0].startswith(f"{nowhere}: nothing answers there (")


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (None, "nothing answers there (timed out)"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "what answers there is not Ray"),
        (b"", "what answers there is not Ray"),
    ],
)
def test_what_is_not_ray_is_refused_before_ray_waits_for_it(monkeypatch, answer, told):
    with answering(answer) as address:
        message, asked = refusal(monkeypatch, address)

    assert message.startswith(f"{address}: {told}")
    assert asked == []


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("error", "told"),
    [
        (
            RuntimeError("Version mismatch: The cluster was started with:\n    Ray: 2.1\n    "
                         "Python: 3.9\nThis process was started with:\n    Ray: 2.60\n"),
            "(Version mismatch: The cluster was started with: Ray: 2.1 Python: 3.9 This process "
            "was started with: Ray: 2.60). Install the same releases of Ray and of Python",
        ),
        (
            ValueError("Ray Client requires pip package `ray[client]`. If you installed ..."),
            "Run `pip install 'stereogenbench-data[ray]'`",
        ),
        (ConnectionError("ray client connection timeout"), "timeout). Start a cluster with"),
    ],
)  # fmt: skip
def test_why_ray_does_not_connect_is_told_whole_with_its_own_cure(monkeypatch, error, told):
    with answering(bytes((0, 0, 18, 4, 0, 0, 0, 0, 0))) as address:
        message, asked = refusal(monkeypatch, address, error=error)

    assert address in message
    assert told in message
    assert asked == [address]
