"""The sample in the repository: small, sound, made by its README's commands, reproducible."""

import re
import tarfile

import pytest

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.plan import parse_bytes
from stereogenbench_data.shards.verify import verify
from tests.servers.tools import CHECKOUT, planned_by_make

SAMPLE = CHECKOUT / "shards"


@pytest.fixture(scope="module")
def commands():
    text = (SAMPLE / "README.md").read_text()
    return re.findall(r"^stereogenbench (?:synth|pack) .*", text, re.MULTILINE)


def test_the_sample_is_small():
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) <= 12_000_000


def test_every_byte_and_every_frame_of_the_sample_is_sound():
    report = verify(SAMPLE, mode="decode", workers=1)

    assert report.problems == ()
    assert report.videos_decoded == 12 * len(SceneIndex.open(SAMPLE))


def test_the_sample_unpacked_and_packed_again_is_the_same(commands, tmp_path):
    for shard in SAMPLE.glob("*.tar"):
        with tarfile.open(shard) as tar:
            for member in tar:
                key, _, name = member.name.partition(".")
                target = tmp_path / "release" / key / name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(tar.extractfile(member).read())

    again = tmp_path / "again"
    pack(tmp_path / "release", again, target_bytes=parse_bytes(commands[-1].split()[-1]), workers=1)

    assert {path.name: path.read_bytes() for path in again.glob("*.tar")} == {
        path.name: path.read_bytes() for path in SAMPLE.glob("*.tar")
    }
    assert SceneIndex.open(again).digest == SceneIndex.open(SAMPLE).digest
    assert SceneIndex.open(again).shards == SceneIndex.open(SAMPLE).shards


def test_the_readme_has_the_commands_of_make_sample(commands):
    planned = planned_by_make("sample").splitlines()

    run = [line.removeprefix(".venv/bin/") for line in planned]
    assert [line for line in run if re.match("stereogenbench (synth|pack)", line)] == commands
