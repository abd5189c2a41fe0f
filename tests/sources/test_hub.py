"""The Hub's files: signed URLs kept and never shown, one commit, its cache, offline, its limits."""

import logging
import pickle
from concurrent.futures import ThreadPoolExecutor

import fsspec
import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources import hub as hub_transport
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy
from tests.servers.failing_server import Answer
from tests.servers.hub import COMMIT, REPOSITORY, hub_serving
from tests.servers.tools import require_module
from tests.sources.policies import retry_policy, waits_noted

DATA = bytes(range(256)) * 100
BRANCH = f"hf://datasets/{REPOSITORY}/x.tar"
PINNED = f"hf://datasets/{REPOSITORY}@{COMMIT}/x.tar"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "hub").mkdir()
    (tmp_path / "hub" / "x.tar").write_bytes(DATA)
    return tmp_path / "hub"


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Let huggingface_hub's cache be one of the test."""
    constants = require_module("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def hub(folder, monkeypatch):
    with hub_serving(folder, monkeypatch) as server:
        yield server


def resolved(server):
    return [(revision, name) for revision, name, _ in server.facts.get("resolved", [])]


def keep_in_cache(cache, *, commit=COMMIT, name="x.tar", content=DATA):
    """Write a file as huggingface_hub keeps it, and the branch main at its commit."""
    place = cache / f"datasets--{REPOSITORY.replace('/', '--')}"
    file = place / "snapshots" / commit / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    (place / "refs").mkdir(exist_ok=True)
    (place / "refs" / "main").write_text(commit)
    return file


def test_a_signed_url_is_kept_for_later_reads(hub):
    remote = RemoteObject(PINNED)
    for start in range(5):
        assert remote.read(start, start + 9) == DATA[start : start + 9]

    assert resolved(hub) == [(COMMIT, "x.tar")]


def test_a_signed_url_that_is_refused_is_resolved_again_within_the_attempt(hub):
    remote = RemoteObject(PINNED, retry=retry_policy(attempts=1))
    remote.read(0, 9)
    hub.facts["signatures"].clear()

    assert remote.read(9, 18) == DATA[9:18]
    assert len(resolved(hub)) == 2


def test_a_signed_url_that_is_refused_at_once_is_an_error_that_does_not_show_it(hub):
    hub.facts["signed_for_s"] = 0
    remote = RemoteObject(PINNED, retry=retry_policy(attempts=1))

    with pytest.raises(StorageError, match=r"x.tar : the server answers 403 ") as error:
        remote.read(0, 9)
    assert "secret" not in str(error.value)


def test_threads_resolve_a_signed_url_that_was_refused_once(hub):
    remote = RemoteObject(PINNED)
    remote.read(0, 9)
    hub.facts["signatures"].clear()
    hub.facts["resolved"].clear()

    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda start: remote.read(start, start + 9), range(8)))

    assert found == [DATA[start : start + 9] for start in range(8)]
    assert len(resolved(hub)) == 1


def test_the_login_goes_to_the_hub_and_not_to_its_content_network(hub, monkeypatch):
    conf = fsspec.config.conf["hf"] | {"token": "hf_mine"}
    monkeypatch.setitem(fsspec.config.conf, "hf", conf)
    RemoteObject(PINNED).read(0, 9)

    ((_, _, headers),) = hub.facts["resolved"]
    assert headers["authorization"] == "Bearer hf_mine"
    assert all("authorization" not in asked.headers for asked in hub.asked)


def test_nothing_logged_shown_or_sent_to_a_process_holds_a_signature(hub, caplog, monkeypatch):
    conf = fsspec.config.conf["hf"] | {"token": "hf_mine"}
    monkeypatch.setitem(fsspec.config.conf, "hf", conf)
    monkeypatch.setattr(RetryPolicy, "attempts", 2)
    remote = RemoteObject(PINNED)
    with caplog.at_level(logging.DEBUG):
        remote.read(0, 9)
    state = pickle.dumps(remote)
    hub.always["x.tar"] = Answer(status=500)
    with pytest.raises(StorageError, match="500") as error:
        remote.read(0, 9)

    for text in (caplog.text, repr(remote), repr(vars(remote)), str(error.value), repr(state)):
        assert "secret" not in text
        assert "hf_mine" not in text
    hub.always.clear()
    assert pickle.loads(state).read(9, 18) == DATA[9:18]


