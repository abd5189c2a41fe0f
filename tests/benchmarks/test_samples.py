"""Contestants load the same samples, so that races compare nothing but speed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.ffmpeg_links import link_libraries

CHECKOUT = Path(__file__).resolve().parents[2]

COMPARED = ("all-pairs-832", "clips")
"""Every contestant and every kind of sample is in these."""

SCALED = "all-pairs-832"
"""Where pictures are scaled, every library has a filter of its own."""


@pytest.fixture(scope="module")
def differences(material):
    """Return how far every contestant's samples are from ours, by workload."""
    links = link_libraries(material.root / "ffmpeg")
    code = (
        "import json, sys; from pathlib import Path; from benchmarks.equality import differences; "
        "from benchmarks.material import Material; "
        "material = Material(Path(sys.argv[1]), size_px=64, frames=4); "
        "print(json.dumps(differences(material, only=sys.argv[2:])))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(material.root), *COMPARED],
        cwd=CHECKOUT,
        env=os.environ | {"LD_LIBRARY_PATH": str(links or ""), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def test_every_contestant_is_compared(differences):
    ours = [name for name, found in differences.items() if found["ours"]["samples"] > 0]
    optional = {"torchcodec", "decord", "datasets"}
    failed = {
        (workload, name): found["error"]
        for workload, contestants in differences.items()
        for name, found in contestants.items()
        if "error" in found and name not in optional
    }

    assert ours == list(COMPARED)
    assert failed == {}


def test_pictures_are_equal_to_ours_bit_for_bit_where_they_are_not_scaled(differences):
    others = {
        (workload, name): found["worst_grey"]
        for workload, contestants in differences.items()
        for name, found in contestants.items()
        if workload != SCALED and found.get("worst_grey", 0) > 0
    }

    assert others == {}


def test_scaled_pictures_are_equal_to_ours_but_for_the_filter(differences):
    assert differences[SCALED]["limit"]["worst_grey"] == 0
    assert max(found.get("grey", 0) for found in differences[SCALED].values()) < 5


def test_disparities_are_equal_to_ours_within_one_division_in_float32(differences):
    far = {
        (workload, name): found["ulps"]
        for workload, contestants in differences.items()
        for name, found in contestants.items()
        if found.get("ulps", 0) > 2
    }

    assert far == {}
