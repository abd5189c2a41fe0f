"""Sizes: (height, width) or WIDTHxHEIGHT, and a warning where the two look exchanged."""

import re

import pytest

from stereogenbench_data import SceneViews, StereoPairs
from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import (
    SwappedSizeWarning,
    require_size,
    warn_if_swapped,
)


@pytest.mark.parametrize("size", [(480, 832), "832X480", " 832x480 "])
def test_a_size_is_height_and_width_or_a_text_of_width_and_height(size):
    assert require_size(size) == (480, 832)


@pytest.mark.parametrize(
    "size",
    [None, (480, 832, 3), (480.5, 832), (0, 832), (480, 16385), "48", "480,832", "0x480", "1e2x4"],
)
def test_what_is_no_size_is_named(size):
    with pytest.raises(FieldError, match=r"WIDTHxHEIGHT of 1 to 16384 pixels") as refused:
        require_size(size)
    assert repr(size) in str(refused.value)


@pytest.mark.parametrize(
    ("size", "stored"),
    [((832, 480), (1280, 1280)), ((832, 480), (1080, 1920)), ((480, 832), (1920, 1080))],
    ids=["square", "wide", "high"],
)
def test_a_size_that_turns_and_stretches_pictures_is_warned_of(size, stored):
    with pytest.warns(SwappedSizeWarning, match=re.escape(f"size {size}")) as warned:
        warn_if_swapped(size, stored=stored)
    said = str(warned[0].message)

    assert f"size=({size[1]}, {size[0]})" in said
    assert f"--size {size[0]}x{size[1]}" in said


@pytest.mark.parametrize(
    ("size", "stored"),
    [
        ((480, 832), (1280, 1280)),
        ((640, 640), (1280, 1280)),
        ((64, 48), (1280, 1280)),
        ((832, 480), (1920, 1080)),
    ],
    ids=["wide of square", "square", "little", "high of high"],
)
def test_a_size_that_is_meant_is_not_warned_of(size, stored):
    warn_if_swapped(size, stored=stored)


@pytest.mark.parametrize("dataset", [StereoPairs, SceneViews])
def test_datasets_take_a_text_and_warn_of_a_size_that_looks_exchanged(small_release, dataset):
    wide = dataset(small_release, size="52x30")
    with pytest.warns(SwappedSizeWarning, match=r"\(52, 30\)"):
        dataset(small_release, size=(52, 30))

    picture = "left" if dataset is StereoPairs else "image"
    assert wide[0][picture].shape[-2:] == (30, 52)
