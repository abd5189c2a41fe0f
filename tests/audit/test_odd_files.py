"""Six odd files of docs/release.md, each from its first error to a training."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from stereogenbench_data.audit.survey import survey
from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.index.table import SceneIndex
from tests.cli.command import invoke, succeed
from tests.servers.scene_fixtures import PLACES_CM

PAGE = Path(__file__).resolve().parents[2] / "docs" / "release.md"


def lens(baseline, _):
    baseline["camera_intrinsics"] = {"FocalLength_cm": 3.0, "Filmback_Width": 24.0}


def field_of_view(baseline, _):
    baseline["camera_intrinsics"] = {"hfov_deg": 43.6}


def rows(baseline, _):
    baseline["baselines"] = [
        {"from": row["camera_index_a"], "to": row["camera_index_b"],
         "distance": row["baseline_cm"] / 100}
        for row in baseline.pop("pairwise_pairs")
    ]  # fmt: skip


def tilted(trajectory):
    """Turn all cameras, in degrees, and let them stand along the axis to their right."""
    rotator = np.array([-10.0, 30.0, 2.0])
    right = rotation_from_rotator_deg(rotator)[:, 1]
    for frame in trajectory["frames"]:
        for pose in frame["cameras"]:
            place = np.array([500.0 + frame["frame_index"], 0.0, 160.0])
            place += PLACES_CM[pose["camera_index"]] * right
            pose["location"] = dict(zip("xyz", place.tolist(), strict=True))
            pose["rotation"] = dict(zip(("pitch", "yaw", "roll"), rotator.tolist(), strict=True))


def radians(_, trajectory):
    tilted(trajectory)
    for frame in trajectory["frames"]:
        for pose in frame["cameras"]:
            pose["rotation"] = {key: np.deg2rad(at).item() for key, at in pose["rotation"].items()}


def columns(_, trajectory):
    frames = trajectory.pop("frames")
    trajectory["cameras"] = [
        {"name": f"Cam_{camera:02d}"} | {
            key: {axis: [frame["cameras"][camera][key][axis] for frame in frames]
                  for axis in frames[0]["cameras"][camera][key]}
            for key in ("location", "rotation")
        }
        for camera in range(6)
    ]  # fmt: skip


EDITS = (lens, field_of_view, rows, radians, columns, None)
TAGS = {"depth_near": "0.5", "depth_far": "66.035"}


def examples():
    """The number of each worked example, and its blocks by their language."""
    text = PAGE.read_text().partition("## Six odd files")[2].partition("\n## ")[0]
    for section in text.split("\n### ")[1:]:
        blocks = re.findall(r"```(\w+)\n(.*?)```", section, flags=re.DOTALL)
        yield int(section.partition(".")[0]), dict(blocks)


def is_part(excerpt, document):
    """Whether a document has all that an excerpt shows; lists may have more elements."""
    if isinstance(excerpt, dict):
        return all(key in document and is_part(each, document[key])
                   for key, each in excerpt.items())  # fmt: skip
    if isinstance(excerpt, list):
        return all(is_part(a, b) for a, b in zip(excerpt, document, strict=False))
    return excerpt == pytest.approx(document) if isinstance(excerpt, float) else excerpt == document


@pytest.mark.parametrize(("number", "blocks"), [*examples()])
def test_an_odd_file_is_told_and_proposed_and_trained_on(
    number, blocks, make_scene, root, rewrite, video, tmp_path
):
    folder, edit = make_scene(), EDITS[number - 1]
    documents = [json.loads((folder / name).read_text())
                 for name in ("baseline.json", "trajectory.json")]  # fmt: skip
    if edit is None:
        for camera in range(6):
            shutil.copy(video("depth.mkv", tags=TAGS), folder / f"cam_{camera:02d}_depth.mkv")
    else:
        edit(*documents)
        for name, document in zip(("baseline.json", "trajectory.json"), documents, strict=True):
            rewrite(folder / name, lambda old, new=document: (old.clear(), old.update(new)))
        assert any(is_part(json.loads(blocks["json"]), document) for document in documents)
    file = tmp_path / "conventions.toml"
    file.write_text(blocks["toml"])

    try:
        told = " ".join(each.text for each in SceneIndex.open(root).scene(0).remarks)
    except StereoGenBenchError as error:
        told = str(error)
    proposed = survey(root, pictured=0, workers=1).toml

    assert " ".join(blocks["text"].split()) in " ".join(told.split())
    if number not in (5, 6):
        for line in blocks["toml"].splitlines()[1:]:
            assert not line or f"# {line}" in proposed
    fields = ("left", "right", "disparity", "world_from_left")
    pairs = StereoPairs(root, conventions=file, fields=fields, frames="all", pairs="all")
    loader = pairs.loader(batch_size=4, num_workers=0, seed=0)
    weight = torch.zeros(3, 1, requires_grad=True)
    batch = next(iter(loader))
    guess = torch.einsum("bchw,co->bohw", batch["left"].float(), weight)
    (guess - batch["disparity"]).abs().mean().backward()
    assert weight.grad.abs().sum() > 0
    assert SceneIndex.open(root, conventions=file).scene(0).lateral_m == pytest.approx(
        np.array(PLACES_CM) / 100, abs=1e-6
    )


def as_rows(document):
    """A row for each frame and camera, in place of frames that have cameras."""
    document["poses"] = [
        {"frame": frame["frame_index"], "camera": pose["camera_index"],
         **{key: pose[key] for key in ("location", "rotation")}}
        for frame in document.pop("frames") for pose in frame["cameras"]
    ]  # fmt: skip


def as_six_numbers(document):
    """Place and angles of each pose in one list."""
    for frame in document["frames"]:
        for pose in frame["cameras"]:
            pose["pose"] = [*pose.pop("location").values(), *pose.pop("rotation").values()]


def all_poses(root, **how):
    fields = ("right_from_left", "world_from_left")
    pairs = StereoPairs(root, fields=fields, frames="all", pairs="all", **how)
    return torch.stack([sample[field] for sample in pairs for field in fields])


OF_SIX_NUMBERS = """
format = 2
[poses]
location = "$.frames[].cameras[].pose[0:3]"
rotation = "$.frames[].cameras[].pose[3:6]"
frame = "$.frames[].frame_index"
camera = "$.frames[].cameras[].camera_index"
outer = "frames"
form = "rotator pitch yaw roll deg"
axes = "unreal"
unit = "cm"
"""


@pytest.mark.parametrize(("change", "stated"), [(as_rows, None), (as_six_numbers, OF_SIX_NUMBERS)])
def test_rows_are_read_as_written_and_angles_in_a_part_of_a_list_as_a_file_says(
    make_scene, root, rewrite, tmp_path, change, stated
):
    folder, file = make_scene(), tmp_path / "conventions.toml"
    rewrite(folder / "trajectory.json", tilted)
    usual = all_poses(root)
    rewrite(folder / "trajectory.json", change)
    if stated is not None:
        file.write_text(stated)
    else:
        succeed("conventions", root, "-o", file, "--pictures", "0", "--workers", "1")
        assert 'outer = "rows"' in file.read_text()

    assert torch.equal(all_poses(root, conventions=file), usual)


def test_the_page_has_six_odd_files():
    assert [number for number, _ in examples()] == [1, 2, 3, 4, 5, 6]


def test_the_last_line_says_what_is_settled_and_the_next_command(
    make_scene, root, rewrite, tmp_path
):
    rewrite(make_scene() / "baseline.json", lambda document: lens(document, None))
    file, options = tmp_path / "conventions.toml", ("--pictures", "0", "--workers", "1")

    odd = invoke("conventions", root, "-o", file, *options)
    file.write_text(dict(examples())[1]["toml"])
    cured = succeed("conventions", root, "--check", file, *options)

    assert odd.exit_code == 1
    last, last_cured = (each.stderr.splitlines()[-1] for each in (odd, cured))
    assert last.startswith("settled: nothing; not settled: baseline.json, poses, depth. Next: ")
    assert f"--check {file}" in last
    assert last_cured == (
        f"{file}: fits. Next: stereogenbench show {root} --conventions {file} -o first.png"
    )


def test_a_principal_point_that_stops_intrinsics_is_not_settled(make_scene, root, rewrite):
    rewrite(
        make_scene() / "baseline.json",
        lambda document: document["camera_intrinsics"].update(cx=300.5),
    )

    told = invoke("conventions", root, "--pictures", "0", "--workers", "1")

    assert told.exit_code == 1
    assert re.search(r"NOT SETTLED: .*principal point \(300\.5, 0\)", told.stderr)
    assert "not settled: baseline.json. Next: " in told.stderr
