"""Tar as shards are made of: its bytes against tarfile and GNU tar, and what it never holds."""

import io
import subprocess
import tarfile

import pytest

from stereogenbench_data.errors import ShardError
from stereogenbench_data.shards.tar import member_header, read_chunks
from tests.servers.tools import require_tool
from tests.shards.shard_files import tar_of

LONG = f"train/{'f' * 60}/{'m' * 60}/scene_000041.cam_00_rgb.mp4"


TWO = [("a/one.json", b"{}" * 300), ("a/one.cam_00_rgb.mp4", bytes(range(256)) * 8)]


@pytest.mark.parametrize("name", ["a.json", "train/Uniform/Town/scene_000041.cam_00_rgb.mp4", LONG])
@pytest.mark.parametrize("size", [1, 8**11 - 1])
def test_a_header_is_the_one_that_tarfile_writes(name, size):
    """But for the two device numbers, in which its versions differ, and so the checksum."""
    info = tarfile.TarInfo(name)
    info.size, info.mode = size, 0o644

    ours, theirs = member_header(name, size), info.tobuf(tarfile.USTAR_FORMAT)

    assert len(ours) == 512
    for part in (slice(148), slice(156, 329), slice(345, 512)):
        assert ours[part] == theirs[part]


def test_a_tar_is_the_one_that_gnu_tar_writes(tmp_path):
    """But for zeros at the end, with which GNU tar fills records of 10,240 bytes."""
    for name, content in TWO:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    subprocess.run(
        [require_tool("tar"), "--format=ustar", "--mtime=@0", "--owner=0", "--group=0",
         "--numeric-owner", "--mode=0644", "-cf", "x.tar", *(name for name, _ in TWO)],
        cwd=tmp_path, check=True,
    )  # fmt: skip

    assert (tmp_path / "x.tar").read_bytes() == tar_of(TWO).ljust(10240, b"\0")


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("a/ä.json", 1),
        (f"a/{'x' * 101}", 1),
        (f"{'f' * 80}/{'g' * 120}/x", 1),
        ("a.mp4", -1),
        ("a.mp4", 8**11),
    ],
)
def test_what_ustar_cannot_hold_is_not_written(name, size):
    with pytest.raises(ShardError, match=f"member '{name}': has {size} bytes, and ustar cannot"):
        member_header(name, size)


def test_a_file_that_shrinks_while_it_is_read_is_an_error():
    with pytest.raises(ShardError, match="ends 1 bytes before its size"):
        list(read_chunks(io.BytesIO(b"abc"), 4))
