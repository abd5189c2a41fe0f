"""Ranges from real servers of each kind: nginx, an S3 endpoint, and a Hub for its own client."""

import os
import sys

import fsspec
import pytest

from stereogenbench_data.errors import ExtraError, ShardError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.remote import RemoteObject
from tests.servers.fixtures import BUCKET
from tests.servers.hub import REPOSITORY
from tests.sources.policies import retry_policy, waits_noted
from tests.sources.source_kit import read_range, size_of


@pytest.mark.parametrize(
    "path", [f"{REPOSITORY}/none.tar", f"{REPOSITORY}@other/x.tar", "nobody/nothing/x.tar"]
)
def test_what_the_hub_does_not_have_is_reported_at_once(hub, path):
    url = f"hf://datasets/{path}"
    with pytest.raises(StorageError, match=rf"{url} : does not exist, or is private. Check"):
        read_range(url, 0, 9)


def test_a_private_data_set_is_reported_without_the_token(hub, monkeypatch):
    conf = fsspec.config.conf["hf"] | {"token": "hf_expired"}
    monkeypatch.setitem(fsspec.config.conf, "hf", conf)
    url = f"hf://datasets/{REPOSITORY}/train-Uniform-000000.tar"

    with pytest.raises(StorageError, match="does not exist, or is private") as caught:
        read_range(url, 0, 9)
    assert "expired" not in str(caught.value)


def test_a_bucket_that_s3_does_not_have_is_reported_at_once(s3):
    with pytest.raises(StorageError, match=r"s3://no-bucket/x.tar : does not exist, or is private"):
        size_of("s3://no-bucket/x.tar")


def test_s3_without_a_login_is_reported_at_once(s3, monkeypatch):
    conf = {"endpoint_url": fsspec.config.conf["s3"]["endpoint_url"]}
    monkeypatch.setitem(fsspec.config.conf, "s3", conf)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", os.devnull)
    monkeypatch.setenv("AWS_CONFIG_FILE", os.devnull)

    with pytest.raises(StorageError, match=r"permission denied \(NoCredentialsError\). Log in to"):
        read_range(f"{s3}/x.tar", 0, 9)


def test_an_object_of_a_store_that_is_replaced_between_two_ranges_is_reported(s3):
    store, path = fsspec.filesystem("s3"), f"{BUCKET}/shards/changing.tar"
    store.pipe_file(path, b"0" * 1000)
    remote = RemoteObject(f"{s3}/changing.tar", retry=retry_policy(attempts=1))
    assert remote.read(0, 9) == b"0" * 9
    store.pipe_file(path, b"1" * 1000)

    with pytest.raises(ShardError, match=r"changing.tar : was replaced in its store while it was"):
        remote.read(9, 18)
    assert RemoteObject(f"{s3}/changing.tar").read(9, 18) == b"1" * 9
    store.rm(path)


def test_a_file_system_that_fails_is_requested_again(monkeypatch):
    waits = waits_noted(monkeypatch)
    files = fsspec.filesystem("memory")
    files.pipe_file("/shard.tar", b"0123456789")
    failures = [OSError("connection reset"), TimeoutError()]

    def fetched(*args, **how):
        if failures:
            raise failures.pop()
        return type(files).cat_file(files, *args, **how)

    monkeypatch.setattr(files, "cat_file", fetched)

    assert RemoteObject("memory://shard.tar").read(2, 6) == b"2345"
    assert len(waits) == 2
    files.rm("/shard.tar")


def test_a_url_that_no_file_system_opens_is_reported():
    with pytest.raises(StorageError, match=r"nope://a/b : not a URL that fsspec can open. Correct"):
        read_range("nope://a/b", 0, 9)


@pytest.mark.parametrize("url", ["ftp://127.0.0.1:1/data", "FTPS://me:word@127.0.0.1:1/data"])
def test_an_ftp_server_is_refused_before_anything_is_asked_of_it(url, monkeypatch):
    monkeypatch.setattr(fsspec.core, "url_to_fs", lambda url: pytest.fail("it was opened"))

    with pytest.raises(StorageError, match=r"(?i)ftps?://127\S* : FTP servers are not read"):
        SceneIndex.open(url)


def test_a_file_system_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)

    with pytest.raises(ExtraError, match=r"s3://a/b : .*pip install 'stereogenbench-data\[s3\]'"):
        read_range("s3://a/b", 0, 9)
