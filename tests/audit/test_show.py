"""Sheets and clips of a scene: what is drawn is what the data say."""

import av
import numpy as np
import pytest
from PIL import Image

from stereogenbench_data import SceneIndex
from stereogenbench_data.audit.pictures import (
    HIDDEN,
    SceneReader,
    clip_pages,
    scene_sheet,
    tile_width,
    write_clip,
)
from stereogenbench_data.bridges.picture import (
    NOT_MEASURED,
    ColourScale,
    anaglyph,
    pair_tiles,
)

SCENE = "train/Uniform/SynthStage/scene_000001"


@pytest.fixture(scope="module")
def reader(small_release):
    return SceneReader(SceneIndex.open(small_release))


@pytest.fixture(scope="module")
def row(reader):
    return reader.index.column("key").tolist().index(SCENE)


def tile(sheet, *, line, column, width_px):
    """Return a tile of a sheet, found by the frame that is drawn around each."""
    gap = font_px = min(max(round(width_px / 21), 13), 30)
    left = gap + column * (width_px + gap)
    text_line = round(font_px * 1.4)
    top = sheet.shape[0] - 2 * gap - 3 * text_line - width_px
    if line == 0:
        top -= text_line + 4 + width_px + gap
    return sheet[top : top + width_px, left : left + width_px]


def test_the_views_of_a_sheet_are_the_six_cameras_pictures(reader, row):
    sheet = scene_sheet(reader, row, pair=(0, 2), frame=1)
    width = tile_width(reader.index.scene(row))

    views = reader.views(row, frame=1)
    for camera in range(6):
        picture = Image.fromarray(views[camera].transpose(1, 2, 0).copy())
        wanted = picture.resize((width, width), Image.Resampling.NEAREST)
        assert np.array_equal(tile(sheet, line=0, column=camera, width_px=width), wanted), camera


def test_the_maps_of_a_sheet_are_coloured_as_their_scales_say(reader, row):
    sheet = scene_sheet(reader, row, pair=(0, 2))
    sample = reader.pair(row, pair=(0, 2), frame=0,
                         fields=("left", "right", "disparity", "valid", "visible"))  # fmt: skip
    disparity, valid = sample["disparity"][0], sample["valid"][0]
    painted = ColourScale.of(disparity, measured=valid).paint(disparity, measured=valid)
    shown = {
        name: tile(sheet, line=1, column=column, width_px=320)[2::5, 2::5]
        for column, name in ((0, "disparity"), (2, "visible"), (3, "anaglyph"))
    }

    assert np.array_equal(shown["disparity"], painted)
    assert np.array_equal(shown["anaglyph"], anaglyph(sample["left"], sample["right"]))
    hidden = valid & ~sample["visible"][0]
    assert hidden.any()
    assert np.array_equal((shown["visible"] == HIDDEN).all(axis=-1), hidden)
    assert np.array_equal((shown["visible"] == NOT_MEASURED).all(axis=-1), ~valid)


def test_the_bar_of_disparity_says_depth_in_metres_below_pixels(reader, row):
    sample = reader.pair(row, pair=(0, 2), frame=0,
                         fields=("left", "right", "disparity", "valid", "baseline_m"))  # fmt: skip

    pixels, metres = pair_tiles(sample, fx_px=600.0)[2].labels

    # 600 px of focal length: B = 10 cm would give 60 px at 1 m.
    assert [pixels(value) for value in (0.0, 20.0)] == ["0", "20"]
    assert metres(0.0) == "inf"
    assert float(metres(60.0)) == pytest.approx(10 * float(sample["baseline_m"]), rel=1e-2)


def test_nothing_measured_has_a_scale_too():
    nothing = np.zeros((2, 2), dtype=bool)

    scale = ColourScale.of(np.zeros((2, 2)), measured=nothing, kind="log")
    assert (scale.paint(np.zeros((2, 2)), measured=nothing) == NOT_MEASURED).all()


def test_a_clip_has_a_page_for_every_frame_at_the_scenes_rate(reader, row, tmp_path):
    counted = []
    path = tmp_path / "clip.mp4"
    write_clip(
        path, clip_pages(reader, row), frames=7, rate_hz=15.0,
        progress=lambda done, total: counted.append((done, total)),
    )  # fmt: skip
    pages = list(clip_pages(reader, row))
    with av.open(path) as container:
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        rate = float(container.streams.video[0].average_rate)

    assert counted == [(number, 7) for number in range(1, 8)]
    assert [page.shape for page in shown] == [pages[0].shape] * 7
    assert rate == pytest.approx(15.0, rel=0.01)
    for page, drawn in zip(shown, pages, strict=True):
        assert np.abs(page.astype(int) - drawn).mean() < 6
    assert list(tmp_path.iterdir()) == [path]
