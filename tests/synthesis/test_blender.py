"""Scenes rendered by Blender, judged from what comes out. They are skipped where bpy is missing."""

import importlib.util
import json
import os
import shutil
import signal
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.synthesis.blender.process import blender
from stereogenbench_data.synthesis.blender.renderer import BlenderAssetWarning, BlenderRenderer
from stereogenbench_data.synthesis.filters import check_poses
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.proposal import Proposal, Rig
from stereogenbench_data.synthesis.renderer import ScenePlan, Spawn
from stereogenbench_data.synthesis.request import SENSOR_MM, SynthRequest
from tests.cli.command import succeed
from tests.servers.tools import run_python
from tests.synthesis.conftest import Drawn
from tests.synthesis.test_pictures import psnr_db

HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None,
    reason="needs the extra blender, whose bpy 5.2 needs Python 3.13",
)


@pytest.fixture(scope="session")
def assets(tmp_path_factory):
    """A folder with a yard, a room, a walking figure, and assets that have a fault each."""
    folder = tmp_path_factory.mktemp("blender") / "assets"
    run_python(HERE / "make_blender_assets.py", folder)
    return folder


@pytest.fixture(scope="session")
def renderer(assets):
    """The renderer of the sound assets."""
    return BlenderRenderer.from_file(assets / "assets.toml")


def proposal(*, on="Yard", take="Walk", frames=3, size_px=64, height_px=None, sensor_mm=SENSOR_MM):
    """A proposal of a rig of 10 cm gaps, made by hand."""
    request = SynthRequest(
        map_name=on,
        frames=frames,
        size_px=size_px,
        height_px=height_px,
    )
    return Proposal(
        request=request,
        index=0,
        number=0,
        map_name=on,
        character="Figure",
        animation=take,
        sensor_mm=sensor_mm,
        focal_mm=28.0,
        places_cm=np.arange(6) * 10.0,
        offset_cm=np.zeros(3),
    )


def plan(made, *, eye=(-4.0, -1.5, 1.7), target=(0.0, 0.0, 0.9), place=(0.0, 0.0, 0.0)):
    """A plan whose rig stands still and looks at a point."""
    x, y, z = np.subtract(target, eye)
    rotator = [np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x)), 1.5]
    frames = made.request.frames
    return ScenePlan(
        proposal=made,
        spawn=Spawn(np.array(place), 20.0),
        centres_m=np.tile(np.array(eye), (frames, 1)),
        rotators_deg=np.tile(np.array(rotator), (frames, 1)),
        subject_m=np.full(frames, 4.0),
    )


def fast(renderer, **settings):
    """The same renderer with few samples."""
    settings = {"samples_per_pixel": 1, "denoise": False} | settings
    return replace(
        renderer,
        assets=replace(renderer.assets, settings=replace(renderer.assets.settings, **settings)),
    )


def views(renderer, made, cameras=(0, 1, 2, 3, 4, 5)):
    return list(renderer.views(made, cameras=cameras))


# What a map and a subject answer.


def test_rays_meet_the_walls_of_a_room_where_they_were_built(renderer):
    """The table stands at Blender's y = 2.2, so at y = -2.2 of a left-handed map."""
    world = renderer.world(proposal(on="Room"))
    axes = np.concatenate([np.eye(3), -np.eye(3)])

    met_m = world.cast(np.tile([0.0, 0.5, 1.0], (6, 1)), axes)
    down_m = world.cast(np.array([[2.8, -2.2, 3.0], [2.8, 2.2, 3.0]]), np.tile(-axes[2], (2, 1)))

    np.testing.assert_allclose(met_m, [4.5, 3.0, 2.2, 4.5, 4.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(down_m, [3.0 - 1.35, 3.0], atol=1e-6)


def test_a_camera_inside_a_solid_sees_nothing(renderer):
    """The filter of visibility refuses it; a pose with the same view beside the solid passes."""
    world = renderer.world(proposal(on="Room"))
    body_m = np.tile(np.linspace([0.0, 0.0, 0.1], [0.0, 0.0, 1.7], 12), (2, 1, 1))
    centres_m = np.array([[2.4, -2.0, 0.3], [2.4, 0.0, 1.0]])
    aims = np.array([0.0, 0.0, 0.9]) - centres_m
    rotators_deg = np.degrees(
        [[np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x), 0.0] for x, y, z in aims]
    )

    reasons = check_poses(
        centres_m, rotators_deg,
        body_m=body_m, rig=Rig(np.linspace(-0.01, 0.01, 6), (1.5, 1.5)), world=world,
    )  # fmt: skip

    assert reasons[0] in ("collision", "visibility")
    assert reasons[1] == ""


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -30.0])
def test_the_subject_stands_on_its_place_and_walks_where_it_faces(renderer, yaw_deg):
    world = renderer.world(proposal(frames=81))
    spawn = Spawn(np.array([1.0, -2.0, 0.5]), yaw_deg)

    points = np.stack([world.subject_points_m(spawn, frame=frame) for frame in range(81)])

    assert points.shape[1] >= 8
    assert points[0, :, 2].min() == pytest.approx(0.5, abs=0.02)
    assert points[0, :, 2].max() - 0.5 == pytest.approx(1.7, abs=0.05)
    assert points[..., 2].min() >= 0.5 - 1e-6
    # 1.3 m a second, that is a take of 24 frames at 24 Hz, repeated from where it led.
    way = points[75].mean(axis=0) - points[0].mean(axis=0)
    ahead = rotation_from_rotator_deg(np.array([0.0, yaw_deg, 0.0]))[:, 0]
    np.testing.assert_allclose(way, 6.5 * ahead, atol=1e-3)
    assert np.linalg.norm(np.diff(points, axis=0), axis=2).max() < 0.35


