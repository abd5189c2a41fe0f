"""Models by name, and what is said of each whose package or weights are not at hand."""

import re
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch

from stereogenbench_data.errors import EvaluationError, ExtraError
from stereogenbench_data.evaluation.models.i3d import I3D
from stereogenbench_data.evaluation.models.inception import INCEPTION
from stereogenbench_data.evaluation.models.registry import MODELS, ModelOptions, load_model
from stereogenbench_data.evaluation.models.weights import read_weights, weights_path


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(EvaluationError, match=r"stereo matcher must be one of sgbm, .* got 'raft'"):
        load_model("stereo matcher", "raft")


def test_a_model_of_ones_own_is_named_by_its_file_and_class(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("class Grey:\n    def __init__(self, *, device):\n        self.name = device\n")

    assert load_model("pair metric", f"{file}:Grey", ModelOptions(device="meta")).name == "meta"
    for name in (f"{file}:Blue", f"{tmp_path}/other.py:Grey", "no_such_module:Grey"):
        with pytest.raises(ExtraError, match=f"pair metric {name}: cannot be imported"):
            load_model("pair metric", name)


@pytest.mark.parametrize("path", [path for models in MODELS.values() for path in models.values()])
def test_every_model_of_the_registry_can_be_imported(path):
    module, _, name = path.partition(":")

    assert getattr(import_module(module), name).__doc__


@pytest.mark.parametrize(
    ("kind", "name", "weights"),
    [
        ("image features", "inception", INCEPTION),
        ("video features", "i3d", I3D),
    ],
)
def test_missing_weights_are_named_with_source_licence_and_place(
    kind, name, weights, tmp_path, monkeypatch
):
    with pytest.raises(ExtraError, match=re.escape(str(tmp_path / weights.file))) as caught:
        load_model(kind, name, ModelOptions(weights=tmp_path))

    assert weights.source in str(caught.value)
    assert f"licence: {weights.licence}" in str(caught.value)
    assert "pip install 'stereogenbench-data[evaluation]'" in str(caught.value)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    with pytest.raises(ExtraError, match=re.escape(str(tmp_path / "torch" / "hub"))):
        weights_path(weights, folder=None)


def test_a_missing_package_is_named_with_its_extra_and_its_weights(monkeypatch, tmp_path):
    monkeypatch.setattr("stereogenbench_data.evaluation.models.lpips.find_spec", lambda _: None)

    with pytest.raises(ExtraError, match=r"pip install 'stereogenbench-data\[lpips\]'") as caught:
        load_model("pair metric", "lpips", ModelOptions(weights=tmp_path))

    assert "https://" in str(caught.value)
    assert "licence: " in str(caught.value)
    assert f"put it at {tmp_path}/" in str(caught.value)


@pytest.mark.parametrize("name", ["sift", "sgbm"])
def test_without_opencv_the_stand_ins_name_the_extra(monkeypatch, name):
    monkeypatch.setitem(sys.modules, "cv2", None)
    kind = "keypoint matcher" if name == "sift" else "stereo matcher"

    with pytest.raises(ExtraError, match=r"pip install 'stereogenbench-data\[evaluation\]'"):
        load_model(kind, name)


def test_a_file_that_holds_more_than_tensors_is_not_run(tmp_path):
    path = tmp_path / "weights.pth"
    torch.save({"run": Path("/")}, path)

    with pytest.raises(EvaluationError, match="cannot be read as tensors only"):
        read_weights(path, what="a network")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short"])
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "weights.pth"
    path.write_bytes(content)

    with pytest.raises(EvaluationError, match=f"{re.escape(str(path))}: .* Fetch the file again"):
        read_weights(path, what="a network")


def test_a_file_of_something_else_is_named(tmp_path):
    torch.save(torch.zeros(3), tmp_path / I3D.file)

    with pytest.raises(EvaluationError, match="are a Tensor, not a table of tensors"):
        load_model("video features", "i3d", ModelOptions(weights=tmp_path))


def test_weights_of_another_network_are_named(tmp_path):
    torch.save({"conv.weight": torch.zeros(3)}, tmp_path / I3D.file)

    with pytest.raises(EvaluationError, match="not the weights of InflatedInception: Missing key"):
        load_model("video features", "i3d", ModelOptions(weights=tmp_path))
