"""What a file is, from few of its bytes, and counted where the header cannot be trusted."""

import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.video import probe

GROUPS_OF_12 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-g", "12")
FFV1 = ("-c:v", "ffv1", "-g", "12")


@pytest.fixture(scope="module")
def depth_clip(clips):
    noise = np.random.default_rng(0).integers(0, 65536, (48, 64, 96))
    return clips.encode(
        "noise.mkv", *FFV1, "-metadata", "DEPTH_SCALE=0.001",
        pictures=noise.astype("<u2"), pixel_format="gray16le",
    )  # fmt: skip


def test_an_mp4_is_reported_by_its_header(clips):
    facts = probe(clips.encode("groups of 12.mp4", *GROUPS_OF_12), name="clip")

    assert (facts.codec, facts.pixel_format, facts.width_px, facts.height_px) == (
        "h264", "yuv420p", 96, 64,
    )  # fmt: skip
    assert (facts.frames, facts.frame_rate_hz) == (48, 15.0)


def test_a_tag_of_the_stream_does_not_hide_the_containers(clips):
    path = clips.encode(
        "tags.mkv", *GROUPS_OF_12, "-metadata", "Scale=1", "-metadata:s:v:0", "SCALE=2"
    )

    facts = probe(path, name="clip")

    assert (facts.tags["scale"], facts.tags["stream.scale"]) == ("1", "2")


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_tag_that_is_not_utf8_can_be_read_and_printed(clips, tmp_path, suffix):
    told = clips.encode(f"comment.{suffix}", *GROUPS_OF_12, "-metadata", "comment=cafX 10 cm")
    path = tmp_path / told.name
    path.write_bytes(told.read_bytes().replace(b"cafX", b"caf\xe9"))

    assert probe(path, name="clip").tags["comment"] == "caf\N{REPLACEMENT CHARACTER} 10 cm"


@pytest.mark.parametrize("flags", ["-movflags +faststart", ""])
def test_probing_an_mp4_reads_its_header_and_first_frame(clips, flags):
    path = clips.encode(
        f"probe{flags}.mp4", *GROUPS_OF_12, *flags.split(), "-crf", "1", "-g", "1",
        pictures=clips.pictures.repeat(4, axis=1).repeat(4, axis=2),
    )  # fmt: skip
    file = clips.counting(path)

    assert probe(file, name="clip").frames == 48
    assert file.bytes_read < path.stat().st_size / 4


def test_probing_a_matroska_file_reads_its_header_and_its_last_group(clips, depth_clip):
    file = clips.counting(depth_clip)

    assert probe(file, name="clip").frames == 48
    assert file.bytes_read < 0.6 * depth_clip.stat().st_size


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize(
    ("without", "frames"),
    [((47,), 47), ((0,), 47)],
    ids=["without its last frame", "without its first frame"],
)
def test_frames_that_are_left_out_at_an_end_are_not_counted(clips, suffix, without, frames):
    source = clips.encode(f"intra.{suffix}", *GROUPS_OF_12[:4], "-g", "1")
    path = clips.remuxed(source, f"without {without}.{suffix}", without=without)

    assert probe(path, name="clip").frames == frames


def test_a_matroska_file_without_a_duration_is_counted(clips):
    source = clips.encode("groups of 12.mp4", *GROUPS_OF_12)
    path = clips.folder / "live.mkv"
    path.write_bytes(clips.ffmpeg("-i", source, "-c", "copy", "-f", "matroska", "-live", "1", "-"))

    assert probe(path, name="clip").frames == 48


def test_an_mp4_whose_payload_is_cut_tells_what_is_missing(clips):
    source = clips.encode("fast.mp4", *GROUPS_OF_12, "-movflags", "+faststart")
    size = source.stat().st_size
    path = clips.folder / "payload cut.mp4"
    path.write_bytes(source.read_bytes()[: size - 100])

    with pytest.raises(
        MediaError, match=f"clip: is cut short: .* up to byte {size}, .* {size - 100}:"
    ):
        probe(path, name="clip")
