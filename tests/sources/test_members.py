"""Members: the file that was indexed, or an error that says what was found."""

import os
import pickle
import resource
import zlib
from dataclasses import replace
from pathlib import Path

import pytest

from stereogenbench_data import StereoPairs, errors
from stereogenbench_data.errors import SchemaError, ShardError, StereoGenBenchError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Member, ShardFacts
from stereogenbench_data.sources.location import is_remote, joined, local_path, shown
from stereogenbench_data.sources.members import MemberSource, open_local
from tests.servers.failing_server import Answer

TEXT = b"12345"


@pytest.fixture
def root(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.json").write_bytes(TEXT)
    (tmp_path / "x.tar").write_bytes(b"before" + TEXT + b"behind")
    return tmp_path


@pytest.fixture(scope="module")
def scene(small_release):
    return SceneIndex.open(small_release).scene(0)


@pytest.fixture
def in_shard(scene):
    """A scene of one file that lies in a shard, and what the index knows of that."""
    member = Member("x.tar", 6, 5, zlib.crc32(TEXT))
    return replace(scene, members={"b.json": member}), {"x.tar": ShardFacts(17, "", 1)}


def with_file(scene, member):
    return replace(scene, members={"b.json": member})


@pytest.mark.parametrize(
    "path",
    ["/etc/passwd", "../a/b.json", "", "a//b", "C:/a", "a\\b"],
)
def test_a_path_that_could_leave_the_root_is_refused(root, scene, path):
    scene = with_file(scene, Member(path, 0, 5))
    for place in (str(root), "https://example.org"):
        with pytest.raises(StorageError, match="is relative to the data's root and stays inside"):
            MemberSource(place, shards={}).open(scene, "b.json")
    with pytest.raises(StorageError, match="is relative to the data's root and stays inside"):
        open_local(root, Member(path, 6, 5))


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_in_a_shards_place_is_named_and_not_waited_for(root, in_shard, make):
    scene, shards = in_shard
    (root / "x.tar").unlink()
    make(root / "x.tar")

    with pytest.raises(ShardError, match=r"x.tar: cannot be read \(not a regular file\). .*fetch"):
        MemberSource(root, shards=shards).open(scene, "b.json")


def test_a_shard_of_which_no_size_is_known_must_hold_the_member(root):
    os.truncate(root / "x.tar", 10)

    with pytest.raises(ShardError, match="has 10 bytes, and the index says 11"):
        open_local(root, Member("x.tar", 6, 5))


@pytest.mark.parametrize("place", ["a folder", "a URL"])
def test_a_metadata_file_that_is_too_large_is_not_read(root, scene, place):
    scene = with_file(scene, Member("a/b.json", 0, 2**26))
    source = MemberSource(root if place == "a folder" else "https://example.org", shards={})

    with pytest.raises(SchemaError, match=r"b.json ?: .*this one has 67,108,864. It was not read"):
        source.read(scene, "b.json")


def test_a_pipe_in_a_files_place_is_named_and_not_waited_for(root, scene):
    os.mkfifo(root / "pipe")
    scene = with_file(scene, Member("pipe", 0, 0))

    with pytest.raises(StorageError, match=r"pipe: b.json: not a file. Put the release's own"):
        MemberSource(root, shards={}).read(scene, "b.json")


def test_a_copy_in_another_process_checks_sizes_for_itself(web, in_shard, root):
    scene, shards = in_shard
    (web.folder / "x.tar").write_bytes((root / "x.tar").read_bytes())
    source = MemberSource(web.url, shards=shards)
    source.read(scene, "b.json")
    web.always["x.tar"] = Answer(size=18)

    copy = pickle.loads(pickle.dumps(source))
    with pytest.raises(ShardError, match="has 18 bytes, and the index says 17"):
        copy.read(scene, "b.json")


@pytest.mark.parametrize(
    ("root", "expected"),
    [
        ("https://h/a/", "https://h/a/b%20c/x.tar"),
        ("https://h/a?key=1", "https://h/a/b%20c/x.tar?key=1"),
        ("https://me:word@h", "https://me:word@h/b%20c/x.tar"),
        ("s3://bucket/a", "s3://bucket/a/b c/x.tar"),
        ("hf://datasets/org/name@main", "hf://datasets/org/name@main/b c/x.tar"),
        ("zip://in::s3://bucket/all.zip", "zip://in/b c/x.tar::s3://bucket/all.zip"),
    ],
)
def test_a_path_is_joined_to_a_root(root, expected):
    assert joined(root, "b c/x.tar") == expected


def test_a_name_cannot_make_a_chain_of_a_root():
    with pytest.raises(StorageError, match=r"s3://b : holds 'a::local:', and a name with '::' in"):
        joined("s3://b", "a::local:")


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("s3://K:PW@b/x", "s3://b/x"),
        ("simplecache::https://u:PW@h/x?token=PW", "simplecache::https://h/x"),
        ("zip://a.*::simplecache::https://u:PW@h", "zip://a.*::simplecache::https://h"),
        ("http://u:P/PW@h/x", "http://h/x"),
        ("http://u:P@PW@h/x", "http://h/x"),
        ("http://u:PW@[::1/x", "http://[::1/x"),
        ("a?b", "a?b"),
        ("http:////u:PW@h/x", "http:////h/x"),
        ("hf://u:PW@datasets/a/b@main", "hf://datasets/a/b@main"),
        ("https://h/x?X-Amz-Signature=PW", "https://h/x"),
    ],
)
def test_no_login_and_no_query_of_any_link_of_a_chain_is_shown(url, told):
    assert shown(url) == told
    assert str(StorageError(f"{url}: is there; see '{url}'.")).count("PW") == 0


