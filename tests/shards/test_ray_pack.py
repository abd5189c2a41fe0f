"""Packing on Ray: a real runtime on this machine, the same bytes."""

import os
import shutil
import subprocess
import sys

import pytest

from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.shards import ray_pack
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.ray_pack import pack_on_ray
from tests.servers.tools import require_module

ONE_EACH = 250_000


@pytest.fixture(scope="module")
def ray():
    """A Ray runtime of two processes, on loopback."""
    module = require_module("ray")
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    module.init(
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        configure_logging=False,
        _node_ip_address="127.0.0.1",
        object_store_memory=100_000_000,
    )
    yield module
    module.shutdown()
    monkeypatch.undo()


@pytest.fixture
def release(small_release):
    return SceneIndex.open(small_release)


def bytes_of(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and ".parts" not in path.parts
    }


@pytest.fixture
def packed_here(release, tmp_path):
    pack(release, tmp_path / "here", target_bytes=ONE_EACH, workers=1)
    return bytes_of(tmp_path / "here")


@pytest.mark.usefixtures("ray")
def test_ray_packs_the_same_bytes(release, tmp_path, packed_here):
    seen = []

    report = pack_on_ray(
        release, tmp_path / "out", target_bytes=ONE_EACH, progress=lambda *now: seen.append(now)
    )

    assert bytes_of(tmp_path / "out") == packed_here
    assert len(report.packed) == 4
    assert seen[0][0] == 0
    assert seen[-1][0] == seen[-1][1] > 0


@pytest.mark.usefixtures("ray")
def test_ray_and_processes_share_one_plan_and_ray_stays_connected(
    ray, release, tmp_path, packed_here
):
    out = tmp_path / "out"
    pack(release, out, target_bytes=ONE_EACH, part=(1, 2), workers=1)

    report = pack_on_ray(release, out, target_bytes=ONE_EACH)

    assert len(report.packed) == 2
    assert bytes_of(out) == packed_here
    assert ray.is_initialized()


@pytest.mark.usefixtures("ray")
def test_an_error_on_ray_is_the_one_of_packing(small_release, tmp_path):
    tree = shutil.copytree(small_release, tmp_path / "tree")
    index = SceneIndex.open(tree)
    next(tree.glob("train/Uniform/*/scene_000001/cam_03_depth.mkv")).unlink()

    with pytest.raises(ShardError, match=r"cam_03_depth\.mkv: cannot be read \(No such file"):
        pack_on_ray(index, tmp_path / "out", target_bytes=ONE_EACH)

    assert list((tmp_path / "out").glob("*.tmp")) == []


@pytest.mark.usefixtures("ray")
def test_a_task_that_ray_loses_is_an_error(release, tmp_path, monkeypatch):
    monkeypatch.setattr(ray_pack, "_pack_quietly", lambda task: os._exit(9))

    with pytest.raises(ShardError, match=r"Ray lost its task .*Run the same command again"):
        pack_on_ray(release, tmp_path / "out")


def test_the_command_packs_on_a_cluster_that_runs(ray, small_release, tmp_path, packed_here):
    address = ray.get_runtime_context().gcs_address

    ended = subprocess.run(
        [sys.executable, "-m", "stereogenbench_data.cli.main", "pack", small_release,
         tmp_path / "out", "--shard-size", "250kB", "--engine", "ray"],
        env={**os.environ, "RAY_ADDRESS": address}, capture_output=True, text=True, check=False,
    )  # fmt: skip

    assert ended.returncode == 0, ended.stderr
    assert "4 shards packed, 0 were finished before" in ended.stdout
    assert bytes_of(tmp_path / "out") == packed_here


def test_where_no_cluster_runs_none_is_started(ray, release, tmp_path, monkeypatch):
    def nowhere(**how):
        assert how["address"] == "auto"
        raise ConnectionError("Could not find any running Ray instance.")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", nowhere)

    with pytest.raises(ShardError, match=r"no Ray cluster was found .* start one with `ray start"):
        pack_on_ray(release, tmp_path)


def test_without_ray_the_extra_is_named(release, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)

    with pytest.raises(ShardError, match=r"install `stereogenbench-data\[ray\]`, or pack"):
        pack_on_ray(release, tmp_path)
