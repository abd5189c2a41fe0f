"""Right views on disk: where they belong, and what each that is not right is told."""

import cv2
import numpy as np
import pytest
from av.video.reformatter import VideoReformatter
from PIL import Image

from stereogenbench_data.errors import PredictionError
from stereogenbench_data.evaluation.predictions import (
    PairFrames,
    find_prediction,
    frame_name,
    item_name,
    open_views,
    scaled_rgb,
)
from tests.servers.videos import write_rgb

SCENE = "eval/MapSeenInTrain/Uniform/Town/scene_000001"
WANTED = PairFrames(SCENE, (0, 1), (0, 2), 3, (8, 16), (32, 32))


def picture(level, *, size=(8, 16)):
    return np.full((*size, 3), level, dtype=np.uint8)


def write_png(folder, frame, pixels):
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(folder / frame_name(frame))


def write_video(path, levels, *, size=(8, 16)):
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures = [picture(level, size=size) for level in levels]
    return write_rgb(path, pictures, codec="ffv1", pixel_format="bgr0")


def read(path, frame=0):
    with open_views(path, WANTED) as read_sample:
        return read_sample({"frame_index": frame})


def levels(path):
    return [int(read(path, frame).mean()) for frame in WANTED.frames]


@pytest.fixture
def item(tmp_path):
    return tmp_path / item_name(SCENE, (0, 1))


def test_an_items_name_tells_neither_scene_nor_cameras_and_differs_for_each():
    names = {item_name(SCENE, (left, right)) for left in range(6) for right in range(left + 1, 6)}

    assert len(names) == 15
    assert all(len(name) == 16 and set(name) <= set("0123456789abcdef") for name in names)


@pytest.mark.parametrize("place", [item_name(SCENE, (0, 1)), f"{SCENE}/00-01"])
def test_pictures_are_found_by_item_and_by_scene_and_cameras(tmp_path, place):
    for frame in (0, 2):
        write_png(tmp_path / place, frame, picture(10 + frame))

    assert levels(find_prediction(tmp_path, WANTED)) == [10, 12]


@pytest.mark.parametrize("place", [item_name(SCENE, (0, 1)), f"{SCENE}/00-01"])
@pytest.mark.parametrize(("written", "found"), [([10, 20, 30], [10, 30]), ([10, 20], [10, 20])])
def test_a_video_is_of_the_whole_scene_or_of_the_evaluated_frames(tmp_path, place, written, found):
    write_video(tmp_path / f"{place}.mkv", written)

    assert levels(find_prediction(tmp_path, WANTED)) == found


def test_pictures_of_the_stored_size_are_read_as_they_are_and_scaled_by_area(item):
    pixels = picture(0, size=(32, 32))
    pixels[:, 16:] = 200
    for frame in (0, 2):
        write_png(item, frame, pixels)
    stored = read(item)
    view = scaled_rgb(stored, size=WANTED.size, scaler=VideoReformatter())

    assert stored.shape == (3, 32, 32)
    assert view.shape == (3, 8, 16)
    assert view[:, :, :7].max() == 0
    assert view[:, :, 9:].min() == 200


def test_two_predictions_of_one_pair_are_refused(item, tmp_path):
    write_png(item, 0, picture(1))
    write_video(tmp_path / SCENE / "00-01.mkv", [1])

    with pytest.raises(PredictionError, match=r"has several predictions, .*: keep one"):
        find_prediction(tmp_path, WANTED)


NOISE = np.random.default_rng(0).integers(0, 256, (8, 16, 3), dtype=np.uint8)


def pictures(pixels, frames=(0, 2)):
    return lambda item: [write_png(item, frame, pixels) for frame in frames]


def last_picture(change):
    """Write pictures of which the last is cut, overwritten or gone."""

    def write(item):
        pictures(NOISE)(item)
        (item / "002.png").write_bytes(change((item / "002.png").read_bytes()))

    return write


def wide_numbers(item):
    item.mkdir()
    for frame in (0, 2):
        cv2.imwrite(str(item / frame_name(frame)), np.full((8, 16, 3), 300, dtype=np.uint16))


def link_to_nowhere(item):
    pictures(NOISE, frames=[0])(item)
    (item / frame_name(2)).symlink_to(item / "gone.png")


def video(levels, **options):
    return lambda item: write_video(item.with_name(f"{item.name}.mkv"), levels, **options)


def cut_video(item):
    path = video([1, 2])(item)
    path.write_bytes(path.read_bytes()[:200])


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (pictures(NOISE, frames=[0]), r"lacks 1 of 2 frames, the first is 002\.png"),
        (pictures(NOISE, frames=range(4)), r"holds 003\.png, and the scene has 3 frames"),
        (pictures(np.zeros((9, 16, 3), np.uint8)),
         r"000\.png is 16x9; expected 16x8, or the scene's own 32x32"),
        (pictures(np.zeros((8, 16), np.uint8)), r"mode L of 8 bits: write 8-bit RGB"),
        (pictures(np.zeros((8, 16, 4), np.uint8)), r"mode RGBA of 8 bits: write 8-bit RGB"),
        (wide_numbers, r"000\.png has pixels of mode RGB of 16 bits"),
        (link_to_nowhere, r"002\.png cannot be read as a picture"),
        (last_picture(lambda content: content[: len(content) // 2]), r"002\.png cannot be read"),
        (last_picture(lambda content: b"not a picture"), r"002\.png cannot be read as a picture"),
        (last_picture(lambda content: content[:60] + bytes(40) + content[100:]),
         r"002\.png cannot be read as a picture"),
        (video([1, 2, 3, 4]), r"4 frames; expected 3 \(the scene's\) or 2 \(those evaluated"),
        (video([1, 2], size=(16, 16)), r"is 16x16; expected 16x8"),
        (cut_video, r"\.mkv"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_prediction_is_named_with_its_place(item, tmp_path, write, message):
    write(item)

    with pytest.raises(PredictionError, match=rf"{SCENE}, cameras 00-01: .*{message}"):
        levels(find_prediction(tmp_path, WANTED))
