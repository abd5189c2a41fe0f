"""The writer: each field is allocated once, and written where it will stay."""

import numpy as np
import pytest

from stereogenbench_data.samples.request import Request
from stereogenbench_data.samples.views import StoredDepth, Views
from stereogenbench_data.samples.writer import SampleWriter, new_array
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.plan import Address
from tests.samples.test_derive import INTRINSICS, facts

SIZE = (20, 40)
FIELDS = ("left", "right", "disparity", "valid", "pair", "frame_index", "scene", "__key__")


class Allocated:
    """Allocates, and notes for what."""

    def __init__(self):
        self.shapes = {}

    def __call__(self, name, shape, dtype):
        assert name not in self.shapes
        self.shapes[name] = shape
        return new_array(name, shape, dtype)


def views_of(address, frames, pictures=None):
    """Return views of some frames whose pictures are full of camera number + frame number."""
    numbers = address.frames[frames]
    cameras = (address.source, *address.targets)
    units = np.full((len(numbers), *SIZE), 50, dtype=np.uint16)
    filled = {
        camera: np.stack([np.full((3, *SIZE), camera + frame, np.uint8) for frame in numbers])
        for camera in cameras
    }
    return Views(
        source=address.source, targets=address.targets, frames=numbers,
        pictures=filled if pictures is None else pictures,
        depths={address.source: StoredDepth(units, units > 0)}, intrinsics=INTRINSICS,
    )  # fmt: skip


def written(address, *, layout="single", clip="frame", step=1):
    """Return a sample that was written some frames at a time, and what was allocated for it."""
    allocate = Allocated()
    request = Request(kind="pairs", fields=FIELDS, layout=layout)
    writer = SampleWriter(request, address, clip=clip, allocate=allocate)
    for start in range(0, len(address.frames), step):
        frames = slice(start, start + step)
        writer.write(views_of(address, frames), facts(DepthEncoding(0.1)), frames)
    return writer.sample, allocate.shapes


def test_a_pair_has_the_shapes_of_the_table():
    sample, shapes = written(Address(0, 0, (1,), (7,)))

    assert shapes == {
        "left": (3, *SIZE), "right": (3, *SIZE), "disparity": (1, *SIZE), "valid": (1, *SIZE),
        "pair": (2,), "frame_index": (),
    }  # fmt: skip
    assert (sample["left"] == 7).all()
    assert (sample["right"] == 8).all()
    assert (sample["disparity"] == 4).all()
    assert sample["pair"].tolist() == [0, 1]
    assert sample["scene"] == "train/Uniform/Map/scene_000000"


@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_clip_is_written_some_frames_at_a_time(step):
    sample, shapes = written(Address(0, 0, (1,), (4, 6, 8)), clip="clip", step=step)

    assert shapes["left"] == (3, 3, *SIZE)
    assert sample["left"][:, 0, 0, 0].tolist() == [4, 6, 8]
    assert sample["frame_index"].tolist() == [4, 6, 8]
    assert (sample["disparity"] == 4).all()


def test_a_sweep_stacks_what_depends_on_the_target():
    sample, shapes = written(Address(0, 0, (1, 2, 3), (0,)), layout="stacked")

    assert shapes["left"] == (3, *SIZE)
    assert shapes["right"] == (3, 3, *SIZE)
    assert sample["right"][:, 0, 0, 0].tolist() == [1, 2, 3]
    assert sample["disparity"][:, 0, 0, 0].tolist() == [4, 8, 12]


def test_pictures_can_be_decoded_where_they_belong():
    address, frames, allocate = Address(0, 0, (1,), (5,)), slice(0, 1), Allocated()
    request = Request(kind="pairs", fields=("left", "right"), layout="single")
    writer = SampleWriter(request, address, clip="frame", allocate=allocate)
    pictures = writer.pictures(frames, size=SIZE)
    for camera, picture in pictures.items():
        picture[:] = 10 * camera
    writer.write(views_of(address, frames, pictures), facts(DepthEncoding(0.1)), frames)

    assert set(pictures) == {0, 1}
    assert np.shares_memory(writer.sample["right"], pictures[1])
    assert (writer.sample["left"] == 0).all()
    assert (writer.sample["right"] == 10).all()
