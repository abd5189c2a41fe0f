"""The audit of whole scenes: exact ones, the same ones in shards, and ones made wrong."""

import re
import shutil
import zlib

import fsspec
import numpy as np
import pytest

from stereogenbench_data.audit.geometry.audit import audit, open_for_audit
from stereogenbench_data.audit.geometry.table import audit_markdown, pooled_px
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.audit.corruption import (
    as_ray,
    copied,
    depth_of,
    exchange,
    late,
    lengthen_label,
    pictures_of,
    place_cameras,
    read_depth,
    rewrite_depth,
    rewrite_rgb,
    scale_camera,
    scaled,
    without_texture,
)
from tests.servers.tools import rewrite_json

SCENE = "train/Uniform/SynthStage/scene_000000"


@pytest.fixture(scope="module")
def exact(indexed_release):
    """The audit of three frames of each of four scenes that are exact."""
    return audit(indexed_release, frames=3, workers=1)


@pytest.fixture(scope="module")
def decidable_release(tmp_path_factory):
    """A scene that moves enough, before enough texture, for pictures to tell their time."""
    root = tmp_path_factory.mktemp("decidable")
    synthesise(root, SynthRequest(family="Uniform", scenes=1, size_px=64, frames=7, seed=3))
    return root


def figure(scene, quantity, member=""):
    """Return a figure of a scene."""
    (found,) = [
        each.value for each in scene.figures if (each.quantity, each.member) == (quantity, member)
    ]
    return found


def made_wrong(indexed_release, root, change):
    """Return the audit of one scene after change(folder)."""
    change(copied(indexed_release / SCENE, root))
    return audit(root, frames=3, workers=1)


def test_exact_scenes_have_no_finding(exact):
    assert exact.findings == ()
    assert (exact.scenes_there, exact.scenes_audited) == (4, 4)
    assert all(scene.audited_frames == (0, 3, 6) for scene in exact.scenes)


def test_exact_scenes_agree_with_themselves_to_rounding(exact):
    for scene in exact.scenes:
        assert figure(scene, "intrinsics_px") == 0.0
        assert figure(scene, "baseline_cm") <= 1e-9
        assert figure(scene, "rotation_px") <= 1e-9
        assert figure(scene, "lateral_px") <= 1e-6
        for pair in scene.pairs[:2]:
            assert pair.median_px(0) <= 1e-6
            assert pair.kept[-1] > 0.3 * pair.comparable


def test_frames_units_and_payloads_are_those_that_were_written(exact, indexed_release):
    for scene in exact.scenes:
        units = read_depth(indexed_release / scene.key, 2)[0][[0, 3, 6]]
        known = (units > 0) & (units < 65535)
        depth = "cam_02_depth.mkv"

        assert figure(scene, "frames", "cam_02_rgb.mp4") == figure(scene, "frames", depth) == 7
        assert figure(scene, "depth_unit_m", depth) == 0.001
        assert figure(scene, "depth_step", depth) == 1.0
        assert figure(scene, "depth_levels", depth) == len(np.unique(units[known]))
        assert figure(scene, "mean_valid_depth", depth) == pytest.approx(known.mean())
        assert figure(scene, "valid_depth", depth) == pytest.approx(known.mean(axis=(1, 2)).min())


def test_shards_give_the_same_figures_as_the_folder(exact, small_shards):
    packed = audit(small_shards, frames=3, workers=1)

    assert packed.to_json() | {"root": ""} == exact.to_json() | {"root": ""}


