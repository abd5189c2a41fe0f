"""Frame n of all twelve videos of a scene is one moment, or the scene is refused."""

import warnings
from fractions import Fraction

import pytest

from stereogenbench_data import StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.scene_folder import describe_scene
from stereogenbench_data.index.table import AssumptionWarning
from tests.cli.command import invoke, one_line
from tests.servers.videos import write_at

KEY = "train/Uniform/Car_Dealer/scene_000001"
FRAMES = 24
STEADY = [Fraction(n, 15) for n in range(FRAMES + 2)]
GAP = [*STEADY[:10], *STEADY[11 : FRAMES + 1]]
NEAR_END = [*STEADY[:22], *STEADY[23 : FRAMES + 1]]
VARIABLE = [Fraction(n, 15) + Fraction(n * n, 600) for n in range(FRAMES)]
HEVC = {"codec": "libx265", "options": {"x265-params": "log-level=none"}}
FRAGMENTS = {"file_options": {"movflags": "frag_keyframe+empty_moov"}}


@pytest.fixture
def scene(make_scene):
    return make_scene(frames=FRAMES)


def ntsc(frames=FRAMES):
    return [Fraction(n * 1001, 30000) for n in range(frames)]


def at_rate(folder, rate_hz, names=("rgb.mp4", "depth.mkv")):
    """Write all videos of a kind at a rate."""
    for camera in range(6):
        for name in names:
            times = [n / Fraction(rate_hz) for n in range(FRAMES)]
            write_at(folder / f"cam_{camera:02d}_{name}", times, rate_hz=rate_hz)


@pytest.mark.parametrize(
    ("times", "how", "frame"),
    [
        (GAP, {}, 10),
        (GAP, {"options": {"bf": "0"}}, 10),
        (GAP, HEVC, 10),
        (GAP, {"codec": "mpeg4"}, 10),
        (GAP, FRAGMENTS, 10),
        (NEAR_END, {"options": {"bf": "3"}}, 22),
        (NEAR_END, FRAGMENTS, 22),
        ([*STEADY[:10], *STEADY[11:FRAMES]], {}, 10),
        ([*STEADY[:11], STEADY[10] + Fraction(1, 1000), *STEADY[11:FRAMES]], {}, 11),
        ([2 * time for time in STEADY[:FRAMES]], {}, 1),
        ([time * Fraction(21, 20) for time in STEADY[:FRAMES]], {}, 11),
    ],
    ids=[
        "gap", "gap without B", "gap of hevc", "gap of mpeg4", "gap of fragments", "end",
        "end of fragments", "dropped", "doubled", "half rate", "drift",
    ],
)  # fmt: skip
def test_a_camera_of_other_moments_is_refused_with_file_and_frame(scene, root, times, how, frame):
    write_at(scene / "cam_02_rgb.mp4", times, **how)

    named = rf"{KEY}/cam_02_rgb.mp4: its frame {frame} is shown .* 11 other videos, such as cam_00"
    with pytest.raises(StorageError, match=f"{named}.* Encode it again"):
        describe_scene(root, KEY)
    with pytest.raises(StorageError, match=named):
        StereoPairs(root)


@pytest.mark.parametrize("times", [GAP, NEAR_END], ids=["gap", "end"])
def test_depth_of_other_moments_is_refused(scene, root, times):
    write_at(scene / "cam_03_depth.mkv", times)

    done = invoke("index", root)

    assert done.exit_code == 1
    assert f"{KEY}/cam_03_depth.mkv: its frame" in one_line(done.output)


def test_depth_at_another_rate_than_pictures_is_refused(scene, root):
    at_rate(scene, 30, ["depth.mkv"])

    told = "cam_00_depth.mkv: its frame 1 .* 6 other videos, such as cam_00_rgb.mp4, 0.067 s after"
    with pytest.raises(StorageError, match=rf"{told} \(cam_01_depth.mkv, .* likewise\)"):
        describe_scene(root, KEY)