def _changed(assets, before, after):
    path = assets / "changed.toml"
    text = (assets / "assets.toml").read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    return BlenderRenderer.from_file(path)


def test_all_kinds_of_files_give_the_same_motion(assets):
    """A take of one file moves the mesh of another with the same bones."""
    found = []
    for mesh in ("blend", "glb", "fbx"):
        for motion in ("blend", "glb", "fbx"):
            text = (
                f'[maps.Yard]\nfile = "yard.blend"\n[characters.Figure]\nfile = "figure.{mesh}"\n'
                f'[animations.Walk]\nfile = "figure.{motion}"\ntake = "Walk"\n'
            )
            path = assets / "kinds.toml"
            path.write_text(text)
            world = BlenderRenderer.from_file(path).world(proposal(frames=30))
            spawn = Spawn(np.zeros(3), 0.0)
            points = np.stack([world.subject_points_m(spawn, frame=t) for t in range(30)])
            found.append(np.concatenate([points.min(axis=1), points.max(axis=1)]))

    np.testing.assert_allclose(found[1:], [found[0]] * 8, atol=4e-3)


def test_only_what_hangs_on_the_armature_is_the_subject(assets):
    """Neither the plinth below it nor the shape of a handle, whose collection is excluded."""
    file = '[characters.Figure]\nfile = "figure.glb"'
    spawn = Spawn(np.zeros(3), 0.0)
    alone = _changed(assets, file, file).world(proposal())
    changed = _changed(assets, file, file.replace("figure.glb", "figure_extra.blend"))

    world = changed.world(proposal())

    for points in (each.subject_points_m(spawn, frame=0) for each in (alone, world)):
        np.testing.assert_allclose(points[:, 2].min(), 0, atol=0.02)
        np.testing.assert_allclose(np.ptp(points, axis=0), [0.46, 0.56, 1.7], atol=0.02)


@pytest.mark.parametrize(("take", "repeat"), [("Lean", "onward"), ("Walk", "back")])
def test_a_take_that_cannot_go_on_is_played_back(assets, take, repeat):
    changed = _changed(assets, 'take = "Walk"', f'take = "{take}"\nrepeat = "{repeat}"')
    world = changed.world(proposal(frames=32))
    spawn = Spawn(np.zeros(3), 0.0)

    points = np.stack([world.subject_points_m(spawn, frame=frame) for frame in range(32)])

    # Takes of a second: frames 0 and 30 are its start, 15 is its end.
    np.testing.assert_allclose(points[30], points[0], atol=1e-4)
    np.testing.assert_allclose(points[16], points[14], atol=1e-4)
    assert np.abs(points[15] - points[0]).max() > 0.3


# What is rendered.


