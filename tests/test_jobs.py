"""A folder belongs to one job: others are refused, also such as begin at the same moment."""

import multiprocessing

import pytest

from stereogenbench_data.bridges.clips import export_clips
from stereogenbench_data.errors import StorageError
from stereogenbench_data.jobs import job_folder
from stereogenbench_data.media.encoder import Encoding
from tests.servers.tools import files_of


def test_of_two_jobs_at_once_one_is_whole_and_the_other_refused(indexed_release, tmp_path):
    """Clips stand for all jobs: they take their folder by one function."""
    forks = multiprocessing.get_context("fork")
    told, ready = forks.Queue(), forks.Barrier(2)

    def export(size, out):
        form = {"size": (size, size), "encoding": Encoding(preset="ultrafast")}
        export_clips(indexed_release, out, layout="diffsynth", **form, workers=1)

    def one_of_two(size):
        ready.wait(60)
        try:
            export(size, tmp_path / "both")
        except StorageError as error:
            told.put((size, str(error)))
        else:
            told.put((size, ""))

    running = [forks.Process(target=one_of_two, args=(size,)) for size in (16, 32)]
    for process in running:
        process.start()
    done = dict(told.get(timeout=100) for _ in running)
    for process in running:
        process.join(60)
    (winner,) = (size for size, refusal in done.items() if not refusal)
    (loser,) = done.keys() - {winner}
    export(winner, tmp_path / "alone")

    # On a busy machine the loser may begin after the winner has ended.
    refusals = ("another process works on this folder", "of other")
    assert any(refusal in done[loser] for refusal in refusals)
    assert files_of(tmp_path / "both") == files_of(tmp_path / "alone")


def test_a_folder_of_something_else_or_with_broken_settings_is_refused(tmp_path):
    def refusal(folder):
        with pytest.raises(StorageError) as refused, job_folder(folder, {"a": 1}):
            pass
        return str(refused.value)

    (tmp_path / "thesis.tex").write_text("mine")

    assert "is not empty and holds no export.json: choose a new folder" in refusal(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    (tmp_path / "export.json").write_text("{")
    assert "export.json: is not JSON" in refusal(tmp_path)
    with job_folder(tmp_path / "new", {"a": 1}):
        assert "new: another process works on this folder" in refusal(tmp_path / "new")
