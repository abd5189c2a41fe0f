"""What a file is, from few of its bytes, and counted where the header cannot be trusted."""

import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.video import probe

GROUPS_OF_12 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-g", "12")


def test_a_file_is_reported_by_its_header(clips):
    """A tag of the stream does not hide the container's."""
    path = clips.encode(
        "tags.mkv", *GROUPS_OF_12, "-metadata", "Scale=1", "-metadata:s:v:0", "SCALE=2"
    )

    facts = probe(path, name="clip")

    stored = (facts.codec, facts.pixel_format, facts.width_px, facts.height_px)
    assert stored == ("h264", "yuv420p", 96, 64)
    assert (facts.frames, facts.frame_rate_hz) == (48, 15.0)
    assert (facts.tags["scale"], facts.tags["stream.scale"]) == ("1", "2")


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_tag_that_is_not_utf8_can_be_read_and_printed(clips, tmp_path, suffix):
    told = clips.encode(f"comment.{suffix}", *GROUPS_OF_12, "-metadata", "comment=cafX 10 cm")
    path = tmp_path / told.name
    path.write_bytes(told.read_bytes().replace(b"cafX", b"caf\xe9"))

    assert probe(path, name="clip").tags["comment"] == "caf\N{REPLACEMENT CHARACTER} 10 cm"


@pytest.mark.parametrize(
    ("name", "codec", "most"),
    [
        ("large.mp4", GROUPS_OF_12[:4], 0.25),
        ("large fast.mp4", (*GROUPS_OF_12[:4], "-movflags", "+faststart"), 0.25),
        ("large.mkv", ("-c:v", "ffv1"), 0.6),
    ],
)
def test_probing_reads_a_header_and_a_first_frame_or_a_last_group(clips, name, codec, most):
    pictures = clips.pictures.repeat(4, axis=1).repeat(4, axis=2)
    quality = ("-crf", "1", "-g", "1") if "mp4" in name else ("-g", "12")
    path = clips.encode(f"probe {name}", *codec, *quality, pictures=pictures)
    file = clips.counting(path)

    assert probe(file, name="clip").frames == 48
    assert file.bytes_read < most * path.stat().st_size


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

    with pytest.raises(MediaError, match=f"clip: .* up to byte {size}, .* {size - 100}:"):
        probe(path, name="clip")
