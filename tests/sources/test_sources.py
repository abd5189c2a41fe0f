"""Every kind of place that bytes are read from, held to the one contract of `SourceTests`."""

import fsspec
import pytest

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.cache import ShardCache
from tests.servers.failing_server import serving
from tests.servers.hub import COMMIT, REPOSITORY
from tests.sources.source_kit import BASELINE_JSON, SourceTests


class TestReleasedFolder(SourceTests):
    place = "indexed_release"

    @pytest.fixture
    def index(self, indexed_release):
        return SceneIndex.open(indexed_release)

    # The files of a released folder have no checksums in its index.
    test_bytes_that_are_not_those_of_the_index_are_an_error = None


class TestShards(SourceTests):
    place = "small_shards"


class TestHttp(SourceTests):
    @pytest.fixture
    def server(self, small_shards):
        with serving(small_shards) as server:
            yield server

    @pytest.fixture
    def root(self, server):
        return server.url

    def test_no_byte_is_sent_but_those_requested(self, server, index, make_source, scene):
        member = scene.members[BASELINE_JSON]
        make_source().read(scene, BASELINE_JSON)

        assert server.sent == member.size
        assert len(server.asked) == 1


class TestReleasedFolderOverHttp(TestReleasedFolder):
    @pytest.fixture
    def root(self, small_release, tmp_path):
        with serving(small_release) as server:
            yield server.url

    # A web server does not list its folders: the index comes from elsewhere.
    test_the_index_can_be_opened_where_the_data_are = None


class TestNginx(SourceTests):
    place = "nginx"


class TestHub(SourceTests):
    @pytest.fixture
    def root(self, hub):
        return f"hf://datasets/{REPOSITORY}@{COMMIT}"


class TestS3(SourceTests):
    place = "s3"


class TestOtherFileSystem(SourceTests):
    """Whatever fsspec opens; here its file system in memory."""

    @pytest.fixture
    def root(self, small_shards):
        files = fsspec.filesystem("memory")
        for path in small_shards.iterdir():
            if path.is_file():
                files.pipe_file(f"/data/{path.name}", path.read_bytes())
        yield "memory://data"
        files.rm("/data", recursive=True)


class TestCached(TestHttp):
    @pytest.fixture
    def cache(self, tmp_path):
        return ShardCache(tmp_path / "cache", limit_bytes=10**8)
