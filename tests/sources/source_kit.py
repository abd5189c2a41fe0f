"""What every source of bytes must do: a kit that the tests of each kind of source subclass.

A subclass says where the scenes of `small_release` are, with a fixture ``root``; where they do not
lie in shards it says so with a fixture ``index``. Everything else is held here.
"""

import pickle
import re
from dataclasses import replace
from pathlib import Path

import pytest

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Member
from stereogenbench_data.schema.release import BASELINE_JSON
from stereogenbench_data.sources.location import is_remote, joined, local_path, shown
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.ranged_file import FileSlice
from stereogenbench_data.sources.remote import RemoteObject
from tests.sources.policies import waits_noted

VIDEO = "cam_00_rgb.mp4"


def read_range(place, start, stop):
    """Return the bytes from start to stop of a file, local or by URL."""
    if is_remote(place):
        return RemoteObject(str(place)).read(start, stop)
    with FileSlice(local_path(place), Member("", start, stop - start)) as file:
        return file.read()


def size_of(place):
    """Return the size in bytes of a file, local or by URL."""
    return RemoteObject(place).size() if is_remote(place) else local_path(place).stat().st_size


def bytes_of(opened):
    """Return all bytes of what a source opened: a path, or an open file, which is closed."""
    if isinstance(opened, Path):
        return opened.read_bytes()
    with opened:
        return opened.read()


class SourceTests:
    """The contract of `MemberSource` and what it reads through, for one kind of place.

    Each kind gives a fixture ``root``: where the data are, a folder or a URL. Where another fixture
    is just that, ``place`` names it.
    """

    place = ""

    @pytest.fixture
    def root(self, request):
        return request.getfixturevalue(self.place)

    @pytest.fixture
    def index(self, small_shards):
        """The index of the data, opened beside them on this machine."""
        return SceneIndex.open(small_shards)

    @pytest.fixture
    def cache(self):
        """A cache of members, or None."""
        return

    @pytest.fixture
    def make_source(self, root, index, cache):
        """Make a source of the data that compares all checksums."""

        def make(**how):
            options = {"shards": index.shards, "revision": index.digest, "cache": cache}
            return MemberSource(root, check="opened", **(options | how))

        return make

    @pytest.fixture
    def scene(self, index):
        return index.scene(0)

    @pytest.fixture
    def released(self, small_release, scene):
        """Return the released bytes of a file of the scene."""
        return lambda name: (small_release / scene.id.key / name).read_bytes()

    @pytest.fixture
    def alter(self, scene):
        """Return the scene with one member altered."""

        def alter(name, **fields):
            altered = replace(scene.members[name], **fields)
            return replace(scene, members={**scene.members, name: altered})

        return alter

    def test_the_index_can_be_opened_where_the_data_are(self, root, index):
        opened = SceneIndex.open(root)

        assert opened.digest == index.digest
        assert opened.root == str(root)

    def test_every_file_of_a_scene_has_the_released_bytes(self, make_source, scene, released):
        source = make_source()

        for name in scene.members:
            assert bytes_of(source.open(scene, name)) == released(name), name

    def test_a_part_of_a_file_is_read_from_its_middle(self, make_source, scene, released):
        opened = make_source().open(scene, VIDEO)
        with opened.open("rb") if isinstance(opened, Path) else opened as file:
            file.seek(100)

            assert file.read(50) == released(VIDEO)[100:150]
            assert file.read() == released(VIDEO)[150:]

    def test_a_range_and_the_size_of_a_file_are_those_requested(self, root, scene, released):
        member, url = scene.members[VIDEO], joined(str(root), scene.members[VIDEO].path)

        assert read_range(url, member.offset + 5, member.offset + 25) == released(VIDEO)[5:25]
        assert size_of(url) >= member.offset + member.size

    def test_a_file_that_is_not_there_is_named_with_a_cure(self, make_source, alter, root):
        scene = alter(BASELINE_JSON, path="none/file.json", offset=0)
        place = re.escape(shown(joined(str(root), "none/file.json")))

        with pytest.raises(StorageError, match=rf"{place} ?: .*(Check|[Ff]etch)"):
            make_source().read(scene, BASELINE_JSON)

    def test_a_file_of_another_size_is_named(self, make_source, alter, index, scene, root):
        member = scene.members[BASELINE_JSON]
        place = joined(str(root), member.path)
        size = size_of(place)
        facts = {path: replace(each, size=size + 7) for path, each in index.shards.items()}
        altered = scene if facts else alter(BASELINE_JSON, size=member.size + 7)

        found = rf"{re.escape(shown(place))} ?: has {size} bytes, and the index says {size + 7}"
        with pytest.raises(StorageError, match=found):
            make_source(shards=facts).read(altered, BASELINE_JSON)

    def test_a_range_beyond_the_end_is_an_error(self, root, scene, monkeypatch):
        waits_noted(monkeypatch)
        place = joined(str(root), scene.members[VIDEO].path)
        size = size_of(place)

        with pytest.raises(StorageError, match=re.escape(shown(place))):
            read_range(place, size - 5, size + 5)

    @pytest.mark.parametrize("name", [VIDEO, BASELINE_JSON])
    def test_bytes_that_are_not_those_of_the_index_are_an_error(
        self, make_source, alter, scene, name
    ):
        right = scene.members[name].crc32 or 0

        with pytest.raises(ShardError, match=rf"crc32 {right:08x}, .* says {right ^ 1:08x}"):
            bytes_of(make_source().open(alter(name, crc32=right ^ 1), name))

    def test_a_copy_in_another_process_reads_the_same(self, make_source, scene, released):
        source = make_source()
        source.read(scene, BASELINE_JSON)
        copy = pickle.loads(pickle.dumps(source))

        assert bytes_of(copy.open(scene, VIDEO)) == released(VIDEO)

    def test_messages_name_the_place_and_the_file(self, make_source, scene, root):
        source = make_source()

        assert source.label(scene, VIDEO).startswith(shown(str(root)))
        assert source.label(scene, VIDEO).endswith(VIDEO)
        assert source.url(scene, VIDEO).startswith(shown(str(root)))