def test_a_tree_behind_a_url_is_walked_with_its_broken_scenes(indexed_release):
    store = fsspec.filesystem("memory")
    key = "eval/MapSeenInTrain/Uniform/SynthStage/scene_000000"
    for path in (indexed_release / key).iterdir():
        content = path.read_bytes()
        store.pipe(f"/tree/{key}/{path.name}", content)
        short = content[: len(content) // 2] if path.name == "cam_04_depth.mkv" else content
        store.pipe(f"/tree/{SCENE}/{path.name}", short)

    report = audit("memory://tree", frames=1, workers=1)
    of_eval = audit("memory://tree", frames=1, workers=1, split="eval")
    store.rm("/tree", recursive=True)

    (finding,) = report.findings
    assert (finding.scene, finding.check) == (SCENE, "broken")
    assert "cam_04_depth.mkv" in finding.member + finding.found
    assert report.scenes_audited == of_eval.scenes_audited == 1
    assert of_eval.findings == ()


def test_worker_processes_give_the_same_report(exact, indexed_release):
    assert audit(indexed_release, frames=3, workers=2).to_json() == exact.to_json()


def test_the_table_has_the_papers_figures_beside(exact):
    rows = {row.quantity: row for row in exact.rows}

    fx = "largest deviation of fx, fy, cx, cy from f / s W"
    assert (rows[fx].ours, rows[fx].paper) == ("0 px", "0 px")
    both = rows["both pairs, same step: median / 95th percentile (pixels kept)"]
    assert both.paper == "1.20e-06 px / 4.39e-03 px"


def one_view_twice(folder):
    shutil.copy(folder / "cam_02_rgb.mp4", folder / "cam_03_rgb.mp4")


flat = pictures_of(4, lambda seen: np.full_like(seen, 128))


def without_depth(units):
    units[3] = 0
    return units


def noisy(units):
    noise = np.random.default_rng(0).normal(1, 0.02, units.shape)
    return np.where(units < 65535, np.rint(units * noise), units)


def hidden(units):
    units[:, :, :20] = 300
    return units


def tags(camera, told):
    return lambda folder: rewrite_depth(folder, cameras=[camera], tags=told)


def edit_trajectory(folder, change):
    def change_all(document):
        for frame in document["frames"]:
            change(frame, document["frames"][0])

    rewrite_json(folder / "trajectory.json", change_all)


def turn(frame, _):
    frame["cameras"][1]["rotation"]["yaw"] += 1.0


@pytest.mark.parametrize(
    ("change", "where", "check", "found"),
    [
        (pictures_of(2, lambda seen: (seen * 0.05).astype(np.uint8)), "cam_02_rgb.mp4", "too dark",
         "mean luma, of 255 is "),
        (flat, "cam_04_rgb.mp4", "flat", "of 255 is 0, frame 0 "),
        (pictures_of(1, lambda seen: seen[[0, 1, 2, 3, 3, 3, 3]], crf=0), "cam_01_rgb.mp4",
         "frozen", "is 0, frame 3 (limit 0.25)"),
        (one_view_twice, "cam_03_rgb.mp4", "copied view", "is 100 %, as in cam_02_rgb.mp4"),
        (depth_of(0, without_depth), "cam_00_depth.mkv", "invalid depth",
         "share of pixels with depth is 0 %, frame 3 "),
        (depth_of(0, lambda units: units * 0 + 900), "cam_00_depth.mkv", "invalid depth",
         "count of different depths is 1 "),
        (depth_of(1, lambda units: units[[0] * 7]), "cam_01_depth.mkv", "frozen",
         "depth that changes to the next audited frame while the camera moves is 0 %, frame 0"),
        (depth_of(5, hidden), "cam_05_depth.mkv", "occluder", "covers is 40."),
        (pictures_of(1, late(1)), "cam_01_rgb.mp4", "picture time", "by those of the frame after"),
        (pictures_of(4, lambda seen: seen[::-1]), "cam_04_rgb.mp4", "picture content",
         "correlation with other cameras' pictures"),
        (depth_of(0, lambda units: np.roll(units, 1, 2)), "cam_00_depth.mkv", "depth residual",
         "most in 0-5 (limit 0.05 %); `stereogenbench doctor` looks for the cause: depth, "),
        (depth_of(2, noisy), "cam_02_depth.mkv", "depth agreement", "2 %, but not to 0.5 % is 7"),
        (lambda folder: rewrite_depth(folder, noisy), "", "depth agreement", "(limit 20 %); noise"),
        (depth_of(4, scaled(1.02)), "cam_04_depth.mkv", "depth residual", "is 2.011 %, most"),
        (lambda folder: rewrite_depth(folder, as_ray(folder)), "", "depth residual", ", most in "),
        (lambda folder: scale_camera(folder, sensor_height_mm=3 / 4), "", "motion residual",
         "; `stereogenbench doctor` looks for the cause"),
        (depth_of(3, scaled(2.0)), "cam_03_depth.mkv", "depth consistency", ", most in "),
        (lambda folder: rewrite_depth(folder, lambda u: np.where(u < 65535, u // 20 * 20, u)),
         "cam_00_depth.mkv", "depth quantum", "distance of stored numbers is 20 units"),
        (lambda folder: exchange(folder, {1: 4, 4: 1}), "", "depth consistency", ", most in "),
        (lambda folder: lengthen_label(folder, (2, 3), by_cm=0.05), "", "pose/baseline",
         "is 0.05 cm (limit 0.001 cm)"),
        (lambda folder: edit_trajectory(folder, turn), "", "rig rotation",
         "turn of a camera against camera 0 moves is "),
        (tags(5, {"DEPTH_SCALE": "0.001", "other_scale": "0.1"}), "cam_05_depth.mkv", "unreadable",
         "contradict each other"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)  # fmt: skip
def test_what_is_wrong_is_a_finding(
    indexed_release, decidable_release, tmp_path, change, where, check, found
):
    tells_time = check in ("picture time", "picture content")
    report = made_wrong(decidable_release if tells_time else indexed_release, tmp_path, change)

    (finding, *_) = [each for each in report.findings if each.check == check]
    assert (finding.scene, finding.member) == (SCENE, where)
    assert found in finding.found
    assert report.scenes_audited == 1
    assert any(check in row.ours for row in report.rows if row.check == "findings")
    assert f"## Findings ({len(report.findings)})" in audit_markdown(report)
    assert audit_markdown(report).startswith(f"# WRONG: {len(report.findings)} finding")


@pytest.mark.parametrize(
    ("factors", "named"),
    [
        pytest.param(dict.fromkeys(range(6), 1.1), {""}, id="all places"),
        pytest.param({3: 1.05}, {"", "cam_03_depth.mkv", "cam_03_rgb.mp4"}, id="one place"),
    ],
)
def test_where_places_are_wrong_no_picture_is_called_late_without_the_other_causes(
    decidable_release, tmp_path, factors, named
):
    report = made_wrong(decidable_release, tmp_path, lambda folder: place_cameras(folder, factors))

    told = {each.check: each.found for each in report.findings}
    assert {each.member for each in report.findings} <= named
    assert told["picture time"].partition("; ")[2] == (
        "late or early, or wrong: the pictures, depth, a camera's place, or the lens"
    )
    assert all("a camera's place, or the lens" in found for found in told.values())


def test_no_single_file_is_named_for_what_is_wrong_with_all(decidable_release, tmp_path):
    report = made_wrong(
        decidable_release, tmp_path, lambda folder: rewrite_depth(folder, tags=10.0)
    )

    assert {each.member for each in report.findings} == {""}
    assert {each.check for each in report.findings} >= {"depth residual", "picture time"}


def test_no_file_is_called_late_where_pictures_of_another_camera_seem_late_too(tmp_path):
    request = SynthRequest(family="Uniform", scenes=2, size_px=160, frames=9, seed=36)
    (key,) = synthesise(tmp_path, request, part=(1, 2))
    place_cameras(tmp_path / key, dict.fromkeys(range(6), 0.98))

    (finding,) = audit(tmp_path, workers=1).findings

    assert (finding.member, finding.check) == ("", "picture time")
    assert "in camera 5 " in finding.found


def test_units_that_contradict_one_another_are_one_finding(indexed_release, tmp_path):
    report = made_wrong(
        indexed_release, tmp_path, lambda folder: rewrite_depth(folder, tags=10.0, cameras=[2])
    )

    (finding,) = report.findings
    assert (finding.member, finding.check) == ("cam_*_depth.mkv", "unreadable")
    assert "differ by a scale: 0.001, 0.001, 0.01, 0.001, 0.001, 0.001 m" in finding.found


def standing_still(folder):
    def stand(frame, first):
        frame["cameras"] = first["cameras"]

    rewrite_depth(folder, lambda units: units[[0] * 7])
    rewrite_rgb(folder, lambda seen: seen[[0] * 7])
    edit_trajectory(folder, stand)


@pytest.mark.parametrize(
    ("change", "checks"),
    [
        (without_texture, {"picture time", "picture content"}),
        (standing_still, {"picture time", "motion residual"}),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_the_content_does_not_tell_is_said_to_be_not_testable(
    indexed_release, tmp_path, change, checks
):
    report = made_wrong(indexed_release, tmp_path, change)

    told = {each["check"] for each in report.to_json()["untested"]
            if not re.search(r"camera \d", each["found"])}  # fmt: skip
    rows = {row.check for row in report.rows if "not testable" in row.ours}
    assert checks <= told
    assert checks <= rows
    assert f"## Not testable ({len(report.untested)})" in audit_markdown(report)


def test_one_frame_tells_nothing_of_motion(indexed_release):
    report = audit(indexed_release, frames=1, workers=1, scenes=SCENE)

    untested = {each.check for each in report.untested}
    assert report.findings == ()
    assert "motion residual" in untested
    assert not {"depth consistency", "picture content"} & untested


@pytest.mark.filterwarnings("error")
def test_scenes_that_cannot_be_indexed_are_findings_or_notes(indexed_release, tmp_path):
    cut = copied(indexed_release / SCENE, tmp_path) / "cam_02_rgb.mp4"
    cut.write_bytes(cut.read_bytes()[:-500])
    for path in copied(indexed_release / SCENE.replace("000000", "000001"), tmp_path).glob("cam*"):
        path.unlink()
    copied(indexed_release / "train/IPD_Gaussian/SynthStage/scene_000000", tmp_path)

    report = audit(tmp_path, workers=1)
    of_family = audit(tmp_path, workers=1, family="IPD_Gaussian")
    of_scene = audit(tmp_path, workers=1, scenes=SCENE)

    (finding,) = report.findings
    assert (finding.scene, finding.member, finding.check) == (SCENE, "cam_02_rgb.mp4", "unreadable")
    assert report.notes[0].startswith("incomplete, not audited: train/Uniform")
    assert (report.scenes_there, report.scenes_audited) == (3, 2)
    assert (of_family.findings, of_family.scenes_audited) == ((), 1)
    assert (of_scene.findings, of_scene.scenes_audited) == ((finding,), 1)


def test_a_file_that_changed_after_its_index_is_a_finding(indexed_release, tmp_path):
    folder = copied(indexed_release / SCENE, tmp_path)
    index = open_for_audit(tmp_path)
    (folder / "cam_00_rgb.mp4").unlink()
    (folder / "cam_01_depth.mkv").write_bytes(b"nothing")
    (folder / "trajectory.json").write_text("{")

    report = audit(index, workers=1)

    assert {(each.member, each.check) for each in report.findings} == {
        ("cam_00_rgb.mp4", "unreadable"),
        ("cam_01_depth.mkv", "unreadable"),
        ("trajectory.json", "unreadable"),
    }
    counted = {each.member for each in report.scenes[0].figures if each.quantity == "frames"}
    assert "cam_02_rgb.mp4" in counted
    assert "cam_00_rgb.mp4" not in counted
    assert "baseline_cm" not in {each.quantity for each in report.scenes[0].figures}
    assert audit_markdown(report)


def test_a_sample_is_spread_over_the_scenes_that_pass_the_filters(indexed_release):
    index = open_for_audit(indexed_release)

    def keys(sample, **filters):
        report = audit(index, sample=sample, frames=1, workers=1, **filters)
        return [scene.key for scene in report.scenes]

    every = keys(None)
    assert keys(2) == [every[0], every[-1]]
    assert keys(1, split="train")[0].startswith("train/")
    with pytest.raises(SelectionError, match="matches none of 4 scenes"):
        keys(2, map="Nowhere")


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    """Audit, and be stopped at the end: the results stay in a cache."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))

    def run(index, frames, **options):
        told = []

        def progress(done, total):
            told.append(done)
            if told[-2:] == [total, total]:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt, match=r"^$"):
            audit(index, frames=frames, workers=1, progress=progress, **options)
        return told[0]

    return run


def test_results_of_other_frames_or_changed_files_are_not_used(indexed_release, tmp_path, stopped):
    folder = copied(indexed_release / SCENE, tmp_path / "data")
    index = open_for_audit(tmp_path / "data")

    known = [stopped(index, 2), stopped(index, 2), stopped(index, 3)]
    again = audit(index, frames=2, workers=1)
    flat(folder)
    changed = open_for_audit(tmp_path / "data")
    known.append(stopped(changed, 3))

    assert known == [0, 2, 0, 0]
    assert again.findings == ()
    assert [each.check for each in audit(changed, frames=2, workers=1).findings] == ["flat"]


def test_a_damaged_result_is_passed_over(exact, indexed_release, tmp_path, stopped):
    index = open_for_audit(indexed_release)
    stopped(index, 3, scenes=SCENE)
    (kept,) = (tmp_path / "cache").rglob("audit-*/*/*")
    text = zlib.decompress(kept.read_bytes())
    kept.write_bytes(zlib.compress(text.replace(b'"figures": [{', b'"figures": [{"odd": 1, ')))

    report = audit(index, frames=3, workers=1, scenes=SCENE)

    (expected,) = [scene for scene in exact.to_json()["scenes"] if scene["key"] == SCENE]
    assert report.to_json()["scenes"] == [expected]


def test_quantiles_of_scenes_are_pooled_by_their_pixels():
    rng = np.random.default_rng(0)
    parts = [rng.exponential(1.0, 4000), rng.exponential(30.0, 12000), np.empty(0)]
    counts = [len(part) for part in parts]
    errors_px = [
        np.quantile(part, np.linspace(0, 1, 41)).tolist() if len(part) else [] for part in parts
    ]

    everything = np.concatenate(parts)
    assert pooled_px(counts, errors_px, 0.5) == pytest.approx(
        np.quantile(everything, 0.5), rel=0.05
    )
    assert pooled_px(counts, errors_px, 0.95) == pytest.approx(
        np.quantile(everything, 0.95), rel=0.1
    )
    assert pooled_px(counts[:1], errors_px[:1], 0.5) == pytest.approx(np.median(parts[0]))
    assert np.isnan(pooled_px(counts[2:], errors_px[2:], 0.5))


def test_the_shared_scene_is_right_by_its_metadata_and_depth(shared_scenes):
    report = audit(shared_scenes, frames=2, workers=1)

    (scene,) = report.scenes
    assert report.findings == ()
    assert figure(scene, "baseline_cm") <= 1e-9
    assert scene.pairs[0].median_px(0) <= 1e-6
    assert scene.pairs[0].kept[-1] > 0.9 * scene.pairs[0].comparable
