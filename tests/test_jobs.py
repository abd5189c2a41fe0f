"""Two jobs that begin at once in one folder: one of them works, the other is refused."""

import subprocess
import sys
from pathlib import Path

import pytest

JOBS = {
    "clips": """
from stereogenbench_data.bridges.clips import export_clips
from stereogenbench_data.media.encoder import Encoding
form = dict(size=(size, size), encoding=Encoding(preset="ultrafast"))
export_clips(data, out, layout="diffsynth", **form, workers=1)
""",
    "inputs": """
from stereogenbench_data.evaluation.inputs import export_inputs
export_inputs(data, out, tier="G0", size=(size, size), workers=1)
""",
    "scores": """
from stereogenbench_data.evaluation.evaluate import evaluate
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
protocol = EvaluationProtocol(metrics=("psnr",), size=(size, size))
evaluate(data, lambda given: given["left"], tier="G2", protocol=protocol, out=out)
""",
}
AT_ONCE = """
import sys, time, warnings
from pathlib import Path
warnings.simplefilter("ignore")
data, out, name, started = sys.argv[1], sys.argv[2], sys.argv[3], Path(sys.argv[4])
size = int(name)
import stereogenbench_data.bridges.clips, stereogenbench_data.evaluation.inputs
(started / name).touch()
while len([*started.iterdir()]) < 2:
    time.sleep(0.001)
"""


def files_of(root):
    return {
        str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


@pytest.mark.parametrize(
    ("kind", "names"),
    [("clips", ("16", "32")), ("inputs", ("16", "32")), ("scores", ("16", "32"))],
)
def test_of_two_jobs_at_once_one_is_whole_and_the_other_refused(
    indexed_release, tmp_path, kind, names
):
    def run(out, names):
        started = tmp_path / f"started_{out}"
        started.mkdir()
        if len(names) == 1:
            (started / "alone").touch()
        words = [sys.executable, "-c", AT_ONCE + JOBS[kind], str(indexed_release)]
        running = [
            subprocess.Popen(
                [*words, str(tmp_path / out), name, str(started)], stderr=subprocess.PIPE,
                text=True, cwd=Path(__file__).resolve().parents[1],
            )
            for name in names
        ]  # fmt: skip
        return {
            name: (each.communicate(timeout=100)[1], each.returncode)
            for name, each in zip(names, running, strict=True)
        }

    done = run("both", names)

    (winner,) = (name for name, (_, code) in done.items() if code == 0)
    (loser,) = done.keys() - {winner}
    # On a busy machine the loser may begin after the winner has ended.
    refusals = ("another process works on this folder", "of other")
    assert any(refusal in done[loser][0] for refusal in refusals)
    assert run("expected", [winner])[winner][1] == 0
    assert files_of(tmp_path / "both") == files_of(tmp_path / "expected")
