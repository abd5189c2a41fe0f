"""``stereogenbench doctor`` as a user runs it."""

import json

import pytest
from PIL import Image
from typer.testing import CliRunner

from stereogenbench_data.cli.commands import app
from stereogenbench_data.cli.doctor import encoding_line
from stereogenbench_data.schema.records import DepthEncoding


def run(*arguments):
    few = ("--frames", "1", "--scenes", "1")
    return CliRunner().invoke(app, ["doctor", *map(str, arguments), *few])


def test_a_right_tree_ends_with_0_and_the_contract_to_paste(detailed_release, tmp_path):
    picture = tmp_path / "doctor.png"

    result = run(detailed_release, "-o", picture)

    assert result.exit_code == 0, result.output
    assert "The declared contract fits" in result.stdout
    assert "are not comparable with dB" in result.stdout
    assert "DepthEncoding(unit_m=0.001)" in result.stdout
    with Image.open(picture) as image:
        assert min(image.size) > 800


def test_a_wrong_unit_ends_with_1_and_json_alone_on_stdout(detailed_release):
    result = run(detailed_release, "--json", "--unit-m", "0.1")

    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert document["is_wrong"]
    assert document["verdicts"][0]["paste"] == "DepthEncoding(unit_m=0.001)"
    assert document["verdicts"][0]["unit_m"] == pytest.approx(0.001, rel=0.005)


def test_a_picture_of_no_known_kind_is_refused_before_anything_is_read(tmp_path):
    result = run(tmp_path / "nowhere", "-o", tmp_path / "doctor.txt")

    assert result.exit_code == 2
    assert "name a picture" in result.stderr


def test_a_filter_that_leaves_nothing_ends_with_2(detailed_release):
    result = run(detailed_release, "--family", "Uniform")

    assert result.exit_code == 2
    assert "family" in result.stderr


@pytest.mark.parametrize(
    ("encoding", "line"),
    [
        (DepthEncoding(unit_m=0.01), "DepthEncoding(unit_m=0.01)"),
        (
            DepthEncoding(unit_m=0.1, kind="ray", frame_lag=-1),
            "DepthEncoding(unit_m=0.1, kind='ray', frame_lag=-1)",
        ),
    ],
)
def test_the_line_to_paste_is_the_contract(encoding, line):
    assert encoding_line(encoding) == line
    assert eval(line, {"DepthEncoding": DepthEncoding}) == encoding
