"""Shards, and servers that serve them on this machine."""

import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import fsspec
import numpy as np
import pytest

from stereogenbench_data.shards.pack import pack
from tests.servers.failing_server import FailingServer, serving
from tests.servers.hub import hub_serving
from tests.servers.nginx import nginx_serving
from tests.servers.tools import Once, made_once, require_module, require_tool, rewrite_json
from tests.servers.videos import write_depth, write_rgb

BUCKET = "some-bucket"
NOISE_PX = 320


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Return a folder of a name that a function has made, once for all processes of a run."""
    return partial(made_once, tmp_path_factory)


@pytest.fixture(scope="session")
def small_shards(small_release: Path, once: Once) -> Path:
    """The scenes of `small_release` in shards."""
    return once("small_shards", lambda out: pack(small_release, out, workers=1))


@pytest.fixture(scope="session")
def packed_depth(small_release: Path, once: Once) -> Path:
    """The scenes of `small_release` in shards whose depth blosc2 packed."""
    require_module("blosc2")
    how = {"depth_codec": "blosc2", "workers": 1}
    return once("packed_depth", lambda out: pack(small_release, out, **how))


@pytest.fixture
def shards(small_shards: Path, tmp_path: Path) -> Path:
    """A copy of `small_shards` that a test may damage."""
    return Path(shutil.copytree(small_shards, tmp_path / "shards"))


@pytest.fixture(scope="session")
def large_release(small_release: Path, once: Once) -> Path:
    """One scene whose videos are noise: far larger than what is fetched at once."""
    key = "train/Uniform/SynthStage/scene_000000"

    def make(root: Path) -> None:
        folder = Path(shutil.copytree(small_release / key, root / key))
        sides = {"image_width": NOISE_PX, "image_height": NOISE_PX}
        rewrite_json(folder / "baseline.json", lambda document: document.update(sides))
        noise = np.random.default_rng(0)
        size = (NOISE_PX, NOISE_PX)
        for path in folder.glob("*.mp4"):
            write_rgb(path, noise.integers(0, 255, (7, *size, 3), dtype=np.uint8))
        for path in folder.glob("*.mkv"):
            units = noise.integers(1, 65535, (7, *size), dtype=np.uint16)
            write_depth(path, units, tags={"DEPTH_SCALE": "0.1"})

    return once("large_release", make)


@pytest.fixture(scope="session")
def large_shards(large_release: Path, once: Once) -> Path:
    """The scene of `large_release` in a shard."""
    return once("large_shards", lambda out: pack(large_release, out, workers=1))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, in which a test runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def web(tmp_path: Path) -> Iterator[FailingServer]:
    """A web server that serves ``tmp_path / "web"``, counts, and fails as it is told."""
    folder = tmp_path / "web"
    folder.mkdir()
    with serving(folder) as server:
        yield server


@pytest.fixture
def nginx(tmp_path: Path, small_shards: Path) -> Iterator[str]:
    """The URL at which an nginx serves `small_shards`."""
    program = require_tool("nginx")
    with nginx_serving(small_shards, home=tmp_path / "nginx", program=program) as url:
        yield url


@pytest.fixture
def hub(small_shards: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FailingServer]:
    """A Hub whose data set is `small_shards`."""
    with hub_serving(small_shards, monkeypatch) as server:
        yield server


@pytest.fixture(scope="session")
def s3_endpoint(small_shards: Path) -> Iterator[str]:
    """The address of an S3 endpoint with `small_shards` in the folder shards of `BUCKET`."""
    require_module("s3fs")
    moto = require_module("moto.server")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    url = f"http://{host}:{port}"
    store = fsspec.filesystem("s3", key="key", secret="word", endpoint_url=url)
    store.mkdir(BUCKET)
    for path in sorted(small_shards.iterdir()):
        if path.is_file():
            store.put_file(str(path), f"{BUCKET}/shards/{path.name}")
    yield url
    server.stop()


@pytest.fixture
def s3(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL of `small_shards` in an S3 store, to which ``s3://`` is pointed."""
    conf = {"key": "key", "secret": "word", "endpoint_url": s3_endpoint}
    monkeypatch.setitem(fsspec.config.conf, "s3", conf)
    return f"s3://{BUCKET}/shards"
