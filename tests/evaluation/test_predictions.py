"""Right views on disk: where they belong, and what each that is not right is told."""

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import VideoReformatter
from PIL import Image

from stereogenbench_data.evaluation.predictions import (
    PairFrames,
    PredictionFault,
    find_prediction,
    frame_name,
    item_name,
    open_prediction,
    scaled_rgb,
    stamp_prediction,
)

SCENE = "eval/MapSeenInTrain/Uniform/Town/scene_000001"
WANTED = PairFrames(SCENE, (0, 1), (0, 2), 3, (8, 16), (32, 32))


def picture(level, *, size=(8, 16)):
    return np.full((*size, 3), level, dtype=np.uint8)


def write_png(folder, frame, pixels):
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(folder / frame_name(frame))


def write_video(path, levels, *, size=(8, 16)):
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(path, "w") as container:
        stream = container.add_stream("ffv1", rate=15)
        stream.width, stream.height, stream.pix_fmt = size[1], size[0], "bgr0"
        for level in levels:
            frame = av.VideoFrame.from_ndarray(picture(level, size=size), format="rgb24")
            container.mux(stream.encode(frame.reformat(format="bgr0")))
        container.mux(stream.encode(None))
    return path


def read(path, frame=0):
    with open_prediction(path, WANTED) as read_frame:
        return read_frame(frame)


def levels(path):
    return [int(read(path, frame).mean()) for frame in WANTED.frames]


@pytest.fixture
def item(tmp_path):
    return tmp_path / item_name(SCENE, (0, 1))


def test_an_items_name_tells_neither_scene_nor_cameras_and_differs_for_each():
    names = {item_name(SCENE, (left, right)) for left in range(6) for right in range(left + 1, 6)}

    assert len(names) == 15
    assert all(len(name) == 16 and set(name) <= set("0123456789abcdef") for name in names)


def test_pictures_are_found_by_item(item, tmp_path):
    for frame in (0, 2):
        write_png(item, frame, picture(10 + frame))

    assert levels(find_prediction(tmp_path, WANTED)) == [10, 12]


def test_pictures_are_found_by_scene_and_cameras(tmp_path):
    for frame in (0, 2):
        write_png(tmp_path / SCENE / "00-01", frame, picture(10 + frame))

    assert levels(find_prediction(tmp_path, WANTED)) == [10, 12]


def test_a_video_of_the_whole_scene_is_read_by_frame_number(item, tmp_path):
    write_video(item.with_name(f"{item.name}.mkv"), [10, 20, 30])

    assert levels(find_prediction(tmp_path, WANTED)) == [10, 30]


def test_a_video_of_the_evaluated_frames_is_read_in_order(tmp_path):
    write_video(tmp_path / SCENE / "00-01.mkv", [10, 20])

    assert levels(find_prediction(tmp_path, WANTED)) == [10, 20]


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


def test_a_missing_prediction_is_told_with_both_places(tmp_path):
    with pytest.raises(
        PredictionFault,
        match=rf"{SCENE}, cameras 00-01: has no prediction in .*{SCENE}/00-01 or "
        rf"{item_name(SCENE, (0, 1))}\.",
    ):
        find_prediction(tmp_path, WANTED)


def test_two_predictions_of_one_pair_are_refused(item, tmp_path):
    write_png(item, 0, picture(1))
    write_video(tmp_path / SCENE / "00-01.mkv", [1])

    with pytest.raises(PredictionFault, match=r"has several predictions, .*: keep one"):
        find_prediction(tmp_path, WANTED)


def test_a_missing_frame_is_named(item):
    write_png(item, 0, picture(1))

    with pytest.raises(PredictionFault, match=r"lacks 1 of 2 frames, the first is 002\.png"):
        read(item)


def test_a_frame_beyond_the_scene_is_named(item):
    for frame in (0, 1, 2, 3):
        write_png(item, frame, picture(1))

    with pytest.raises(PredictionFault, match=r"holds 003\.png, and the scene has 3 frames"):
        read(item)


def test_a_picture_of_another_size_is_named_with_those_that_would_do(item):
    for frame in (0, 2):
        write_png(item, frame, picture(1, size=(9, 16)))

    with pytest.raises(
        PredictionFault, match=r"000\.png is 16x9; expected 16x8, or the scene's own 32x32"
    ):
        read(item)


@pytest.mark.parametrize(("mode", "shape"), [("L", (8, 16)), ("RGBA", (8, 16, 4))])
def test_pictures_without_three_channels_are_refused(item, mode, shape):
    for frame in (0, 2):
        write_png(item, frame, np.zeros(shape, dtype=np.uint8))

    with pytest.raises(PredictionFault, match=rf"pixels of mode {mode} of 8 bits: write 8-bit RGB"):
        read(item)


def test_pictures_of_16_bits_are_refused_not_halved(item):
    item.mkdir()
    for frame in (0, 2):
        cv2.imwrite(str(item / frame_name(frame)), np.full((8, 16, 3), 300, dtype=np.uint16))

    with pytest.raises(PredictionFault, match=r"000\.png has pixels of mode RGB of 16 bits"):
        read(item)


def test_a_link_to_nowhere_is_a_picture_that_cannot_be_read(item):
    write_png(item, 0, picture(1))
    (item / frame_name(2)).symlink_to(item / "gone.png")

    assert stamp_prediction(item)
    with pytest.raises(PredictionFault, match=r"002\.png cannot be read as a picture"):
        read(item, 2)


@pytest.mark.parametrize("damage", ["cut", "text", "payload"])
def test_a_damaged_picture_is_named(item, damage):
    noise = np.random.default_rng(0).integers(0, 256, (8, 16, 3), dtype=np.uint8)
    for frame in (0, 2):
        write_png(item, frame, noise)
    path = item / "002.png"
    content = path.read_bytes()
    changed = {
        "cut": content[: len(content) // 2],
        "text": b"not a picture",
        "payload": content[:60] + bytes(40) + content[100:],
    }
    path.write_bytes(changed[damage])

    with pytest.raises(PredictionFault, match=r"00-01: .*002\.png cannot be read as a picture"):
        read(item, 2)


def test_a_video_of_another_number_of_frames_is_named_with_those_that_would_do(item):
    path = write_video(item.with_name(f"{item.name}.mkv"), [1, 2, 3, 4])

    with pytest.raises(
        PredictionFault, match=r"holds 4 frames; expected 3 \(the scene's\) or 2 \(those evaluated"
    ):
        read(path)


def test_a_video_of_another_size_is_named(item):
    path = write_video(item.with_name(f"{item.name}.mkv"), [1, 2], size=(16, 16))

    with pytest.raises(PredictionFault, match=r"is 16x16; expected 16x8"):
        read(path)


def test_a_cut_video_is_named(item):
    path = write_video(item.with_name(f"{item.name}.mkv"), [1, 2])
    path.write_bytes(path.read_bytes()[:200])

    with pytest.raises(PredictionFault, match=rf"{SCENE}, cameras 00-01: .*\.mkv"):
        levels(path)


def test_a_stamp_changes_with_the_files(item):
    write_png(item, 0, picture(1))
    before = stamp_prediction(item)
    write_png(item, 2, picture(1))

    assert stamp_prediction(item) != before
    assert stamp_prediction(item) == stamp_prediction(item)
