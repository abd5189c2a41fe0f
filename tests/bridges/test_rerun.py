"""Recordings for Rerun, read back: cameras, pictures, depth and disparity at every frame."""

import io
import sys

import numpy as np
import pytest
from PIL import Image

from stereogenbench_data import SceneViews, StereoPairs
from stereogenbench_data.bridges import rerun as bridge
from stereogenbench_data.errors import ExtraError, SelectionError
from tests.servers.tools import require_module

SCENE = "train/Uniform/SynthStage/scene_000001"


@pytest.fixture(scope="module")
def rerun():
    return require_module("rerun")


def read_back(path):
    """Return by entity and component the values at each frame, None for what holds always."""
    chunks = require_module("rerun.chunk")
    found = {}
    for chunk in chunks.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        frames = [None] * batch.num_rows
        if "frame" in batch.schema.names:
            frames = batch.column("frame").to_pylist()
        for name in batch.schema.names:
            if ":" not in name and name != "time":
                continue
            for frame, value in zip(frames, batch.column(name).to_pylist(), strict=True):
                if value is not None:
                    place = (str(chunk.entity_path), name)
                    found.setdefault(place, {})[frame] = value if name == "time" else value[0]
    return found


@pytest.fixture(scope="module")
def recorded(rerun, indexed_release, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "scene.rrd"
    done = []
    key = bridge.write_recording(
        path, indexed_release, "scene_000001", frames=[0, 4], pair=(1, 4),
        progress=lambda *counts: done.append(counts),
    )  # fmt: skip
    assert (key, done[-1]) == (SCENE, (2, 2))
    return read_back(path)


@pytest.fixture(scope="module")
def views(indexed_release):
    return SceneViews(indexed_release, scenes=SCENE, frames=[0, 4])


def image_of(value, frame_format, dtype):
    shape = (frame_format["height"], frame_format["width"])
    return np.array(value, dtype=np.uint8).view(dtype).reshape(shape)


def test_every_camera_has_its_pose_at_every_frame_from_the_first_camera(recorded, views):
    origin = views[0]["world_from_cam"][0, :3, 3].numpy()
    for camera in range(6):
        place = f"/world/cam_{camera:02d}"
        steps = recorded[place, "Transform3D:translation"]
        rotations = recorded[place, "Transform3D:mat3x3"]
        assert steps.keys() == rotations.keys() == {0, 4}
        for number, frame in enumerate((0, 4)):
            pose = views[number]["world_from_cam"][camera].numpy()
            np.testing.assert_allclose(steps[frame], pose[:3, 3] - origin, atol=1e-5)
            # Rerun keeps matrices column by column.
            rotation = np.array(rotations[frame]).reshape(3, 3).T
            np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-6)


def test_every_camera_has_its_lens_its_pictures_and_depth_in_metres(recorded, views):
    for camera in range(6):
        place = f"/world/cam_{camera:02d}"
        (matrix,) = recorded[place, "Pinhole:image_from_camera"].values()
        (resolution,) = recorded[place, "Pinhole:resolution"].values()
        expected = views[0]["intrinsics"].numpy()
        np.testing.assert_allclose(np.array(matrix).reshape(3, 3).T, expected, rtol=1e-6)
        assert list(resolution) == [64, 64]
        formats = recorded[f"{place}/depth", "DepthImage:format"]
        for number, frame in enumerate((0, 4)):
            buffer = recorded[f"{place}/depth", "DepthImage:buffer"][frame]
            depth = image_of(buffer, formats[frame], np.float32)
            np.testing.assert_array_equal(depth, views[number]["depth"][camera, 0])
            assert recorded[f"{place}/depth", "DepthImage:meter"][frame] == 1.0
            blob = recorded[f"{place}/rgb", "EncodedImage:blob"][frame]
            with Image.open(io.BytesIO(bytes(blob))) as file:
                picture = np.asarray(file).astype(int)
            shown = views[number]["image"][camera].permute(1, 2, 0).numpy()
            assert np.abs(picture - shown).mean() < 6


def test_disparity_is_that_of_the_pair_at_its_time_and_a_text_names_the_scene(
    recorded, indexed_release
):
    (text,) = recorded["/scene", "TextDocument:text"].values()
    assert SCENE in text
    pairs = StereoPairs(indexed_release, scenes=SCENE, pairs=[(1, 4)], frames=[0, 4])
    formats = recorded["/pair/disparity", "DepthImage:format"]

    for number, frame in enumerate((0, 4)):
        time_s = recorded["/pair/disparity", "time"][frame].total_seconds()
        assert time_s == pytest.approx(frame / 15)
        buffer = recorded["/pair/disparity", "DepthImage:buffer"][frame]
        disparity = image_of(buffer, formats[frame], np.float32)
        np.testing.assert_array_equal(disparity, pairs[number]["disparity"][0])


def test_what_a_scene_does_not_have_is_refused_and_the_file_that_was_there_stays(
    rerun, indexed_release, tmp_path
):
    path = tmp_path / "a.rrd"
    path.write_bytes(b"before")

    for asked, message in (
        ({"scene": "scene_7"}, r"scene_7"),
        ({"frames": [99]}, r"frame 99 is asked for"),
        ({"frames": ("clips", 2)}, r"are clips"),
        ({"pair": (0, 9)}, r"\(0, 9\)|0 to 5"),
    ):
        with pytest.raises(SelectionError, match=message):
            bridge.write_recording(path, indexed_release, **asked)
    assert [each.name for each in tmp_path.iterdir()] == ["a.rrd"]
    assert path.read_bytes() == b"before"


def test_without_rerun_the_extra_is_named(indexed_release, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)

    with pytest.raises(ExtraError, match=r"stereogenbench-data\[rerun\]"):
        bridge.write_recording(tmp_path / "a.rrd", indexed_release)
    assert not [*tmp_path.iterdir()]
