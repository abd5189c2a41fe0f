"""Samples in the conventions of others."""

import numpy as np
import pytest
import torch

from stereogenbench_data import FieldError, StereoPairs, to_raft_stereo, to_torchvision


@pytest.fixture(scope="module")
def sample(small_release):
    return StereoPairs(small_release)[0]


def test_raft_stereo_gets_float_images_and_negative_flow(sample):
    names, left, right, flow, valid = to_raft_stereo(sample)

    assert len(names) == len(set(names)) == 3
    assert left.dtype == right.dtype == flow.dtype == valid.dtype == torch.float32
    assert torch.equal(left, sample["left"].float())
    assert (flow.shape, valid.shape) == ((1, 64, 64), (64, 64))
    assert torch.equal(flow, -sample["disparity"])
    assert flow[sample["valid"]].max() < 0
    assert set(valid.unique().tolist()) <= {0.0, 1.0}


def test_torchvision_gets_positive_numpy_disparity_and_a_plain_mask(sample):
    left, right, disparity, valid = to_torchvision(sample)

    assert torch.equal(left, sample["left"])
    assert torch.equal(right, sample["right"])
    assert isinstance(disparity, np.ndarray)
    assert (disparity.shape, disparity.dtype) == ((1, 64, 64), np.float32)
    assert (valid.shape, valid.dtype) == ((64, 64), bool)
    assert disparity[0][valid].min() > 0


@pytest.mark.parametrize("adapt", [to_raft_stereo, to_torchvision])
def test_a_missing_field_is_named_with_the_cure(small_release, adapt):
    sample = StereoPairs(small_release, fields=("left", "right"))[0]

    with pytest.raises(FieldError, match=r"no disparity, valid.*: ask StereoPairs for fields="):
        adapt(sample)
