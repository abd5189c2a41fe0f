"""A folder belongs to one job: others are refused, also such as begin at the same moment."""

import subprocess
import sys

import pytest

from stereogenbench_data.bridges.clips import export_clips
from stereogenbench_data.errors import StorageError
from stereogenbench_data.jobs import job_folder
from stereogenbench_data.media.encoder import Encoding

ONE_OF_TWO = """
import sys, time, warnings
from pathlib import Path
warnings.simplefilter("ignore")
data, out, size, started = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
from stereogenbench_data.bridges.clips import export_clips
from stereogenbench_data.media.encoder import Encoding
(started / str(size)).touch()
while len([*started.iterdir()]) < 2:
    time.sleep(0.001)
form = dict(size=(size, size), encoding=Encoding(preset="ultrafast"))
export_clips(data, out, layout="diffsynth", **form, workers=1)
"""


def files_of(root):
    return {
        str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


def test_of_two_jobs_at_once_one_is_whole_and_the_other_refused(indexed_release, tmp_path):
    """Clips stand for all jobs: they take their folder by one function."""
    both, started = tmp_path / "both", tmp_path / "started"
    started.mkdir()
    running = {
        size: subprocess.Popen(
            [sys.executable, "-c", ONE_OF_TWO, indexed_release, both, str(size), started],
            stderr=subprocess.PIPE, text=True,
        )
        for size in (16, 32)
    }  # fmt: skip
    done = {
        size: (each.communicate(timeout=100)[1], each.returncode) for size, each in running.items()
    }
    (winner,) = (size for size, (_, code) in done.items() if code == 0)
    (loser,) = done.keys() - {winner}
    form = {"size": (winner, winner), "encoding": Encoding(preset="ultrafast")}
    export_clips(indexed_release, tmp_path / "alone", layout="diffsynth", **form, workers=1)

    # On a busy machine the loser may begin after the winner has ended.
    refusals = ("another process works on this folder", "of other")
    assert any(refusal in done[loser][0] for refusal in refusals)
    assert files_of(both) == files_of(tmp_path / "alone")


def refusal(folder):
    """Return what a job with the settings 1 is told of a folder."""
    with pytest.raises(StorageError) as refused, job_folder(folder, {"a": 1}):
        pass
    return str(refused.value)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")

    assert "is not empty and holds no export.json: choose a new folder" in refusal(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_settings_that_are_not_json_are_named(tmp_path):
    (tmp_path / "export.json").write_text("{")
    (tmp_path / "right.mp4").write_text("")

    assert "export.json: is not JSON" in refusal(tmp_path)


def test_a_folder_that_a_job_holds_is_refused(tmp_path):
    with job_folder(tmp_path, {"a": 1}):
        assert f"{tmp_path}: another process works on this folder" in refusal(tmp_path)