@pytest.mark.parametrize(
    "names", [("cam_01_depth.mkv",), tuple(f"cam_0{n}_depth.mkv" for n in range(6))]
)
def test_depth_that_begins_late_and_is_short_is_refused(scene, root, names):
    for name in names:
        write_at(scene / name, STEADY[2:FRAMES])

    told = rf"{names[0]}: its frame 0 is shown at 0.133 s, .* such as cam_00_rgb.mp4, at 0.000 s"
    with pytest.raises(StorageError, match=told):
        describe_scene(root, KEY)


def test_a_late_begin_alone_is_harmless(scene, root):
    for camera in range(6):
        write_at(scene / f"cam_{camera:02d}_depth.mkv", STEADY[2 : FRAMES + 2])
    write_at(scene / "cam_00_rgb.mp4", STEADY[:FRAMES], file_options={"use_editlist": "0"})

    assert describe_scene(root, KEY).remarks == ()


def test_where_all_begin_at_0_missing_frames_are_assumed_to_be_the_last(scene, root):
    write_at(scene / "cam_04_depth.mkv", STEADY[: FRAMES - 2])

    with pytest.warns(AssumptionWarning, match="22 of all are used, assumed to begin together"):
        pairs = StereoPairs(root)

    assert pairs.index.scene(0).frames == FRAMES - 2


@pytest.mark.parametrize("name", ["cam_02_rgb.mp4", "cam_02_depth.mkv"])
def test_another_rate_is_told_where_the_clip_is_too_short_to_show_it(scene, root, name):
    at_rate(scene, 30)
    tick_s = Fraction(1, 30000) if name.endswith("mp4") else None
    write_at(scene / name, ntsc(), rate_hz=Fraction(30000, 1001), tick_s=tick_s)

    told = f"{name}: shows 29.97 frames a second, and cam_00_rgb.mp4 30"
    with pytest.warns(AssumptionWarning, match=told):
        StereoPairs(root)
    assert told in one_line(invoke("index", root).output)


@pytest.mark.parametrize("rate_hz", [24, Fraction(24000, 1001), 25, Fraction(30000, 1001), 60])
def test_one_rate_in_ticks_of_any_length_is_one_clock(scene, root, rate_hz):
    at_rate(scene, rate_hz)
    times = [n / Fraction(rate_hz) for n in range(FRAMES)]
    write_at(scene / "cam_01_rgb.mp4", times, rate_hz=rate_hz, tick_s=Fraction(1, 1001))
    write_at(scene / "cam_02_rgb.mp4", times, rate_hz=rate_hz, tick_s=Fraction(1, 90000))

    assert describe_scene(root, KEY).remarks == ()


@pytest.mark.parametrize("times", [GAP, VARIABLE], ids=["gap", "variable"])
def test_frames_of_a_clock_that_varies_in_all_videos_alike_are_read_by_order(scene, root, times):
    for camera in range(6):
        write_at(scene / f"cam_{camera:02d}_rgb.mp4", times, options={"g": "6"})
        write_at(scene / f"cam_{camera:02d}_depth.mkv", times, options={"g": "6"})

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pairs = StereoPairs(root, frames="all", fields=("left", "depth"))

    assert len(pairs) == FRAMES
    for frame in (15, 3, 22, 9, 10, 0, 23):
        sample = pairs[frame]
        assert sample["left"].float().mean().item() == pytest.approx(8 * frame, abs=3)
        assert sample["depth"].max().item() == pytest.approx(3 + frame / 1000)


def test_one_camera_that_lacks_a_frame_of_a_variable_clock_is_refused(scene, root):
    for camera in range(6):
        write_at(scene / f"cam_{camera:02d}_rgb.mp4", VARIABLE)
        write_at(scene / f"cam_{camera:02d}_depth.mkv", VARIABLE)
    write_at(scene / "cam_05_rgb.mp4", [*VARIABLE[:5], *VARIABLE[6:], Fraction(4)])

    with pytest.raises(StorageError, match=r"cam_05_rgb.mp4: its frame 5 is shown 0.460 s after"):
        describe_scene(root, KEY)
