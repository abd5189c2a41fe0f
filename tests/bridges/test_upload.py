"""Uploading shards by the Hub's own client, to a server that answers as the Hub does."""

import json
import os
import shutil

import pytest

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.card import MARK
from stereogenbench_data.bridges.croissant.check import check_descriptor
from tests.cli.command import run
from tests.servers.failing_server import serving
from tests.servers.hub import REPOSITORY
from tests.servers.hub_upload import TOKEN, UploadHubHandler
from tests.servers.tools import require_module


@pytest.fixture
def folder(small_shards, tmp_path):
    return shutil.copytree(small_shards, tmp_path / "shards")


@pytest.fixture
def upload_hub(tmp_path):
    require_module("huggingface_hub")
    place = tmp_path / "hub"
    place.mkdir()
    with serving(place, handler=UploadHubHandler) as server:
        yield server


def uploaded(folder, hub, home, *, token=TOKEN, **more):
    """Run the command in its own process: the client reads its settings when it is imported."""
    settings = {
        "HF_ENDPOINT": hub.url, "HF_HOME": str(home), "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1", **({"HF_TOKEN": token} if token else {}), **more,
    }  # fmt: skip
    return run("publish", "upload", folder, REPOSITORY, "--json", env=os.environ | settings)


def test_shards_index_card_and_descriptor_arrive_whole(folder, upload_hub, tmp_path):
    index = SceneIndex.open(folder)

    done = uploaded(folder, upload_hub, tmp_path / "home")

    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    there = upload_hub.folder
    for name in (*index.shards, "index.parquet", "README.md", "croissant.json"):
        assert (there / name).read_bytes() == (folder / name).read_bytes()
    assert SceneIndex.open(there).digest == index.digest
    for split in ("train", "eval_seen_map"):
        assert (there / "viewer" / f"{split}.tar").is_file()
    assert report["url"] == f"hf://datasets/{REPOSITORY}@{report['revision']}"
    descriptor = json.loads((there / "croissant.json").read_text())
    addresses = [file["contentUrl"] for file in descriptor["distribution"] if "contentUrl" in file]
    assert descriptor["url"] == f"{upload_hub.url}/datasets/{REPOSITORY}"
    start = f"{upload_hub.url}/datasets/{REPOSITORY}/resolve/{report['revision']}/"
    assert all(address.startswith(start) for address in addresses)
    for file in descriptor["distribution"]:
        if "contentUrl" in file:
            file["contentUrl"] = file["contentUrl"].removeprefix(start)
    (there / "beside.json").write_text(json.dumps(descriptor))
    assert check_descriptor(there / "beside.json") == []


def test_a_second_upload_sends_no_shard_again(folder, upload_hub, tmp_path):
    uploaded(folder, upload_hub, tmp_path / "home")

    def objects():
        folder = upload_hub.folder / ".objects"
        return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}

    before = objects()
    done = uploaded(folder, upload_hub, tmp_path / "home")

    assert done.returncode == 0, done.stderr
    assert objects() == before


def test_a_token_is_neither_printed_nor_written(folder, upload_hub, tmp_path):
    done = uploaded(folder, upload_hub, tmp_path / "home")

    assert TOKEN not in done.stdout + done.stderr
    for path in (*folder.rglob("*"), *upload_hub.folder.rglob("*")):
        assert path.is_dir() or TOKEN.encode() not in path.read_bytes()


def test_a_refused_login_says_how_to_log_in(folder, upload_hub, tmp_path):
    done = uploaded(folder, upload_hub, tmp_path / "home", token="hf_other")

    assert done.returncode == 2
    assert "the Hub refused the upload (it answers 401)" in done.stderr
    assert "hf auth login" in done.stderr
    assert "hf_other" not in done.stderr


def test_offline_mode_is_kept(folder, upload_hub, tmp_path):
    done = uploaded(folder, upload_hub, tmp_path / "home", HF_HUB_OFFLINE="1")

    assert done.returncode == 2
    assert "the Hub cannot be reached (OfflineModeIsEnabled). Check" in done.stderr
    assert not (upload_hub.folder / ".commits").exists()


def test_a_readme_of_the_user_is_not_replaced(folder, upload_hub, tmp_path):
    (folder / "README.md").write_text("mine")

    done = uploaded(folder, upload_hub, tmp_path / "home")

    assert done.returncode == 2
    assert MARK in done.stderr
    assert (folder / "README.md").read_text() == "mine"


def test_a_missing_shard_is_named_before_the_upload(folder, upload_hub, tmp_path):
    next(folder.glob("*.tar")).unlink()

    done = uploaded(folder, upload_hub, tmp_path / "home")

    assert done.returncode == 2
    assert ".tar: is missing, but the index says" in done.stderr
    assert upload_hub.asked == []
