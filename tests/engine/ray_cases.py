"""Batch commands on Ray: a cluster of two nodes on this machine, the same results."""

import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from stereogenbench_data.engine import Engine, RayCluster
from stereogenbench_data.errors import ExtraError, ShardError, StorageError
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings
from tests.cli.command import run
from tests.servers.tools import files_of, require_module


@pytest.fixture(scope="module")
def cluster():
    """Return the address of a Ray cluster of two nodes, one core each.

    They ignore Ctrl-C, as where a script started them in the background.
    """
    require_module("ray")
    from ray.cluster_utils import Cluster

    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path.cwd()))  # which workers get from their node
    node = {"num_cpus": 1, "object_store_memory": 80_000_000, "include_dashboard": False}
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    cluster = Cluster(initialize_head=True, head_node_args=node)
    cluster.add_node(**node)
    signal.signal(signal.SIGINT, before)
    yield cluster.address
    cluster.shutdown()
    monkeypatch.undo()


@pytest.fixture(scope="module")
def ray(cluster):
    """Keep one connection for most tests, so that workers import what they need once."""
    module = require_module("ray")
    module.init(address=cluster, log_to_driver=False)
    yield module
    module.shutdown()


# Tasks that die.


@dataclass(frozen=True)
class DiesOnce:
    """A task of which the first worker to report progress, on whatever item, is killed."""

    task: Callable[..., Any]
    mark: Path

    def __call__(self, item, advance):
        def advance_or_die(count):
            advance(count)
            try:
                self.mark.touch(exist_ok=False)
            except FileExistsError:
                return
            os.kill(os.getpid(), signal.SIGKILL)

        return self.task(item, advance_or_die)


@dataclass(frozen=True)
class LosesAWorker:
    """An engine of which one worker is killed on the way."""

    engine: Engine
    mark: Path

    def map(self, task, items, **how):
        return self.engine.map(DiesOnce(task, self.mark), items, **how)


# The batch commands.


def packed(folder):
    return {name: content for name, content in files_of(folder).items() if ".parts" not in name}


@pytest.mark.usefixtures("ray")
def test_a_cluster_that_loses_a_worker_gives_what_this_process_gives(small_release, tmp_path):
    """Packing training shards stands for all batch commands, which share one function."""
    mark, training = tmp_path / "died", TrainingSettings((32, 32))
    losing = LosesAWorker(RayCluster(), mark)

    pack(small_release, tmp_path / "here", training=training, workers=1)
    pack(small_release, tmp_path / "there", training=training, engine=losing)

    assert mark.exists()
    assert packed(tmp_path / "there") == packed(tmp_path / "here")


# What else Ray does.


def pid(item, advance):
    time.sleep(0.3)
    advance(item)
    return os.getpid()


def refuse_three(item, advance):
    if item == 3:
        raise ShardError("three is refused")
    return item


def always_killed(item, advance):
    os.kill(os.getpid(), signal.SIGKILL)


def begin(mark, advance):
    try:
        mark.touch()
        for _ in range(600):
            time.sleep(0.1)
    finally:
        mark.unlink()


def called(item):
    return f"item {item}"


@pytest.mark.usefixtures("ray")
def test_the_error_of_a_task_comes_as_it_is_with_the_name_of_its_item():
    with pytest.raises(ShardError, match=r"^three is refused\n.*item 3"):
        list(RayCluster().map(refuse_three, range(5), name=called))


@pytest.mark.usefixtures("ray")
def test_an_item_whose_workers_die_again_and_again_is_named():
    with pytest.raises(StorageError, match=r"^item 7: Ray did not finish it in 3 tries .* fewer"):
        list(RayCluster().map(always_killed, [7], name=called))


@pytest.mark.usefixtures("ray")
def test_closing_the_results_interrupts_tasks_that_run(tmp_path):
    mark = tmp_path / "running"

    def stop(count):
        if mark.exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(RayCluster().map(begin, [mark], name=called, advance=stop))

    assert not mark.exists()


def test_the_command_works_on_a_cluster_by_its_address_with_relative_paths(
    cluster, small_release, tmp_path
):
    """A shard for each scene."""
    pack(small_release, tmp_path / "here", target_bytes=250_000, workers=1)
    (tmp_path / "scenes").symlink_to(small_release)

    words = ("pack", "scenes", "out", "--shard-size", "250kB", "--workers", cluster)
    ended = run(*words, cwd=tmp_path)

    assert ended.returncode == 0, ended.stderr
    assert "4 shards packed, 0 kept" in ended.stdout
    assert packed(tmp_path / "out") == packed(tmp_path / "here")


def test_where_no_cluster_runs_none_is_started(monkeypatch):
    module = require_module("ray")

    def nowhere(**how):
        assert how["address"] == "auto"
        raise ConnectionError("Could not find any running Ray instance.")

    monkeypatch.setattr(module, "is_initialized", lambda: False)
    monkeypatch.setattr(module, "init", nowhere)

    match = r"auto: no Ray cluster .* Start a cluster with `ray start"
    with pytest.raises(StorageError, match=match):
        list(RayCluster().map(pid, [1], name=called))


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)

    with pytest.raises(ExtraError, match=r"pip install 'stereogenbench-data\[ray\]'"):
        list(RayCluster().map(pid, [1], name=called))