def test_depth_is_that_of_another_librarys_rays(renderer, assets, tmp_path):
    """Oblong pixels, and a fan that turns. Rays pass within half a hundredth of pixels' centres."""
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh, and embreex to be fast")
    frame = 7
    made = proposal(
        frames=frame + 1,
        size_px=96,
        height_px=64,
        sensor_mm=(23.76, 12.0),
    )
    still = plan(made, eye=(-5.0, -2.0, 1.8), target=(0.0, 0.0, 2.4), place=(300.0, 0.0, 0.0))

    last = views(fast(renderer), still, cameras=(0, 5))[-2:]

    out = tmp_path / "truth.npz"
    when = 1 + frame / 15 * 24
    run_python(HERE / "blender_truth.py", assets / "yard.blend", when, out)
    corners = np.load(out)["corners"] * [1, -1, 1]
    mesh = trimesh.Trimesh(
        corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False
    )
    for camera, rendered in zip((0, 5), last, strict=True):
        view = still.view(camera=camera, frame=frame)
        forward_axis, right_axis, up_axis = view.axes.T
        truths_m = []
        for x, y in product((-0.005, 0.0, 0.005), repeat=2):
            right = (np.arange(96) + 0.5 + x - 48) / view.focal_px[0]
            down = (np.arange(64) + 0.5 + y - 32) / view.focal_px[1]
            rays = (
                forward_axis + right[None, :, None] * right_axis - down[:, None, None] * up_axis
            ).reshape(-1, 3)
            _, which, met = mesh.ray.intersects_id(
                np.tile(view.eye, (len(rays), 1)), rays, multiple_hits=False, return_locations=True
            )
            truth_m = np.full(len(rays), np.inf)
            truth_m[which] = (met - view.eye) @ forward_axis
            truths_m.append(truth_m.reshape(64, 96))
        least_m, most_m = np.min(truths_m, axis=0), np.max(truths_m, axis=0)
        depth_m = rendered.depth_m
        assert (depth_m >= least_m * (1 - 1e-6)).all()
        assert (depth_m <= most_m * (1 + 1e-6)).all()
        seen = np.isfinite(most_m)
        assert np.quantile(most_m[seen] / least_m[seen], [0.5, 0.9]) == pytest.approx(1, abs=2e-3)
        assert np.isinf(depth_m).mean() > 0.05


def test_pictures_have_sky_exactly_where_depth_has_none(renderer):
    """So intrinsics of pictures and depth agree, also with oblong pixels."""
    made = proposal(frames=1, size_px=96, height_px=64, sensor_mm=(23.76, 12.0))

    shown = views(
        fast(renderer, samples_per_pixel=8), plan(made, target=(0.0, 0.0, 2.4)), cameras=(0, 5)
    )

    for view in shown:
        picture = view.picture.astype(int)
        is_sky = (picture[..., 2] > 200) & (picture[..., 2] > picture[..., 0] + 20)
        nothing = np.isinf(view.depth_m)
        assert 0.1 < nothing.mean() < 0.9
        assert (is_sky == nothing).mean() > 0.985


def test_depth_goes_through_holes_that_a_material_cuts(assets):
    """A red card with holes, before a blue wall on the left and nothing on the right."""
    changed = _changed(assets, "yard.blend", "screen.blend")
    quick = fast(changed, samples_per_pixel=4)
    made = plan(
        proposal(frames=1), eye=(-4.0, 0.0, 1.8), target=(2.0, 0.0, 1.8), place=(0.0, 100.0, 0.0)
    )

    for view in views(quick, made, cameras=(0, 5)):
        red, green, blue = np.moveaxis(view.picture.astype(int), -1, 0)
        pure = np.maximum(np.maximum(red, green), blue) == red + green + blue
        card, wall = pure & (red > 240), pure & (blue > 240)
        sky = red + green + blue == 0
        assert min(card.mean(), wall.mean(), sky.mean()) > 0.1
        assert 5.5 < view.depth_m[card].min() <= view.depth_m[card].max() < 6.6
        assert 9.4 < view.depth_m[wall].min() <= view.depth_m[wall].max() < 10.4
        assert np.isinf(view.depth_m[sky]).all()


def test_the_same_plan_gives_the_same_bytes_in_another_blender(renderer):
    made = plan(proposal(frames=2))
    few = fast(renderer, samples_per_pixel=4, denoise=True)

    first = views(few, made)
    blender(renderer.assets.maps["Yard"].file).close()
    second = views(few, made)

    assert len(first) == 12
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.picture, other.picture)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
    assert not np.array_equal(first[0].picture, first[1].picture)
    assert not np.array_equal(first[0].depth_m, first[6].depth_m)


def test_the_command_renders_all_maps_of_the_assets(assets, tmp_path):
    quick = tmp_path / "assets"
    shutil.copytree(assets, quick)
    text = (quick / "assets.toml").read_text()
    (quick / "assets.toml").write_text(text.replace("= 32", "= 1\ndenoise = false"))
    options = ["--size", "32", "--frames", "1", "--scenes", "2", "--seed", "5", "--workers", "1"]
    of_blender = ["--assets", quick / "assets.toml"]

    result = succeed("synth", tmp_path / "out", *options, *of_blender)

    markers = (tmp_path / "out").rglob("_scene_complete.json")
    assert {marker.parts[-3] for marker in markers} <= {"Room", "Yard"}
    assert "2 scenes in train/IPD_Gaussian/" in result.stdout


# Assets that cannot be used.

