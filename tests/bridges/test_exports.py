"""Two exports that begin at once into one folder: one of them writes, the other is refused."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXPORTS = {
    "clips": """
from stereogenbench_data.bridges.clips import ClipForm, ExportRun, export_clips
from stereogenbench_data.media.encoder import Encoding
form = ClipForm(size=(size, size), encoding=Encoding(preset="ultrafast"))
export_clips(data, out, layout="diffsynth", form=form, run=ExportRun(workers=1))
""",
    "views": """
from stereogenbench_data.bridges.export_views import export_views
export_views(data, out, layout="ply", size=(size, size), frames="all", workers=1)
""",
}
AT_ONCE = """
import sys, time, warnings
from pathlib import Path
warnings.simplefilter("ignore")
data, out, size, started = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
import stereogenbench_data.bridges.clips, stereogenbench_data.bridges.export_views
(started / str(size)).touch()
while len([*started.iterdir()]) < 2:
    time.sleep(0.001)
"""


def files_of(root):
    return {
        str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


@pytest.mark.parametrize("kind", EXPORTS)
def test_of_two_exports_at_once_one_is_whole_and_the_other_refused(indexed_release, tmp_path, kind):
    def run(out, sizes):
        started = tmp_path / f"started_{out}"
        started.mkdir()
        if len(sizes) == 1:
            (started / "alone").touch()
        code = AT_ONCE + EXPORTS[kind]
        words = [sys.executable, "-c", code, str(indexed_release), str(tmp_path / out)]
        running = [
            subprocess.Popen(
                [*words, str(size), str(started)], stderr=subprocess.PIPE, text=True,
                cwd=Path(__file__).resolve().parents[2],
            )
            for size in sizes
        ]  # fmt: skip
        return {
            size: (each.communicate(timeout=100)[1], each.returncode)
            for size, each in zip(sizes, running, strict=True)
        }

    done = run("both", [16, 32])

    (winner,) = (size for size, (_, code) in done.items() if code == 0)
    (loser,) = done.keys() - {winner}
    assert "StorageError" in done[loser][0]
    assert run("expected", [winner])[winner][1] == 0
    assert files_of(tmp_path / "both") == files_of(tmp_path / "expected")
    assert json.loads((tmp_path / "both" / "export.json").read_text())
