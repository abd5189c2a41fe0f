"""How long a tree behind a URL is waited for: as long as the user says, wherever it is read."""

import os
import shutil
import time
from pathlib import Path

import fsspec
import numpy as np
import pytest

from stereogenbench_data import RetryPolicy, SceneIndex, StereoPairs
from stereogenbench_data.errors import StorageError
from tests.sources.policies import retry_policy

SHORT = RetryPolicy(timeout_s=0.1)
"""Gives up after a quarter of a second; the usual policy tries for more than five."""


class UnsteadyStore(fsspec.AbstractFileSystem):
    """Files of this machine. Each call for a path fails ``failures[name of the call]`` times."""

    protocol = "unsteady"
    cachable = False
    failures: dict[str, int]
    seen: dict[tuple[str, str], int]

    def ls(self, path, **options):
        self._fail("ls", path)
        return [self.info(each) for each in Path(path).iterdir()]

    def find(self, path, **options):
        self._fail("find", path)
        found = [each for each in Path(path).rglob("*") if each.is_file()]
        return {str(each): self.info(each) for each in found}

    def info(self, path, **options):
        path = Path(self._strip_protocol(str(path)))
        kind = "directory" if path.is_dir() else "file"
        stat = path.stat()
        return {"name": str(path), "type": kind, "size": stat.st_size, "mtime": stat.st_mtime}

    def cat_file(self, path, start=None, end=None, **options):
        self._fail("cat_file", path)
        return Path(path).read_bytes()[start:end]

    def _fail(self, name, path):
        number = self.seen[name, path] = self.seen.get((name, path), 0) + 1
        if number <= self.failures.get(name, 0):
            raise ConnectionResetError(f"{name} failed")


pytestmark = pytest.mark.filterwarnings("ignore:.*not opened yet:UserWarning")


@pytest.fixture
def store(monkeypatch):
    fsspec.register_implementation("unsteady", UnsteadyStore, clobber=True)
    monkeypatch.setattr(UnsteadyStore, "failures", {}, raising=False)
    monkeypatch.setattr(UnsteadyStore, "seen", {}, raising=False)
    return UnsteadyStore


@pytest.fixture(params=["few scenes, all read", "many scenes, unopened"])
def folder(request, small_release, tmp_path):
    if request.param.startswith("few"):
        return small_release
    (drawn,) = small_release.glob("eval/*/Uniform/*/*")
    for number in range(8):
        key = f"train/Uniform/Map/scene_{number:06d}"
        shutil.copytree(drawn, tmp_path / "many" / key, copy_function=os.link)
    return tmp_path / "many"


CALLS = ("ls", "find", "cat_file")


def test_a_store_that_fails_at_first_is_asked_as_often_as_the_user_says(store, folder):
    store.failures = dict.fromkeys(CALLS, 2)

    index = SceneIndex.open(f"unsteady://{folder}", retry=retry_policy(attempts=3))

    local = SceneIndex.open(folder)
    read = index.with_baselines().column("baselines_cm")
    np.testing.assert_array_equal(read, local.column("baselines_cm"))
    a, b = (StereoPairs(each, fields=("left", "disparity"))[0] for each in (index, local))
    np.testing.assert_array_equal(a["disparity"], b["disparity"])


@pytest.mark.parametrize("call", CALLS)
def test_no_call_is_made_more_often_than_the_user_says(store, folder, call):
    store.failures = {call: 2}

    if call == "find" and not (folder / "train/Uniform/Map").exists():
        SceneIndex.open(f"unsteady://{folder}")  # few scenes are listed one by one
        return
    with pytest.raises(StorageError, match=r"\(ConnectionResetError[^)]*; 2 tries\)"):
        SceneIndex.open(f"unsteady://{folder}", retry=retry_policy(attempts=2))


@pytest.mark.parametrize("call", ["ls", "cat_file"])
def test_a_short_time_limit_ends_the_wait_for_a_store_that_is_down(store, folder, call):
    store.failures = {call: 10**6}
    began_s = time.monotonic()

    with pytest.raises(StorageError, match=r"slower than timeout_s=0\.1"):
        SceneIndex.open(f"unsteady://{folder}", retry=SHORT)

    assert time.monotonic() - began_s < 8


def test_a_short_time_limit_holds_for_scenes_that_are_read_when_they_are_needed(store, folder):
    pairs = StereoPairs(SceneIndex.open(f"unsteady://{folder}", retry=SHORT), fields=("left",))
    store.failures = {"cat_file": 10**6}
    store.seen.clear()
    began_s = time.monotonic()

    with pytest.raises(StorageError, match=r"slower than timeout_s=0\.1"):
        pairs[len(pairs) // 2]

    assert time.monotonic() - began_s < 8
