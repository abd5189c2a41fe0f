"""Colour stays where brightness is, at any size, wherever the file says that its samples lie."""

import numpy as np
import pytest
import torch

from stereogenbench_data.media.video import VideoReader, read_rgb
from tests.media.conftest import texture

X264 = ("-c:v", "libx264", "-crf", "10", "-pix_fmt", "yuv420p")
HEVC = ("-c:v", "libx265", "-crf", "10", "-pix_fmt", "yuv420p", "-x265-params")
TO_YCC = np.array([[0.299, 0.587, 0.114], [-0.1687, -0.3313, 0.5], [0.5, -0.4187, -0.0813]])
CENTRE, LEFT, TOP_LEFT = (0.0, 0.0), (-0.5, 0.0), (-0.5, -0.5)
FFV1 = ("-c:v", "ffv1", "-pix_fmt", "yuv420p")
FILES = {
    "untagged": ("un.mp4", CENTRE, X264),
    "tagged left": ("left.mp4", LEFT, (*X264, "-bsf:v", "h264_metadata=chroma_sample_loc_type=0")),
    "tagged center": ("center.mp4", CENTRE, (*X264, "-chroma_sample_location", "center")),
    "tagged topleft": ("topleft.mp4", TOP_LEFT, (*X264, "-chroma_sample_location", "topleft")),
    "hevc untagged": ("hevc.mp4", CENTRE, (*HEVC, "log-level=0")),
    "hevc tagged left": ("hevcl.mp4", LEFT, (*HEVC, "log-level=0:chromaloc=0")),
    "mpeg4": ("mpeg4.mp4", CENTRE, ("-c:v", "mpeg4", "-q:v", "1", "-pix_fmt", "yuv420p")),
    "ffv1 untagged": ("un.mkv", CENTRE, FFV1),
    "ten bits": ("ten.mp4", CENTRE, ("-c:v", "libx264", "-crf", "5", "-pix_fmt", "yuv420p10le")),
    "odd": ("odd.mkv", None, ("-vf", "crop=159:255:0:0", *FFV1)),
}
"""By name: the file, where its chroma lies, and how it is encoded."""


PICTURE = texture(256, 256, sigmas_px=[2, 4, 8])


def read(clips, name, *, size=None):
    file, _, codec = FILES[name]
    path = clips.encode(f"siting {file}", *codec, pictures=PICTURE[None])
    with VideoReader(path, name="clip", frames=1) as reader:
        return read_rgb(reader, 0, size=size).astype(float)


def shifts_px(picture, reference):
    """Return how far Y, Cb and Cr of a picture lie from those of another, as (3, 2): x and y."""
    found = []
    channels = (np.einsum("ij,jhw->ihw", TO_YCC, each) for each in (picture, reference))
    for values, expected in zip(*channels, strict=True):
        down, right = np.gradient(expected)
        slopes = np.stack([right.ravel(), down.ravel(), np.ones(right.size)], axis=1)
        found.append(np.linalg.lstsq(slopes, (expected - values).ravel(), rcond=None)[0][:2])
    return np.array(found)


@pytest.mark.parametrize("size", [(480, 832), (90, 147)])
@pytest.mark.parametrize("name", FILES)
def test_colour_is_where_brightness_is_at_any_size(clips, name, size):
    stored = torch.from_numpy(read(clips, name))[None]
    areas = torch.nn.functional.interpolate(stored, size=size, mode="bilinear", antialias=True)

    found = shifts_px(read(clips, name, size=size), areas[0].numpy())

    assert np.abs(found).max() < 0.05


@pytest.mark.parametrize("name", [name for name in FILES if name != "odd"])
def test_chroma_at_the_stored_size_lies_where_the_file_is_tagged_to_have_it(clips, name):
    reference = PICTURE.transpose(2, 0, 1).astype(float)
    centred = shifts_px(read(clips, "ffv1 untagged"), reference)

    moved = shifts_px(read(clips, name), reference) - centred

    place = FILES[name][1]
    np.testing.assert_allclose(moved, [(0, 0), place, place], atol=0.06)


@pytest.mark.parametrize("size", [(120, 208), (400, 500)])
def test_an_untagged_file_is_scaled_as_ffmpegs_own_filter_does(clips, size):
    found = read(clips, "untagged", size=size)
    shrinks = size[0] * size[1] < 256 * 256
    scale = f"scale={size[1]}:{size[0]}:flags={'area' if shrinks else 'bicubic'}+full_chroma_int"
    raw = clips.ffmpeg(
        "-i", clips.folder / "siting un.mp4", "-vf", f"{scale},format=gbrp",
        "-f", "rawvideo", "-pix_fmt", "rgb24", "-",
    )  # fmt: skip
    expected = np.frombuffer(raw, np.uint8).reshape(*size, 3).transpose(2, 0, 1)

    assert np.abs(found - expected).max() <= 3
