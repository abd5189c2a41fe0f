"""Inception, I3D and LPIPS: the graphs, against numbers that the reference implementations gave.

The numbers were computed on the weights of `known_weights` by torch-fidelity 0.4.0, by the I3D of
cd-fvd 0.1.1 and by lpips 0.1.4.
"""

import hashlib

import numpy as np
import pytest
import torch

from stereogenbench_data.evaluation.models.i3d import I3D, I3dFeatures, InflatedInception
from stereogenbench_data.evaluation.models.inception import INCEPTION, Inception, InceptionFeatures
from stereogenbench_data.evaluation.models.lpips import TRUNK, Lpips, PerceptualDistance
from tests.evaluation.known_weights import known_pictures, known_state


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small tensors on many threads, beside other work, mostly wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def inception(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inception")
    torch.save(known_state(Inception()), folder / INCEPTION.file)
    return InceptionFeatures(weights=folder)


@pytest.fixture(scope="module")
def i3d_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("i3d")
    torch.save(known_state(InflatedInception()), folder / I3D.file)
    return folder


@pytest.fixture(scope="module")
def i3d(i3d_folder):
    return I3dFeatures(weights=i3d_folder)


@pytest.fixture(scope="module")
def lpips(tmp_path_factory):
    """LPIPS from a folder for AlexNet and a package of which only the file of numbers is read."""
    root = tmp_path_factory.mktemp("lpips")
    network = PerceptualDistance()
    classifier = {"classifier.1.bias": torch.zeros(3)}
    torch.save(known_state(network.alexnet) | classifier, root / TRUNK.file)
    heads = root / "site" / "lpips" / "weights" / "v0.1" / "alex.pth"
    heads.parent.mkdir(parents=True)
    torch.save(known_state(network.heads), heads)
    (root / "site" / "lpips" / "__init__.py").write_text("raise ImportError('not to be imported')")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(root / "site")
        yield Lpips(weights=root)


def test_inception_gives_the_features_of_torch_fidelity(inception):
    (features,) = inception(known_pictures(1, 3, 75, 100))

    np.testing.assert_allclose(features[:3], [0.00090866, 0.08233872, 0.09960809], atol=1e-6)
    assert (features[1000], features.shape) == (0, (2048,))
    assert features.mean() == pytest.approx(0.041293114, abs=1e-6)
    assert features.std() == pytest.approx(0.04818372, abs=1e-6)


def test_i3d_gives_the_logits_of_cd_fvd(i3d):
    (logits,) = i3d(known_pictures(1, 10, 3, 30, 40))

    np.testing.assert_allclose(logits[:3], [-0.13402113, -0.002867815, 0.104698], atol=1e-5)
    assert logits[200] == pytest.approx(-0.042459637, abs=1e-5)
    assert logits.mean() == pytest.approx(-0.0014948067, abs=1e-5)
    assert logits.std() == pytest.approx(0.09388374, abs=1e-5)


def test_lpips_gives_the_distances_of_lpips(lpips):
    pictures = known_pictures(2, 3, 64, 80)

    distances = lpips(pictures, 255 - pictures[::-1])

    np.testing.assert_allclose(distances, [-0.035962682, -0.037127346], atol=1e-6)
    np.testing.assert_array_equal(lpips(pictures, pictures), 0)


def test_features_of_a_picture_do_not_depend_on_its_batch(lpips):
    pictures = known_pictures(11, 3, 64, 80)
    targets = known_pictures(12, 3, 64, 80)[1:]

    together = lpips(pictures, targets)

    places = (0, 7, 8, 10)
    alone = [lpips(pictures[n : n + 1], targets[n : n + 1])[0] for n in places]
    np.testing.assert_allclose(together[list(places)], alone, rtol=1e-5, atol=1e-7)


def test_the_settings_tell_which_network_and_weights_were_used(i3d, i3d_folder, lpips):
    content = (i3d_folder / I3D.file).read_bytes()

    assert lpips.settings["network"] == "AlexNet"
    assert i3d.settings["weights_sha256"] == hashlib.sha256(content).hexdigest()
