"""Models by name, and what is said of each whose package or weights are not at hand."""

import re
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from stereogenbench_data.errors import EvaluationError, ExtraError
from stereogenbench_data.evaluation.models.dedode import DESCRIPTOR, DETECTOR
from stereogenbench_data.evaluation.models.i3d import I3D
from stereogenbench_data.evaluation.models.inception import INCEPTION
from stereogenbench_data.evaluation.models.registry import MODELS, ModelOptions, load_model
from stereogenbench_data.evaluation.models.weights import read_weights, weights_path


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("keypoint matcher", "sift"),
        ("stereo matcher", "sgbm"),
    ],
)
def test_what_needs_no_weights_is_loaded_by_name_and_names_its_choices(kind, name):
    system = load_model(kind, name)

    assert system.name
    assert system.settings


@pytest.mark.parametrize("kind", MODELS)
def test_an_unknown_name_is_answered_with_the_known_ones(kind):
    known = ", ".join(MODELS[kind])

    with pytest.raises(
        EvaluationError, match=re.escape(f"{kind} must be one of {known}, got 'raft'")
    ):
        load_model(kind, "raft")


@pytest.mark.parametrize("path", [path for models in MODELS.values() for path in models.values()])
def test_every_model_of_the_registry_can_be_imported(path):
    module, _, name = path.partition(":")

    assert getattr(import_module(f"stereogenbench_data.evaluation.models.{module}"), name).__doc__


@pytest.mark.parametrize(
    ("kind", "name", "weights"),
    [
        ("image features", "inception", INCEPTION),
        ("video features", "i3d", I3D),
    ],
)
def test_missing_weights_are_named_with_source_licence_and_place(kind, name, weights, tmp_path):
    with pytest.raises(ExtraError, match=re.escape(str(tmp_path / weights.file))) as caught:
        load_model(kind, name, ModelOptions(weights=tmp_path))

    assert weights.source in str(caught.value)
    assert f"licence: {weights.licence}" in str(caught.value)
    assert "pip install 'stereogenbench-data[evaluation]'" in str(caught.value)


def test_weights_are_looked_for_where_torch_hub_keeps_them(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))

    with pytest.raises(ExtraError, match=re.escape(str(tmp_path / "hub" / "checkpoints"))):
        weights_path(INCEPTION, folder=None)


@pytest.mark.parametrize(
    ("kind", "name", "package"),
    [("keypoint matcher", "dedode", "kornia"), ("pair metric", "lpips", "lpips")],
)
def test_a_missing_package_is_named_with_its_extra_and_its_weights(
    monkeypatch, tmp_path, kind, name, package
):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr("stereogenbench_data.evaluation.models.lpips.find_spec", lambda _: None)

    with pytest.raises(ExtraError, match=rf"pip install 'stereogenbench-data\[{name}\]'") as caught:
        load_model(kind, name, ModelOptions(weights=tmp_path))

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


@pytest.mark.parametrize("content", [b"", b"not a file of weights", b"PK\x03\x04 cut short"])
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


KORNIA = '''
import torch
from types import SimpleNamespace


class DeDoDe(torch.nn.Module):
    """Keypoints where its one pixel is brightest; descriptors are as the second network says."""

    def __init__(self, detector_model, descriptor_model, amp_dtype):
        super().__init__()
        assert (detector_model, descriptor_model, amp_dtype) == ("L", "B", torch.float32)
        self.detector, self.descriptor = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)

    def forward(self, images, n):
        assert images.dtype == torch.float32 and images.min() == 0 and images.max() == 1
        row, column = divmod(int(images[0, 0].argmax()), images.shape[-1])
        xy = torch.tensor([[[column + 0.5, row + 0.5]]])
        return xy, torch.ones(1, 1), torch.full((1, 1, 4), float(self.descriptor.bias) * n)


feature = SimpleNamespace(DeDoDe=DeDoDe)
__version__ = "0.test"
'''


@pytest.fixture
def kornia(monkeypatch, tmp_path):
    """A folder with a module that stands for kornia, which can be imported from there."""
    (tmp_path / "kornia.py").write_text(KORNIA)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "kornia", raising=False)
    yield tmp_path
    sys.modules.pop("kornia", None)


def test_dedode_is_given_its_weights_and_the_picture_as_kornia_wants_it(kornia):
    layer = torch.nn.Linear(1, 1)
    torch.nn.init.constant_(layer.bias, 0.25)
    for weights in (DETECTOR, DESCRIPTOR):
        torch.save(layer.state_dict(), kornia / weights.file)
    picture = np.zeros((3, 6, 8), dtype=np.uint8)
    picture[:, 2, 5] = 255

    matcher = load_model("keypoint matcher", "dedode", ModelOptions(weights=kornia))
    found = matcher.detect(picture)

    assert matcher.name == "DeDoDe (kornia 0.test)"
    assert matcher.settings["detector"] == "L-upright"
    np.testing.assert_array_equal(found.xy_px, [(5.5, 2.5)])
    np.testing.assert_array_equal(found.descriptors, np.full((1, 4), 0.25 * 2048))