FAULTS = {
    "empty.blend": r"empty\.blend: the map is empty.*Show its",
    "huge.blend": r"huge\.blend: its width is 8e\+04 m.*Set scale = 0\.001",
    "far_texture.blend": r"refers to .*outside.far\.png, which is outside the asset folder.*Copy",
    "cut.blend": r"cut\.blend: Blender cannot open it",
    "cut.fbx": r"cut\.fbx: Blender cannot open it .*Repair it, and save it",
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_map_is_refused_with_the_cure(assets, name):
    changed = _changed(assets, "yard.blend", name)

    with pytest.raises(SynthesisError, match=rf"maps\.Yard: .*{FAULTS[name]}"):
        changed.world(proposal())


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ('[characters.Figure]\nfile = "figure.glb"', '[characters.Figure]\nfile = "boneless.blend"',
         r"characters\.Figure: .*has no armature.*it has 'mesh'"),
        ('[characters.Figure]', '[characters.Figure]\nscale = 100',
         r"characters\.Figure: .*height is 170 m.*Set scale = 1 "),
        ('[characters.Figure]', '[characters.Figure]\nscale = 0.01',
         r"height is 0\.017 m.*Set scale = 1 "),
        ('file = "figure.glb"\ntake = "Walk"', 'file = "figure.glb"',
         r"animations\.Walk: .*has 3 takes.*'Lean', 'Turn', 'Walk'"),
        ('take = "Walk"', 'take = "Run"', r"'Walk'.*take = 'Run' names 0 of them"),
        ('file = "figure.glb"\ntake = "Walk"', 'file = "other_bones.blend"',
         r"moves no bone of the armature.*'Bip01'.*'arm\.L'"),
        ('file = "figure.glb"\ntake = "Walk"', 'file = "boneless.blend"',
         r"has 0 takes that move bones"),
    ],
)  # fmt: skip
def test_a_faulty_subject_is_refused_with_the_cure(assets, before, after, says):
    changed = _changed(assets, before, after)

    with pytest.raises(SynthesisError, match=says):
        changed.world(proposal())


def test_scripts_in_files_do_not_run_and_are_told(assets):
    changed = _changed(assets, "yard.blend", "scripted.blend")

    with pytest.warns(BlenderAssetWarning, match=r"left out or not run: .*was_driven"):
        world = changed.world(proposal())

    assert not list((assets.parent / "outside").glob("was_*"))
    # The driver would have lifted the floor by 3 m.
    fall_m = world.cast(np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 0.0, -1.0]]))
    assert fall_m == pytest.approx([2.0], abs=0.2)


def test_a_scene_on_which_blender_crashed_is_rendered_by_the_next_run(renderer, tmp_path):
    request = SynthRequest(map_name=("Yard",), size_px=32, frames=2, seed=1)
    quick = fast(renderer)

    def kill(done, total):
        if done == 6:
            os.kill(blender(renderer.assets.maps["Yard"].file).process.pid, signal.SIGSEGV)

    with pytest.raises(SynthesisError, match=r"scene_000000, frame 1: Blender crashed"):
        synthesise(tmp_path, request, renderer=quick, progress=kill)
    assert not list(tmp_path.rglob("_scene_complete.json"))
    (key,) = synthesise(tmp_path, request, renderer=quick)

    assert (tmp_path / key / "_scene_complete.json").exists()
    assert synthesise(tmp_path, request, renderer=quick) == [key]  # without a warning


# Whole scenes, as any reader of the release takes them.


@pytest.fixture(scope="session")
def rendered(renderer, tmp_path_factory):
    """A tree of two scenes, one of each map, 256 px wide."""
    root = tmp_path_factory.mktemp("rendered")
    quick = fast(renderer, samples_per_pixel=8, denoise=True)
    for name, family in (("Room", "IPD_Gaussian"), ("Yard", "Uniform")):
        request = SynthRequest(
            map_name=(name,), family=family, size_px=256, frames=2, seed=3, focal_mm=20.0
        )
        synthesise(root, request, renderer=quick)
    return root


@pytest.fixture
def scenes(rendered):
    """The two scenes, read with PyAV and json alone."""
    return [Drawn(marker.parent) for marker in sorted(rendered.rglob("_scene_complete.json"))]


def test_visible_pixels_agree_when_warped_by_depth(scenes):
    for scene in scenes:
        for left in range(5):
            agreement_db, kept = psnr_db(scene, left=left, right=left + 1, frame=1)
            assert agreement_db > 29
            assert kept > 0.2
        agreement_db, _ = psnr_db(scene, left=0, right=5, frame=1)
        assert agreement_db > 28


def test_the_doctor_confirms_the_contract_and_the_audit_finds_nothing(rendered):
    few = ("--per-scene", "2", "--workers", "1")

    doctor = succeed("doctor", rendered, *few, "--scenes", "2", "--json")
    succeed("audit", rendered, *few)

    (verdict,) = json.loads(doctor.stdout)["verdicts"]
    assert len(verdict["scenes"]) == 2
    assert verdict["quotient"] == pytest.approx(1, rel=0.01)
    found = {answer["topic"]: answer["status"] for answer in verdict["answers"]}
    assert found["depth scale"] == "confirmed"
    assert found["depth along"] == "confirmed"
