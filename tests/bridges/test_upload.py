"""Uploading shards by the Hub's own client, to a server that answers as the Hub does."""

import json
import re
import shutil

import pytest

from stereogenbench_data import SceneIndex
from stereogenbench_data.bridges.card import MARK
from stereogenbench_data.bridges.croissant.check import check_descriptor
from tests.cli.command import invoke
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


@pytest.fixture
def uploaded(folder, upload_hub, tmp_path, monkeypatch):
    """Run the command in this process, whose client takes our server for the Hub."""
    constants = require_module("huggingface_hub.constants")
    monkeypatch.setattr(constants, "ENDPOINT", upload_hub.url)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)

    def upload(*, token=TOKEN):
        settings = {"HF_TOKEN": token, "HF_HOME": str(tmp_path / "home")}
        return invoke("publish", "upload", folder, REPOSITORY, env=settings)

    return upload


@pytest.mark.filterwarnings("ignore")  # what the client's threads warn of would end them
def test_shards_index_card_and_descriptor_arrive_whole_and_once(folder, upload_hub, uploaded):
    index, there = SceneIndex.open(folder), upload_hub.folder

    def objects():
        return {path.name: path.stat().st_mtime_ns for path in (there / ".objects").iterdir()}

    done = uploaded()
    assert done.exit_code == 0, done.stderr
    sent = objects()
    again = uploaded()

    assert again.exit_code == 0, again.stderr
    assert objects() == sent
    assert TOKEN not in done.stdout + done.stderr
    for path in (*folder.rglob("*"), *there.rglob("*")):
        assert path.is_dir() or TOKEN.encode() not in path.read_bytes()
    for name in (*index.shards, "index.parquet", "README.md", "croissant.json"):
        assert (there / name).read_bytes() == (folder / name).read_bytes()
    assert SceneIndex.open(there).digest == index.digest
    for split in ("train", "eval_seen_map"):
        assert (there / "viewer" / f"{split}.tar").is_file()
    revision = re.search(rf"'hf://datasets/{REPOSITORY}@(\w+)'", again.stdout)[1]
    descriptor = json.loads((there / "croissant.json").read_text())
    addresses = [file["contentUrl"] for file in descriptor["distribution"] if "contentUrl" in file]
    assert descriptor["url"] == f"{upload_hub.url}/datasets/{REPOSITORY}"
    start = f"{upload_hub.url}/datasets/{REPOSITORY}/resolve/{revision}/"
    assert all(address.startswith(start) for address in addresses)
    for file in descriptor["distribution"]:
        if "contentUrl" in file:
            file["contentUrl"] = file["contentUrl"].removeprefix(start)
    (there / "beside.json").write_text(json.dumps(descriptor))
    assert check_descriptor(there / "beside.json") == []


def test_a_refused_login_says_how_to_log_in(uploaded):
    done = uploaded(token="hf_other")

    assert done.exit_code == 2
    assert "the Hub refused the upload (it answers 401)" in done.stderr
    assert "hf auth login" in done.stderr
    assert "hf_other" not in done.stderr


def test_offline_mode_is_kept(upload_hub, uploaded, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    done = uploaded()

    assert done.exit_code == 2
    assert "the Hub cannot be reached (OfflineModeIsEnabled). Check" in done.stderr
    assert not (upload_hub.folder / ".commits").exists()


def test_a_readme_of_the_user_is_not_replaced(folder):
    (folder / "README.md").write_text("mine")

    done = invoke("publish", "upload", folder, REPOSITORY)

    assert done.exit_code == 2
    assert MARK in done.stderr
    assert (folder / "README.md").read_text() == "mine"


@pytest.mark.filterwarnings("ignore::stereogenbench_data.index.table.StaleIndexWarning")
def test_a_missing_shard_is_named_before_the_upload(folder):
    next(folder.glob("*.tar")).unlink()

    done = invoke("publish", "upload", folder, REPOSITORY)

    assert done.exit_code == 2
    assert ".tar: is missing, but the index says" in done.stderr