def test_dedode_without_its_second_file_says_which(kornia):
    torch.save(torch.nn.Linear(1, 1).state_dict(), kornia / DETECTOR.file)

    with pytest.raises(ExtraError, match=r"descriptor B-upright are not at .*_descriptor_B.pth"):
        load_model("keypoint matcher", "dedode", ModelOptions(weights=kornia))


FOUNDATION_STEREO = '''
import torch


class FoundationStereo(torch.nn.Module):
    """Its disparity is the red of the left picture, and not finite where the right one is 9."""

    def __init__(self, args):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.zeros(1))
        assert args["vit_size"] == "vitl"

    def forward(self, image1, image2, iters, test_mode):
        assert (iters, test_mode) == (32, True)
        assert image1.dtype == torch.float32 and image1.shape == image2.shape
        assert image1.shape[-1] % 32 == image1.shape[-2] % 32 == 0
        answer = image1[:, :1] * self.scale
        return torch.where(image2[:, :1] == 9, torch.inf, answer)
'''


@pytest.fixture
def checkout(monkeypatch, tmp_path):
    """A folder like a checkout of FoundationStereo with weights, and omegaconf to read it."""
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "__init__.py").touch()
    (tmp_path / "core" / "foundation_stereo.py").write_text(FOUNDATION_STEREO)
    (tmp_path / "omegaconf.py").write_text(
        "class OmegaConf:\n    @staticmethod\n    def load(path):\n"
        "        return {'configuration': path.read_text()}\n"
    )
    folder = tmp_path / "pretrained_models" / "23-51-11"
    folder.mkdir(parents=True)
    torch.save({"model": {"scale": torch.tensor([0.5])}, "epoch": 3}, folder / "model_best_bp2.pth")
    (folder / "cfg.yaml").write_text("max_disp: 416\n")
    names = ("core", "core.foundation_stereo", "omegaconf")
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield tmp_path
    for name in names:
        sys.modules.pop(name, None)


def test_foundation_stereo_is_padded_for_and_its_answer_cut_to_the_picture(checkout):
    path_before = list(sys.path)
    rng = np.random.default_rng(0)
    left, right = (rng.integers(10, 256, (3, 37, 50)).astype(np.uint8) for _ in range(2))
    right[0, 3, 4] = 9

    matcher = load_model("stereo matcher", "foundation-stereo", ModelOptions(checkout=checkout))
    disparity = matcher(left, right)

    expected = left[0] * np.float32(0.5)
    expected[3, 4] = np.nan
    np.testing.assert_array_equal(disparity, expected)
    assert matcher.name == "FoundationStereo (23-51-11)"
    assert matcher.settings["iterations"] == 32
    assert sys.path == path_before


@pytest.mark.parametrize(
    ("place", "lacking"),
    [
        (None, "has no checkout"),
        (Path("/nowhere/FoundationStereo"), "is not at /nowhere/FoundationStereo"),
    ],
)
def test_without_a_checkout_the_repository_weights_and_licence_are_named(place, lacking):
    with pytest.raises(ExtraError, match=f"FoundationStereo {lacking}: clone") as caught:
        load_model("stereo matcher", "foundation-stereo", ModelOptions(checkout=place))

    for told in ("github.com/NVlabs/FoundationStereo", "drive.google.com", "non-commercial"):
        assert told in str(caught.value)


def test_a_checkout_without_weights_configuration_or_requirements_is_reported_what_is_missing(
    checkout, monkeypatch
):
    folder = checkout / "pretrained_models" / "23-51-11"
    (folder / "cfg.yaml").unlink()
    with pytest.raises(ExtraError, match=r"cfg\.yaml is missing: it comes with the weights"):
        load_model("stereo matcher", "foundation-stereo", ModelOptions(checkout=checkout))

    monkeypatch.setitem(sys.modules, "omegaconf", None)
    with pytest.raises(ExtraError, match=r"needs more than is installed .*omegaconf"):
        load_model("stereo matcher", "foundation-stereo", ModelOptions(checkout=checkout))

    (folder / "model_best_bp2.pth").unlink()
    with pytest.raises(ExtraError, match=r"are not at .*model_best_bp2\.pth"):
        load_model("stereo matcher", "foundation-stereo", ModelOptions(checkout=checkout))


def test_another_module_of_the_same_name_is_not_taken_for_foundation_stereo(checkout, tmp_path):
    load_model("stereo matcher", "foundation-stereo", ModelOptions(checkout=checkout))
    other = tmp_path / "other"
    (other / "core").mkdir(parents=True)
    (other / "core" / "foundation_stereo.py").write_text(FOUNDATION_STEREO)

    weights = checkout / "pretrained_models" / "23-51-11"
    with pytest.raises(EvaluationError, match="another module named core is loaded"):
        load_model(
            "stereo matcher", "foundation-stereo", ModelOptions(checkout=other, weights=weights)
        )
