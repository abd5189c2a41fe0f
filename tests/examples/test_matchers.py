"""The paper's matchers as plug-ins: each network gets its weights, and pictures as it expects."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from stereogenbench_data.evaluation.models.loading import load_model, range_of

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
DEDODE = f"{EXAMPLES / 'dedode_matcher.py'}:DeDoDe"
FOUNDATION = f"{EXAMPLES / 'foundation_stereo_matcher.py'}:FoundationStereo"


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
def site(monkeypatch, tmp_path):
    """A folder with modules that stand for kornia, FoundationStereo's checkout and omegaconf."""
    (tmp_path / "kornia.py").write_text(KORNIA)
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "foundation_stereo.py").write_text(FOUNDATION_STEREO)
    (tmp_path / "omegaconf.py").write_text(
        "class OmegaConf:\n    @staticmethod\n    def load(path):\n"
        "        name, _, value = path.read_text().partition(': ')\n"
        "        return {name: int(value)}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    names = ("kornia", "core", "core.foundation_stereo", "omegaconf")
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield tmp_path
    for name in names:
        sys.modules.pop(name, None)


def test_dedode_is_given_its_weights_and_the_picture_as_kornia_wants_it(site):
    layer = torch.nn.Linear(1, 1)
    torch.nn.init.constant_(layer.bias, 0.25)
    for name in ("detector_L", "descriptor_B"):
        torch.save(layer.state_dict(), site / f"dedode_{name}.pth")
    picture = np.zeros((3, 6, 8), dtype=np.uint8)
    picture[:, 2, 5] = 255

    matcher = load_model("keypoint matcher", DEDODE, weights=site)
    found = matcher.detect(picture)

    assert matcher.name == "DeDoDe (kornia 0.test)"
    assert len(matcher.settings["detector_sha256"]) == 64
    np.testing.assert_array_equal(found.xy_px, [(5.5, 2.5)])
    np.testing.assert_array_equal(found.descriptors, np.full((1, 4), 0.25 * 2048))


def test_foundation_stereo_is_padded_for_and_its_answer_cut_to_the_picture(site):
    weights = site / "23-51-11"
    weights.mkdir()
    content = {"model": {"scale": torch.tensor([0.5])}, "epoch": 3}
    torch.save(content, weights / "model_best_bp2.pth")
    (weights / "cfg.yaml").write_text("max_disp: 416\n")
    rng = np.random.default_rng(0)
    left, right = (rng.integers(10, 256, (3, 37, 50)).astype(np.uint8) for _ in range(2))
    right[0, 3, 4] = 9

    matcher = load_model("stereo matcher", FOUNDATION, weights=weights)
    disparity = matcher(left, right)

    expected = left[0] * np.float32(0.5)
    expected[3, 4] = np.nan
    np.testing.assert_array_equal(disparity, expected)
    assert matcher.name == "FoundationStereo (23-51-11)"
    assert range_of(matcher) == (0, 416)
