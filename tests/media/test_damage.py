"""A file that is not what it should be is an error by name, never another picture."""

import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.decoder import fails_slice_checksums
from stereogenbench_data.media.depth import read_depth_units
from stereogenbench_data.media.video import VideoReader, read_rgb
from stereogenbench_data.schema.records import DepthEncoding

X264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p")


def depth_clip(clips, name, *codec):
    rows, columns = np.indices((64, 96))
    ramps = [rows * 300 + columns * 7 + 11 * index for index in range(48)]
    return clips.encode(
        name, "-c:v", "ffv1", "-g", "12", *codec,
        pictures=np.array(ramps, dtype="<u2"), pixel_format="gray16le",
    )  # fmt: skip


def outcome(reader, clips, index):
    """Return the painted number of a frame, or the error."""
    try:
        return clips.number(read_rgb(reader, index))
    except MediaError as error:
        return str(error)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize(("stored", "expected"), [(48, 49), (48, 45)])
def test_another_number_of_frames_is_refused_when_opened(clips, suffix, stored, expected):
    path = clips.encode(f"groups of 12.{suffix}", *X264, "-g", "12")

    with pytest.raises(MediaError, match=f"clip: holds {stored} frames where {expected} are expec"):
        VideoReader(path, name="clip", frames=expected)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("lost", [0, 20, 47])
def test_a_lost_frame_is_never_passed_over(clips, suffix, lost):
    source = clips.encode(f"intra.{suffix}", *X264, "-g", "1")
    path = clips.remuxed(source, f"without {lost}.{suffix}", without=[lost])

    try:
        with VideoReader(path, name="clip", frames=48) as reader:
            in_order = [outcome(reader, clips, index) for index in range(48)]
            from_afar = [outcome(reader, clips, index) for index in (lost, 10, 40)]
    except MediaError as error:
        in_order = from_afar = [str(error)]

    wrong = [f for index, f in enumerate(in_order) if isinstance(f, int) and f != index]
    assert (wrong, "clip: holds 47 frames where 48 are expected" in str(in_order)) == ([], True)
    assert "clip: holds 47 frames where 48 are expected" in str(from_afar[0])


def test_a_cut_matroska_file_gives_its_frames_up_to_the_cut(clips):
    source = clips.encode("groups of 12.mkv", *X264, "-g", "12")
    path = clips.folder / "cut rgb.mkv"
    path.write_bytes(source.read_bytes()[: source.stat().st_size // 2])

    with VideoReader(path, name="clip", frames=48) as reader:
        assert outcome(reader, clips, 5) == 5
        told = r"clip: (holds .. frames where 48|is cut|cannot be read)"
        with pytest.raises(MediaError, match=told):
            reader.frame(47)
        assert outcome(reader, clips, 6) == 6


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_damaged_h264_packet_spoils_its_group_and_no_other(clips, suffix):
    source = clips.encode(f"slow.{suffix}", *X264, "-g", "12", "-bf", "0", "-crf", "12")
    path = clips.damaged(source, f"damaged.{suffix}", packet=26)

    with VideoReader(path, name="a/cam_03_rgb.mp4", frames=48) as reader:
        found = [outcome(reader, clips, index) for index in (5, 26, 30, 40)]

    assert (found[0], found[3]) == (5, 40)
    assert found[1].startswith("a/cam_03_rgb.mp4: frame 26 cannot be decoded (")
    assert found[2].endswith("damaged: compare it with its checksum, or fetch it again.")


@pytest.mark.parametrize("codec", [(), ("-level", "4", "-strict", "-2")], ids=["v3", "v4"])
def test_a_damaged_ffv1_slice_is_found_by_its_checksum(clips, codec):
    source = depth_clip(clips, f"ramp{len(codec)}.mkv", *codec)
    path = clips.damaged(source, f"damaged{len(codec)}.mkv", packet=26)

    with VideoReader(path, name="clip", frames=48) as reader:
        whole = read_depth_units(reader, 25, encoding=DepthEncoding())
        with pytest.raises(MediaError, match=r"frame 26 cannot be decoded \(.* fails its checksum"):
            reader.frame(26)

    assert whole[0, 0] == 11 * 25


def test_every_changed_byte_of_an_ffv1_packet_fails_its_checksums(clips):
    packet = clips.packets(depth_clip(clips, "ramp0.mkv"))[3]

    changed = [
        packet[:at] + bytes([packet[at] ^ 1]) + packet[at + 1 :] for at in range(len(packet))
    ]

    assert not fails_slice_checksums(packet)
    assert all(fails_slice_checksums(other) for other in changed)


def test_ffv1_without_checksums_is_read(clips):
    path = depth_clip(clips, "unchecked.mkv", "-slicecrc", "0")

    with VideoReader(path, name="clip", frames=48) as reader:
        assert read_depth_units(reader, 30, encoding=DepthEncoding())[0, 0] == 330
