"""Runs that go well, are stopped, fail, and are run again."""

import errno
import multiprocessing
import os
import shutil

import pytest

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.media.encoder import VideoWriter
from stereogenbench_data.synthesis.produce import plan_scenes, synthesise
from stereogenbench_data.synthesis.request import ExportContract, SynthRequest
from tests.servers.tools import files_of

SMALL = {"size_px": 32, "frames": 2, "seed": 9}


@pytest.mark.parametrize(
    ("asked", "folder"),
    [
        ({"family": "Uniform", "map_name": "Stylized_Egypt"}, "train/Uniform/Stylized_Egypt"),
        (
            {"split": "eval", "subset": "unseen_map"},
            "eval/MapUnseenInTrain/IPD_Gaussian/SynthStage",
        ),
    ],
)
def test_scenes_are_written_to_the_folders_of_the_release(tmp_path, asked, folder):
    key = f"{folder}/scene_000000"

    assert synthesise(tmp_path, SynthRequest(**asked, **SMALL)) == [key]
    assert {path.name for path in tmp_path.iterdir()} == {key.split("/")[0], ".generation"}
    assert len(files_of(tmp_path / key)) == 17


def test_an_interrupted_run_of_two_processes_goes_on_to_the_same_scenes_as_one_alone(tmp_path):
    small = SMALL | {"frames": 3}
    request = SynthRequest(scenes=2, **small)

    def stop(done, total):
        if done >= 21:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesise(tmp_path, request, workers=2, progress=stop)

    assert not multiprocessing.active_children()
    assert not list(tmp_path.glob(".generation/*/"))
    finished = [path.parent for path in tmp_path.rglob("_scene_complete.json")]
    assert [path.name for path in tmp_path.rglob("scene_*") if path.is_dir()] == [
        folder.name for folder in finished
    ]
    before = {folder: folder.stat().st_mtime_ns for folder in finished}

    first, second = synthesise(tmp_path, request)
    (alone,) = synthesise(tmp_path / "alone", SynthRequest(scenes=1, **small))

    assert {folder: folder.stat().st_mtime_ns for folder in finished} == before
    assert len(files_of(tmp_path / first)) == len(files_of(tmp_path / second)) == 17
    assert files_of(tmp_path / first) == files_of(tmp_path / "alone" / alone)
    assert files_of(tmp_path / first) != files_of(tmp_path / second)


def test_incomplete_scenes_of_a_killed_run_are_rendered_again(tmp_path):
    request = SynthRequest(**SMALL)
    synthesise(tmp_path, request)
    (lock,) = tmp_path.glob(".generation/*.lock")
    stale = lock.with_suffix("") / request.key(0)
    shutil.rmtree(tmp_path / request.key(0))
    stale.mkdir(parents=True)
    (stale / "cam_00_rgb.mp4").write_bytes(b"cut")
    (stale / "stray.txt").write_text("not ours")

    (key,) = synthesise(tmp_path, request)

    assert len(files_of(tmp_path / key)) == 17
    assert not stale.exists()


def test_a_scene_that_another_request_wrote_is_neither_kept_nor_overwritten(tmp_path):
    (key,) = synthesise(tmp_path, SynthRequest(**SMALL))
    before = files_of(tmp_path)

    for other, differs in (
        ({"frames": 3}, "its frames is 2, and 3 in this one"),
        ({"seed": 1}, r"its seed is \d+, and 1 in this one"),
        ({"scenes": 3, "focal_mm": 30.0}, r"its focal_mm is [\d.]+, and 30\.0 in this one"),
        ({"height_px": 34}, r"its picture_px is \[\d+, \d+\], and \[\d+, 34\] in this one"),
        ({"contract": ExportContract(depth_unit_m=0.01)}, r"its contract is .*unit_m=0\.01"),
    ):
        for act in (synthesise, plan_scenes):
            match = rf"scene_000000: another request wrote .*{differs}"
            with pytest.raises(SynthesisError, match=match):
                act(tmp_path, SynthRequest(**(SMALL | other)))
    assert files_of(tmp_path) == before
    (tmp_path / key / "_scene_complete.json").unlink()
    with pytest.raises(SynthesisError, match=r"its _scene_complete\.json is missing or damaged"):
        synthesise(tmp_path, SynthRequest(**SMALL))


def test_a_full_disk_is_an_error_that_names_the_cure(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(VideoWriter, "write", fail)

    with pytest.raises(SynthesisError, match=r"cannot write there .No space left .* Make room"):
        synthesise(tmp_path, SynthRequest(**SMALL))
    assert [path.name for path in tmp_path.iterdir()] == [".generation"]


def test_two_runs_do_not_draw_the_same_part_at_once_and_other_parts_side_by_side(tmp_path):
    request = SynthRequest(scenes=2, **SMALL)

    def second_run(done, total):
        if done == 6:
            with pytest.raises(SynthesisError, match=r"another process is drawing .* --part"):
                synthesise(tmp_path, request, part=(1, 2))
            assert len(synthesise(tmp_path, request)) == 2

    (first,) = synthesise(tmp_path, request, part=(1, 2), progress=second_run)

    assert len(files_of(tmp_path / first)) == 17
    assert not list(tmp_path.glob(".generation/*/"))
