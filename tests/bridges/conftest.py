"""Shards as other libraries are given them."""

import numpy as np
import pytest
import torch

from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings
from tests.servers.tools import made_once, require_module


@pytest.fixture(scope="session")
def urls(small_shards):
    return sorted(str(path) for path in small_shards.glob("*.tar"))


@pytest.fixture(scope="session")
def packed_depth_shards(small_release, tmp_path_factory):
    """The scenes of `small_release` in shards whose depth blosc2 packed."""
    require_module("blosc2")
    return made_once(
        tmp_path_factory,
        "packed_depth_shards",
        lambda out: pack(small_release, out, workers=1, depth_codec="blosc2"),
    )


@pytest.fixture(scope="session")
def derived_shards(small_release, tmp_path_factory):
    """Two cameras of the scenes of `small_release` in training shards."""
    require_module("blosc2")
    settings = TrainingSettings((32, 48), "small", (0, 3))
    return made_once(
        tmp_path_factory,
        "derived_shards",
        lambda out: pack(small_release, out, training=settings, workers=1),
    )


@pytest.fixture
def equal_samples():
    """Tell whether two flat samples have the same fields, dtypes and values."""

    def equal(one, other):
        assert one.keys() == other.keys()
        for name, value in one.items():
            if isinstance(value, str):
                assert value == other[name], name
                continue
            a, b = (
                each.numpy() if torch.is_tensor(each) else each for each in (value, other[name])
            )
            assert a.dtype == b.dtype, name
            np.testing.assert_array_equal(a, b, err_msg=name)
        return True

    return equal
