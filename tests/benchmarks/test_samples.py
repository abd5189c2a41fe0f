"""Contestants load the same samples, so that races compare nothing but speed."""

import json

import pytest

from benchmarks.ffmpeg_links import link_libraries
from tests.servers.tools import run_python

COMPARED = ("all-pairs-832", "clips")
"""Every contestant and every kind of sample is in these."""

SCALED = "all-pairs-832"
"""Where pictures are scaled, every library has a filter of its own."""
OPTIONAL = {"torchcodec", "decord", "datasets"}


@pytest.fixture(scope="module")
def differences(material):
    """Return how far every contestant's samples are from ours, by workload and name."""
    links = link_libraries(material.root / "ffmpeg")
    code = (
        "import json, sys; from pathlib import Path; from benchmarks.equality import differences; "
        "from benchmarks.material import Material; "
        "material = Material(Path(sys.argv[1]), size_px=64, frames=4); "
        "print(json.dumps(differences(material, only=sys.argv[2:])))"
    )
    libraries = {"LD_LIBRARY_PATH": str(links or ""), "OMP_NUM_THREADS": "1"}
    printed = run_python("-c", code, material.root, *COMPARED, **libraries)
    return {
        (workload, name): found
        for workload, contestants in json.loads(printed).items()
        for name, found in contestants.items()
    }


def test_every_contestant_is_compared(differences):
    failed = {each: found["error"] for each, found in differences.items() if "error" in found}

    assert all(differences[name, "ours"]["samples"] > 0 for name in COMPARED)
    assert {name: why for (_, name), why in failed.items() if name not in OPTIONAL} == {}


def test_pictures_are_equal_to_ours_but_for_the_filter_that_scales_them(differences):
    worst = {each: found.get("worst_grey", 0) for each, found in differences.items()}

    assert {each for each, grey in worst.items() if grey and each[0] != SCALED} == set()
    assert worst[SCALED, "limit"] == 0
    assert max(found.get("grey", 0) for found in differences.values()) < 5


def test_disparities_are_equal_to_ours_within_one_division_in_float32(differences):
    assert max(found.get("ulps", 0) for found in differences.values()) <= 2