def test_a_url_given_as_a_path_shows_no_login():
    with pytest.raises(StorageError, match=r"http:/h/x does not exist") as caught:
        SceneIndex.open(Path("http://u:PW@h/x?key=PW"))
    assert "PW" not in str(caught.value)


def test_every_error_is_made_of_one_text_that_shows_no_login():
    kinds = [each for each in vars(errors).values() if isinstance(each, type)]
    kinds = [each for each in kinds if issubclass(each, StereoGenBenchError)]

    for kind in kinds:
        error = pickle.loads(pickle.dumps(kind("s3://K:PW@b/x: is gone.")))
        assert type(error) is kind
        assert error.args == ("s3://b/x : is gone.",)
        assert len(kind.__mro__) > 3, f"{kind} has no second base"
    assert len(kinds) > 10


@pytest.mark.parametrize(
    "url",
    ["http://u:PW@[::1/x", "http://u:PW@h:99999/x", "http://u:PW@/x"],
)
def test_a_url_that_is_none_is_named_without_its_login(url):
    with pytest.raises(StorageError, match=r"not a valid URL: correct it") as caught:
        SceneIndex.open(url)
    assert "PW" not in str(caught.value)


def test_a_file_url_is_a_path_of_this_machine(tmp_path):
    place = tmp_path / "a b"

    assert not is_remote(place.as_uri())
    assert local_path(place.as_uri()) == place
    assert is_remote("s3://bucket")
    assert not is_remote(Path("a"))


def test_too_many_open_files_are_reported_as_such(indexed_release):
    pairs = StereoPairs(indexed_release, fields=("left",))
    pairs[0]
    limits, last = resource.getrlimit(resource.RLIMIT_NOFILE), os.open(os.devnull, os.O_RDONLY)
    resource.setrlimit(resource.RLIMIT_NOFILE, (last + 1, limits[1]))
    told = []
    try:
        for opens in (lambda: pairs[len(pairs) - 1], lambda: StereoPairs(indexed_release)):
            with pytest.raises(StorageError) as caught:
                opens()
            told.append(str(caught.value))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        os.close(last)

    for text in told:
        assert "(Too many open files). Raise the limit of open files (`ulimit -n`)" in text
        assert "again" not in text
