"""What a reader takes, keeps, refuses and gives back."""

import io

import pytest

from stereogenbench_data.errors import MediaError, StorageError
from stereogenbench_data.media.video import VideoReader

GROUPS_OF_12 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-g", "12")


@pytest.fixture(scope="module")
def clip(clips):
    return clips.encode("groups of 12.mp4", *GROUPS_OF_12)


@pytest.mark.parametrize("kind", [str, "path", "file"])
def test_a_path_a_string_and_an_open_file_are_read_alike(clips, clip, kind):
    file = {"path": clip, "file": io.BytesIO(clip.read_bytes())}.get(kind, str(clip))

    assert clips.shown(file, [40]) == [40]


def test_a_name_that_looks_like_an_address_is_a_file_name(clips, clip, here):
    (here / "concat:a|é.mp4").write_bytes(clip.read_bytes())

    assert clips.shown("concat:a|é.mp4", [3]) == [3]


def test_reading_in_order_reads_the_file_once(clips, clip):
    file = clips.counting(clip)

    with VideoReader(file, name="clip", frames=clips.frames) as reader:
        for index in range(clips.frames):
            reader.frame(index)

    assert file.bytes_read < 2 * clip.stat().st_size


def test_a_frame_far_ahead_is_sought_and_not_decoded_up_to(clips):
    pictures = clips.pictures.repeat(4, axis=1).repeat(4, axis=2)
    path = clips.encode("large.mp4", *GROUPS_OF_12, "-crf", "1", pictures=pictures)
    file = clips.counting(path)

    with VideoReader(file, name="clip", frames=clips.frames) as reader:
        reader.frame(47)
        reader.frame(0)
        before = file.bytes_read
        reader.frame(36)

    assert file.bytes_read - before < path.stat().st_size / 4


def test_frames_that_do_not_exist_and_reading_after_closing_are_refused(clips, clip):
    reader = VideoReader(clip, name="a/cam_00_rgb.mp4", frames=clips.frames)
    for index in (-1, 48):
        with pytest.raises(MediaError, match=rf"has no frame {index}: ask for one of 0 to 47"):
            reader.frame(index)
    reader.close()
    reader.close()
    with pytest.raises(MediaError, match=r"a/cam_00_rgb.mp4: is closed, so frame 3 cannot be read"):
        reader.frame(3)


def test_a_missing_file_is_named_with_its_path(tmp_path):
    with pytest.raises(StorageError, match=r"clip: cannot be read at .*none.mp4 \(No such"):
        VideoReader(tmp_path / "none.mp4", name="clip", frames=1)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("not a video", id="text"),
        pytest.param("ffconcat version 1.0\nfile other.mp4\n", id="a script that opens a file"),
        pytest.param("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\no.mp4\n", id="a playlist"),
    ],
)
def test_a_text_is_not_a_video_and_opens_nothing(tmp_path, text):
    (tmp_path / "a.mp4").write_text(text)

    with pytest.raises(MediaError, match=r"clip: cannot be opened as MP4 or Matroska \(Invalid"):
        VideoReader(tmp_path / "a.mp4", name="clip", frames=1)
