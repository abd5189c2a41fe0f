"""Models by name, and what is said of each whose package or weights are not at hand."""

import re
from importlib import import_module
from pathlib import Path

import pytest
import torch

from stereogenbench_data.errors import EvaluationError, ExtraError
from stereogenbench_data.evaluation.models.i3d import I3D
from stereogenbench_data.evaluation.models.inception import INCEPTION
from stereogenbench_data.evaluation.models.loading import MODELS, load_file, load_model
from stereogenbench_data.evaluation.models.lpips import TRUNK, PerceptualDistance
from tests.evaluation.known_weights import known_state


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(EvaluationError, match=r"stereo matcher must be one of sgbm, .* got 'raft'"):
        load_model("stereo matcher", "raft")


def test_a_model_of_ones_own_is_named_by_its_file_and_class(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("class Grey:\n    def __init__(self, *, device):\n        self.name = device\n")

    assert load_model("stereo matcher", f"{file}:Grey", device="meta").name == "meta"
    for name in (f"{file}:Blue", f"{tmp_path}/other.py:Grey", "no_such_module:Grey"):
        with pytest.raises(ExtraError, match=f"stereo matcher {name}: cannot be imported"):
            load_model("stereo matcher", name)


@pytest.mark.parametrize("path", [path for models in MODELS.values() for path in models.values()])
def test_every_model_of_the_registry_can_be_imported(path):
    module, _, name = path.partition(":")

    assert getattr(import_module(module), name).__doc__


@pytest.mark.parametrize(("name", "weights"), [("lpips", TRUNK), ("fid", INCEPTION), ("fvd", I3D)])
def test_missing_weights_are_named_with_source_licence_place_and_extra(
    name, weights, tmp_path, monkeypatch
):
    with pytest.raises(ExtraError, match=re.escape(str(tmp_path / weights.file))) as caught:
        load_model("learned metric", name, weights=tmp_path)

    assert weights.source in str(caught.value)
    assert f"licence: {weights.licence}" in str(caught.value)
    assert f"pip install 'stereogenbench-data[{weights.extra}]'" in str(caught.value)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    with pytest.raises(ExtraError, match=re.escape(str(tmp_path / "torch" / "hub"))):
        load_model("learned metric", name)


def test_without_the_package_lpips_its_extra_is_named(monkeypatch, tmp_path):
    torch.save(known_state(PerceptualDistance().alexnet), tmp_path / TRUNK.file)
    monkeypatch.setattr("stereogenbench_data.evaluation.models.lpips.find_spec", lambda _: None)

    with pytest.raises(ExtraError, match=r"pip install 'stereogenbench-data\[lpips\]'"):
        load_model("learned metric", "lpips", weights=tmp_path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", {"run": Path("/")}])
def test_a_file_that_is_damaged_or_holds_more_than_tensors_is_named_and_not_run(tmp_path, content):
    path = tmp_path / "weights.pth"
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)

    match = f"{re.escape(str(path))}: .* cannot be read as tensors only.* Fetch the file again"
    with pytest.raises(EvaluationError, match=match):
        load_file(torch.nn.Linear(1, 1), path)


def test_weights_of_another_network_are_named(tmp_path):
    torch.save({"conv.weight": torch.zeros(3)}, tmp_path / I3D.file)

    with pytest.raises(EvaluationError, match="not the weights of this network: Missing key"):
        load_model("learned metric", "fvd", weights=tmp_path)
