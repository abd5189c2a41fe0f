"""Encoding: pictures come back as they were, and settings that cannot be are refused by name."""

import io
from fractions import Fraction

import av
import numpy as np
import pytest

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.encoder import Encoding, VideoEncoder

TAGS = ("colorspace", "color_primaries", "color_trc", "color_range")


def smooth(number, height=32, width=48):
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack([columns * 2, rows * 3, rows + columns + number], axis=-1).astype(np.uint8)


def encoded(pictures, *, rate_hz=24.0, quality="as set", **settings):
    file = io.BytesIO()
    encoding = Encoding(**settings)
    with VideoEncoder(file, rate_hz=rate_hz, encoding=encoding, quality=quality) as encoder:
        for picture in pictures:
            encoder.write_picture(picture)
    file.seek(0)
    return file


def decoded(file):
    with av.open(file) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv444p"])
def test_pictures_come_back_with_their_colours(pixel_format):
    pictures = [smooth(number) for number in range(7)]

    found = decoded(encoded(pictures, pixel_format=pixel_format, crf=1))

    assert len(found) == 7
    for one, other in zip(pictures, found, strict=True):
        error = np.abs(one.astype(int) - other)[2:-2, 2:-2]
        assert error.mean() < (2.0 if pixel_format == "yuv420p" else 1.0)


@pytest.mark.parametrize(
    ("rate_hz", "rate"),
    [(24.0, Fraction(24)), (29.97, Fraction(2997, 100)), (7.5, Fraction(15, 2))],
)
def test_the_file_states_rate_and_colour_space(rate_hz, rate):
    with av.open(encoded([smooth(0)] * 5, rate_hz=rate_hz)) as container:
        stream = container.streams.video[0]
        times = [frame.pts * stream.time_base for frame in container.decode(stream)]
        tags = [int(getattr(stream.codec_context, tag)) for tag in TAGS]

        assert (stream.average_rate, stream.frames) == (rate, 5)
    assert times == [number / rate for number in range(5)]
    assert tags == [6, 6, 6, 1]


def test_the_same_pictures_give_the_same_bytes():
    random = np.random.default_rng(0)
    pictures = random.integers(0, 256, (5, 64, 64, 3)).astype(np.uint8)
    pictures[:, :, 20:] = [smooth(number, 64, 44) for number in range(5)]

    found = {encoded(remembered(pictures, random)).getvalue() for _ in range(4)}

    assert len(found) == 1


def remembered(pictures, random):
    """Yield pictures, and leave other numbers in freed memory in between."""
    for picture in pictures:
        for size in random.integers(100, 200_000, 40):
            random.integers(0, 256, size).astype(np.uint8)
        yield picture


@pytest.mark.parametrize("shape", [(33, 48), (32, 47)])
def test_an_odd_side_is_refused_unless_colours_are_stored_whole(shape):
    picture = smooth(0, *shape)

    with pytest.raises(MediaError, match=rf"{shape[1]}x{shape[0]} pixels .* yuv420p .* yuv444p"):
        encoded([picture])
    assert decoded(encoded([picture], pixel_format="yuv444p"))[0].shape == (*shape, 3)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"crf": 52}, r"crf must be 0 to 51, got 52"),
        ({"pixel_format": "rgb24"}, r"pixel_format must be one of yuv420p, yuv444p, got 'rgb24'"),
        ({"key_frame_every": 0}, r"key_frame_every must be at least 1, got 0"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, said):
    with pytest.raises(MediaError, match=said):
        Encoding(**settings)
