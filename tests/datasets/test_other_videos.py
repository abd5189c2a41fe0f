"""A video that is another than its name says is refused by name, and never read as pictures."""

import re
import shutil
from dataclasses import replace

import pytest

from stereogenbench_data import MediaError, SceneIndex, StereoPairs
from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.verify import verify
from tests.datasets.conftest import ffmpeg, write_again

RGB, DEPTH = "cam_00_rgb.mp4", "cam_00_depth.mkv"


def written(name, *codec, source=None, before=()):
    """Return what writes a video of a scene anew, from itself or from another one."""
    return lambda folder: write_again(
        folder / name, *codec, source=folder / (source or name), before=before
    )


def copied(source, name):
    return lambda folder: shutil.copy(folder / source, folder / name)


def of_two_sizes(folder):
    """Write H.264 that changes to 48x48 after nine frames."""
    part, whole = folder / "part.h264", b""
    for side_px, frames in ((72, 9), (48, 8)):
        size = ("-frames:v", frames, "-vf", f"scale={side_px}:{side_px}")
        ffmpeg("-i", folder / RGB, *size, "-c:v", "libx264", "-g", 1, part)
        whole += part.read_bytes()
    part.write_bytes(whole)
    ffmpeg("-r", 15, "-i", part, "-c", "copy", folder / RGB)
    part.unlink()


QUIET_HEVC = ("-c:v", "libx265", "-x265-params", "log-level=none")
OTHERS = {
    "depth over colour": (copied(DEPTH, RGB), RGB, "gray16le, and"),
    "colour over depth": (copied(RGB, DEPTH), DEPTH, "holds colours|lossy, chroma"),
    "sound alone": (
        lambda folder: ffmpeg("-f", "lavfi", "-i", "sine=d=1", folder / RGB), RGB, "holds audio",
    ),
    "one picture": (written(RGB, "-frames:v", "1"), RGB, "has 1|holds 1 frames"),
    "grey H.264": (written(RGB, "-c:v", "libx264", "-pix_fmt", "gray"), RGB, "grey, and"),
    "pixels that are not square": (
        written(RGB, "-vf", "setsar=2/1"), RGB, "pixels 2 times as wide as high",
    ),
    "another size": (written(RGB, "-vf", "scale=48:48"), RGB, "48x48"),
    "colours as depth": (
        written(DEPTH, "-c:v", "ffv1", "-pix_fmt", "gbrp16le", source=RGB), DEPTH,
        "holds colours|channels",
    ),
    "depth with alpha": (
        written(DEPTH, "-c:v", "png", "-pix_fmt", "ya16be"), DEPTH, "not one number",
    ),
}  # fmt: skip
SEEN_IN_PICTURES = {
    "another size later": (of_two_sizes, RGB, r"frame \d+ is yuv420p 48x48 where yuv420p 72x72"),
    "a turned picture": (
        written(RGB, "-c", "copy", before=("-display_rotation", "90")), RGB, "to be turned",
    ),
    "ten bits of depth": (
        written(DEPTH, "-c:v", "ffv1", "-pix_fmt", "gray10le"), DEPTH, "gray10le .10-bit.",
    ),
}  # fmt: skip
FITTING = {
    "HEVC of 10 bits": written(RGB, *QUIET_HEVC, "-pix_fmt", "yuv420p10le"),
    "H.264 of red, green and blue": written(RGB, "-c:v", "libx264rgb", "-pix_fmt", "rgb24"),
}


@pytest.fixture
def scene(drawn, tmp_path):
    """The folder of a scene that may be altered, in a tree of its own."""
    shutil.copytree(drawn, tmp_path / "scenes")
    (found,) = (tmp_path / "scenes").glob("*/*/*/scene_*")
    return found


def root_of(scene):
    return scene.parents[3]


def key_of(scene):
    return str(scene.relative_to(root_of(scene)))


def index_of_the_unaltered(drawn, scene):
    """Return an index that was made before a scene was altered, but for the sizes of files."""
    row = describe_scene(drawn, key_of(scene))
    members = {
        name: replace(member, size=(scene / name).stat().st_size)
        for name, member in row.members.items()
    }
    return SceneIndex.from_scenes([replace(row, members=members)], root_of(scene))


def require_refused(index, name, found):
    """Every frame of an altered scene is read, in order and each afresh, and is refused by name."""
    field = "left" if name == RGB else "depth"
    for order in ((0, 12), (16, 11)):
        pairs = StereoPairs(index, frames="all", fields=(field,))
        with pytest.raises(MediaError, match=rf"{name}: .*({found})"):
            [pairs[frame] for frame in order]


@pytest.mark.parametrize("case", OTHERS)
def test_another_video_is_refused_by_index_and_by_loading(drawn, scene, case):
    alter, name, found = OTHERS[case]
    alter(scene)

    try:
        described = describe_scene(root_of(scene), key_of(scene))
    except StereoGenBenchError as error:
        told = str(error)
    else:
        assert name not in described.members
        told = described.remark("videos")
    assert re.search(rf"{name}\b.*({found})", told)
    require_refused(index_of_the_unaltered(drawn, scene), name, found)


@pytest.mark.parametrize("case", SEEN_IN_PICTURES)
def test_what_no_header_refuses_is_refused_when_it_is_read(drawn, scene, case):
    alter, name, found = SEEN_IN_PICTURES[case]
    alter(scene)

    require_refused(index_of_the_unaltered(drawn, scene), name, found)


def test_loading_from_a_shard_and_a_deep_check_refuse_it_too(scene, tmp_path):
    alter, name, found = SEEN_IN_PICTURES["a turned picture"]
    alter(scene)
    pack(root_of(scene), tmp_path / "shards", workers=1)

    require_refused(SceneIndex.open(tmp_path / "shards"), name, found)
    report = verify(tmp_path / "shards", mode="decode", workers=1)
    assert {(each.member, bool(re.search(found, each.found))) for each in report.problems} == {
        (name, True)
    }


@pytest.mark.parametrize("case", FITTING)
def test_colours_in_any_codec_are_read(scene, case):
    FITTING[case](scene)

    pairs = StereoPairs(root_of(scene), frames="all", fields=("left",))

    assert pairs[12]["left"].float().std() > 5
