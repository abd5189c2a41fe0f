"""Tar as shards are made of: its bytes against tarfile and GNU tar, and what is refused."""

import io
import subprocess
import tarfile
import zlib
from hashlib import sha256

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import ShardError
from stereogenbench_data.shards.tar import (
    END_OF_ARCHIVE,
    LARGEST_MEMBER_BYTES,
    TarMember,
    member_header,
    read_checksums,
    read_members,
)
from tests.servers.tools import require_tool
from tests.shards.shard_files import tar_of

LONG = f"train/{'f' * 60}/{'m' * 60}/scene_000041.cam_00_rgb.mp4"


def members_of(content):
    return read_members(io.BytesIO(content), len(content), where="x.tar")


def refused(content, *parts):
    with pytest.raises(ShardError, match=r"^x\.tar: at byte") as caught:
        members_of(content)
    for part in parts:
        assert part in str(caught.value)
    assert str(caught.value).endswith(".")
    return str(caught.value)


def python_tar(*entries, form=tarfile.USTAR_FORMAT):
    """A tar by Python's tarfile, of (TarInfo, content) each."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w", format=form) as tar:
        for info, content in entries:
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return made.getvalue()


def with_field(header, start, content):
    """A header with another field, and the checksum that then is right."""
    edited = bytearray(header)
    edited[start : start + len(content)] = content
    edited[148:156] = b" " * 8
    edited[148:156] = b"%06o\0 " % sum(edited)
    return bytes(edited)


TWO = [("a/one.json", b"{}" * 300), ("a/one.cam_00_rgb.mp4", bytes(range(256)) * 8)]


@pytest.mark.parametrize("name", ["a.json", "train/Uniform/Town/scene_000041.cam_00_rgb.mp4", LONG])
@pytest.mark.parametrize("size", [0, 1, 512, LARGEST_MEMBER_BYTES])
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


parts = st.text("abcXYZ019_-", min_size=1, max_size=50)
names = st.tuples(parts, parts, parts, st.sampled_from(["json", "cam_00_rgb.mp4", "txt"])).map(
    lambda found: f"{found[0]}/{found[1]}/{found[2]}.{found[3]}"
)
contents = st.binary(max_size=1500)


@given(st.dictionaries(names, contents, max_size=6))
@settings(max_examples=60, deadline=None)
def test_any_members_come_back_by_tarfile_and_by_our_reader(files):
    content = tar_of(files.items())

    with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as tar:
        by_tarfile = {info.name: (info.offset_data, tar.extractfile(info).read()) for info in tar}
    ours = {
        member.name: (member.offset, content[member.offset : member.offset + member.size])
        for member in members_of(content)
    }
    assert list(ours) == list(files)
    assert ours == by_tarfile
    assert {name: found[1] for name, found in ours.items()} == files


@given(st.dictionaries(names, contents, max_size=4))
@settings(max_examples=30, deadline=None)
def test_what_tarfile_writes_as_ustar_is_read(files):
    content = python_tar(*((tarfile.TarInfo(name), files[name]) for name in files))

    assert [(member.name, member.size) for member in members_of(content)] == [
        (name, len(files[name])) for name in files
    ]


def test_gnu_tar_lists_the_same_files(tmp_path):
    path = tmp_path / "x.tar"
    path.write_bytes(tar_of([*TWO, (LONG, b"film")]))

    listed = subprocess.run(
        [require_tool("tar"), "-tvf", path], capture_output=True, text=True, check=True
    )

    assert listed.stderr == ""
    lines = [line.split() for line in listed.stdout.splitlines()]
    assert [(line[0], line[1], int(line[2]), line[-1]) for line in lines] == [
        ("-rw-r--r--", "0/0", 600, "a/one.json"),
        ("-rw-r--r--", "0/0", 2048, "a/one.cam_00_rgb.mp4"),
        ("-rw-r--r--", "0/0", 4, LONG),
    ]


def test_members_are_reported_with_where_their_bytes_begin():
    assert members_of(tar_of(TWO)) == [
        TarMember("a/one.json", 512, 600),
        TarMember("a/one.cam_00_rgb.mp4", 512 + 1024 + 512, 2048),
    ]


def test_padding_to_whole_records_as_tar_writes_it_is_read():
    content = tar_of(TWO)

    assert members_of(content + bytes(10240 - len(content))) == members_of(content)


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("/etc/passwd", "not a relative path"),
        ("../x.json", "not a relative path"),
        ("a/../x.json", "not a relative path"),
        ("a//x.json", "not a relative path"),
        ("a\\x.json", "not a relative path"),
        ("C:x.json", "not a relative path"),
        ("a/ä.json", "not a relative path in ASCII"),
        ("a/x\n.json", "not a relative path"),
        ("", "not a relative path"),
        ("a/x.pkl", r"code that runs when it is loaded \(\.pkl\)"),
        ("a/x.PyD", r"\(\.pyd\)"),
        ("a/x.pth.gz", r"\(\.pth\)"),
        (f"a/{'x' * 101}", "has 103 characters, and ustar holds 100"),
        (f"{'f' * 80}/{'g' * 120}/x", "Shorten its folders' names"),
    ],
)
def test_a_name_that_no_shard_may_hold_is_not_written(name, match):
    with pytest.raises(ShardError, match=match):
        member_header(name, 1)


@pytest.mark.parametrize("size", [-1, 8 * 2**30])
def test_a_size_that_ustar_cannot_hold_is_not_written(size):
    with pytest.raises(ShardError, match=f"has {size} bytes, and ustar holds 0 to 8589934591"):
        member_header("a.mp4", size)


@pytest.mark.parametrize(
    ("length", "parts"),
    [
        (0, ("byte 0, after its start,", "nothing of a header")),
        (100, ("byte 0, after its start,", "only 100 of the 512 bytes of a header")),
        (512 + 300, ("byte 0,", "'a/one.json' claims 600 bytes", "the shard has 812")),
        (512 + 800, ("byte 0,", "'a/one.json' claims 600 bytes. With padding they end")),
        (1536, ("byte 1536, after 'a/one.json',", "nothing of a header or of the end")),
        (1536 + 511, ("byte 1536, after 'a/one.json',", "only 511 of the 512 bytes")),
        (2048 + 2047, ("'a/one.cam_00_rgb.mp4' claims 2048 bytes",)),
        (4096, ("byte 4096, after 'a/one.cam_00_rgb.mp4',", "nothing of a header or of the end")),
        (4096 + 512, ("byte 4096,", "only 512 of the 1024 zeros that end the archive")),
        (4096 + 700, ("byte 4096,", "only 700 of the 1024 zeros")),
    ],
    ids=[
        "empty", "inside the first header", "inside a payload", "inside padding", "at a header",
        "inside a header", "a byte short of a payload", "before the end", "after one end block",
        "inside the second end block",
    ],
)  # fmt: skip
def test_a_cut_tar_is_refused_with_the_place(length, parts):
    refused(tar_of(TWO)[:length], *parts, "cut short", "Fetch the shard again, or pack it again")


@pytest.mark.parametrize("cut", range(0, 5120, 97))
def test_no_cut_anywhere_goes_unseen(cut):
    refused(tar_of(TWO)[:cut])


@given(st.integers(0, 4 * 512 - 1), st.integers(1, 255))
@settings(max_examples=150, deadline=None)
def test_no_damaged_byte_of_a_header_or_of_the_end_goes_unseen(place, change):
    content = bytearray(tar_of(TWO))
    starts = (0, 1536, 4096, 4608)
    at = starts[place // 512] + place % 512
    content[at] ^= change

    # Leading zeros and the blanks after a checksum may be written in several ways.
    try:
        assert members_of(bytes(content)) == members_of(tar_of(TWO))
        assert at % 1536 in range(148, 156)
    except ShardError as error:
        assert "x.tar: at byte" in str(error)  # noqa: PT017


def test_a_damaged_header_is_reported_with_its_place():
    content = bytearray(tar_of(TWO))
    content[1536 + 3] ^= 1

    refused(bytes(content), "byte 1536, after 'a/one.json',", "header is damaged (bad checksum)")


def test_a_wiped_out_header_does_not_end_the_tar_early():
    content = tar_of([*TWO, ("b.json", b"")])
    wiped = content[:4096] + bytes(1024) + content[4096:]

    refused(wiped, "byte 4096,", "zeros end the archive, but other bytes follow")


@pytest.mark.parametrize(
    "kind",
    [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.DIRTYPE,
     tarfile.FIFOTYPE, tarfile.GNUTYPE_SPARSE, b"Z"],
)  # fmt: skip
def test_what_is_no_regular_file_is_refused_by_its_kind(kind):
    info = tarfile.TarInfo("a/evil.mp4")
    info.type = kind
    info.linkname = "/etc/passwd" if kind in (tarfile.SYMTYPE, tarfile.LNKTYPE) else ""

    content = info.tobuf(tarfile.USTAR_FORMAT) + END_OF_ARCHIVE
    refused(content, "member 'a/evil.mp4", f"tar kind {kind!r}")


def test_a_pax_header_is_refused():
    info = tarfile.TarInfo("a/ä.mp4")

    content = python_tar((info, b"film"), form=tarfile.PAX_FORMAT)

    refused(content, "tar kind b'x'")


def test_a_gnu_long_name_is_refused():
    info = tarfile.TarInfo(f"a/{'x' * 120}.mp4")

    refused(python_tar((info, b"film"), form=tarfile.GNU_FORMAT), "tar kind b'L'")


def test_gnu_headers_are_not_posix_ustar():
    content = python_tar((tarfile.TarInfo("a.mp4"), b"film"), form=tarfile.GNU_FORMAT)

    refused(content, "'a.mp4'", "the magic b'ustar  \\x00'")


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("/etc/passwd.json", "not a relative path"),
        ("a/../../x.json", "not a relative path"),
        ("a/x.pkl", "may hold code that runs when it is loaded (.pkl)"),
        ("a/x.pyd", "(.pyd)"),
        ("a/x.pth", "(.pth)"),
        ("a/x.npy", "(.npy)"),
    ],
)
def test_a_member_with_a_dangerous_name_is_refused(name, what):
    content = python_tar((tarfile.TarInfo(name), b"film"))

    refused(content, repr(name), what, "Do not use this shard")


def test_a_second_member_of_one_name_is_refused():
    refused(tar_of([TWO[0], TWO[0]]), "'a/one.json' occurs a second time")


def test_ten_gigabytes_are_not_believed_in_octal():
    """Twelve octal digits, without the byte that ends them."""
    header = with_field(member_header("a.mp4", 1), 124, b"%012o" % 10_000_000_000)

    refused(header + END_OF_ARCHIVE, "'a.mp4' claims 10000000000 bytes", "the size is wrong")


def test_ten_gigabytes_are_not_believed_in_binary():
    header = with_field(
        member_header("a.mp4", 1), 124, b"\x80" + (10_000_000_000).to_bytes(11, "big")
    )

    refused(header + END_OF_ARCHIVE, "'a.mp4' claims 10000000000 bytes", "the size is wrong")


def test_a_negative_size_is_refused():
    header = with_field(member_header("a.mp4", 1), 124, b"\xff" * 10 + b"\xfe\x00")

    refused(header + END_OF_ARCHIVE, "'a.mp4' has the size -512")


def test_checksums_are_of_the_whole_and_of_the_parts_requested():
    content = tar_of(TWO)
    seen = []

    found = read_checksums(
        io.BytesIO(content), len(content), parts=[(512, 600), (2048, 2048)],
        after_bytes=seen.append,
    )  # fmt: skip

    assert found.sha256 == sha256(content).hexdigest()
    assert found.crc32s == (zlib.crc32(TWO[0][1]), zlib.crc32(TWO[1][1]))
    assert sum(seen) == len(content)


def test_a_file_that_shrinks_while_it_is_read_is_an_error():
    with pytest.raises(ShardError, match="ends 1 bytes before its size"):
        read_checksums(io.BytesIO(b"abc"), 4, parts=[], after_bytes=lambda count: None)