def test_what_is_read_of_a_branch_is_of_one_commit(hub):
    first, second = RemoteObject(BRANCH), RemoteObject(BRANCH)
    assert first.read(0, 9) + second.read(9, 18) == DATA[:18]

    # The branch is asked for once in a process, and only for its commit.
    assert resolved(hub) == [("main", "x.tar"), (COMMIT, "x.tar")]


def test_a_small_file_that_the_hub_sends_whole_is_read_in_parts(hub):
    hub.facts["in_git"] = ["x.tar"]
    remote = RemoteObject(PINNED, expected_size=len(DATA))

    assert remote.read(0, 9) + remote.read(300, 700) == DATA[:9] + DATA[300:700]
    assert remote.read(0, len(DATA)) == DATA
    assert remote.size() == len(DATA)


def test_a_repository_that_asks_for_consent_says_so(hub):
    hub.facts["gated"] = True

    with pytest.raises(StorageError, match=r"x.tar : .*asks for consent. .*hf auth login"):
        RemoteObject(PINNED).read(0, 9)


@pytest.mark.parametrize(
    ("headers", "wait_s"),
    [({"Retry-After": "3"}, 3.0), ({"RateLimit": '"resolvers";r=0;t=2', "Retry-After": "9"}, 3.0)],
)
def test_a_limit_of_the_hub_is_waited_for(hub, headers, wait_s, monkeypatch):
    waits = waits_noted(monkeypatch)
    hub.facts["refusals"] = [(429, headers)]

    assert RemoteObject(PINNED).read(0, 9) == DATA[:9]
    assert waits[-1] == pytest.approx(wait_s, abs=0.5)


def test_a_file_in_the_hubs_own_cache_is_read_from_there(hub, own_cache):
    file = keep_in_cache(own_cache, content=DATA[::-1])

    assert RemoteObject(PINNED, expected_size=len(DATA)).read(5, 9) == DATA[::-1][5:9]
    assert RemoteObject(PINNED).size() == len(DATA)
    assert hub.asked == []
    file.write_bytes(DATA[:100])
    with pytest.raises(StorageError, match=rf"{file} : has 100 bytes, .* index says {len(DATA)}"):
        RemoteObject(PINNED, expected_size=len(DATA)).read(5, 9)


def test_offline_the_cache_is_read_and_nothing_is_requested(hub, own_cache, monkeypatch):
    keep_in_cache(own_cache)
    monkeypatch.setattr(hub_transport, "is_offline", lambda: True)

    assert RemoteObject(BRANCH).read(5, 9) == DATA[5:9]
    with pytest.raises(StorageError, match=r"y.tar : HF_HUB_OFFLINE is set, and the file"):
        RemoteObject(BRANCH.replace("x.tar", "y.tar")).read(0, 9)
    with pytest.raises(StorageError, match=r"HF_HUB_OFFLINE is set, and the Hub's cache does not"):
        RemoteObject(BRANCH).listed()
    assert resolved(hub) == []


def test_a_path_out_of_the_repository_is_refused(hub):
    with pytest.raises(StorageError, match=r"not a file of a repository: correct the URL"):
        RemoteObject(f"hf://datasets/{REPOSITORY}@{COMMIT}/../x.tar").read(0, 9)


@pytest.mark.parametrize(
    ("url", "found"),
    [
        ("hf://datasets/a/b/c/d.tar", ("a/b", "main", "c/d.tar")),
        ("hf://datasets/a/b@refs%2Fpr%2F1/d", ("a/b", "refs/pr/1", "d")),
        ("hf://datasets/a/b", ("a/b", "main", "")),
        ("hf://a/b@v1/d", None),
        ("hf://buckets/a/b/c", None),
        ("hf://datasets/a", None),
    ],
)
def test_a_url_of_the_hub_names_repository_revision_and_path(url, found):
    assert hub_transport.HubFile.of_url(url) == found
