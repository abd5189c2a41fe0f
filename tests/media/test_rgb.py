"""RGB is ffmpeg's own at the stored size, and neither shifted nor aliased at another."""

import numpy as np
import pytest

from stereogenbench_data.media.video import VideoReader, read_rgb
from tests.media.conftest import texture

X264 = ("-c:v", "libx264", "-crf", "10")
COLOURS = {
    "untagged": (),
    "bt709": ("-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709"),
    "bt709 full range": (
        "-vf", "scale=out_color_matrix=bt709:out_range=pc", "-colorspace", "bt709",
        "-color_range", "pc",
    ),
    "bt601 full range": ("-vf", "scale=out_range=pc", "-color_range", "pc"),
    "bt2020": ("-vf", "scale=out_color_matrix=bt2020nc", "-colorspace", "bt2020nc"),
}  # fmt: skip


def coloured_noise(height, width):
    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 256, (3, height // 4 + 1, width // 4 + 1, 3))
    return coarse.repeat(4, axis=1).repeat(4, axis=2)[:, :height, :width].astype(np.uint8)


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv422p"])
@pytest.mark.parametrize("colour", COLOURS)
def test_matrix_and_range_are_those_of_the_file(clips, colour, pixel_format):
    path = clips.encode(
        f"{colour} {pixel_format}.mp4", *COLOURS[colour], *X264, "-pix_fmt", pixel_format,
        pictures=coloured_noise(64, 96),
    )  # fmt: skip

    with VideoReader(path, name="clip", frames=3) as reader:
        found = np.stack([read_rgb(reader, index) for index in range(3)])

    np.testing.assert_array_equal(found, clips.truth(path))


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv444p", "gbrp", "gray", "bgr0"])
def test_odd_sizes_and_other_formats_are_ffmpegs_too(clips, pixel_format):
    path = clips.encode(
        f"odd {pixel_format}.mkv", "-c:v", "ffv1", "-pix_fmt", pixel_format,
        pictures=coloured_noise(33, 51),
    )  # fmt: skip
    raw = clips.ffmpeg("-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-")
    truth = np.frombuffer(raw, np.uint8).reshape(3, 33, 51, 3)

    with VideoReader(path, name="clip", frames=3) as reader:
        found = read_rgb(reader, 1)

    np.testing.assert_array_equal(found.transpose(1, 2, 0), truth[1])


@pytest.fixture(scope="module")
def detailed(clips):
    """A clip of one large picture with detail at every scale, and that picture as decoded."""
    picture = texture(320, 320, sigmas_px=[1, 2, 4, 8])
    path = clips.encode("texture.mp4", *X264, "-pix_fmt", "yuv444p", pictures=picture[None])
    with VideoReader(path, name="clip", frames=1) as reader:
        return path, read_rgb(reader, 0)


def test_scaling_by_whole_factors_averages_areas(detailed):
    path, stored = detailed
    areas = stored.reshape(3, 80, 4, 80, 4).mean(axis=(2, 4))

    with VideoReader(path, name="clip", frames=1) as reader:
        scaled = read_rgb(reader, 0, size=(80, 80))

    difference = scaled - areas
    assert abs(difference.mean()) < 0.3
    assert difference.std() < 0.7


def test_a_given_array_is_written_and_returned(detailed):
    path, stored = detailed
    batch = np.zeros((2, 3, 320, 320), np.uint8)

    with VideoReader(path, name="clip", frames=1) as reader:
        result = read_rgb(reader, 0, out=batch[1])

    assert np.shares_memory(result, batch)
    np.testing.assert_array_equal(batch[1], stored)
