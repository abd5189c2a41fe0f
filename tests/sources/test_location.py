"""Locations as they are typed: homes, and folders whose names begin with a tilde."""

from pathlib import Path

import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.sources.location import local_path


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/homes/me")
    return tmp_path


@pytest.mark.parametrize("name", ["~", "~root", "~foo"])
def test_a_folder_whose_name_begins_with_a_tilde_is_that_folder(here, name):
    (here / name / "shards").mkdir(parents=True)

    for text in (name, f"./{name}"):
        assert local_path(text) == here / name
        assert local_path(f"{text}/shards") == here / name / "shards"
        assert local_path(Path(text)) == here / name


def test_a_tilde_is_a_home_where_no_such_folder_is():
    assert local_path("~/shards") == Path("/homes/me/shards")


def test_a_tilde_after_a_dot_is_never_a_home(here):
    assert local_path("./~") == here / "~"


def test_a_name_that_is_neither_a_folder_nor_a_user_is_named():
    with pytest.raises(StorageError, match="~nobody-of-this-name: there is neither such a folder"):
        local_path("~nobody-of-this-name")
