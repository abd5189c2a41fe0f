"""Options declared once, and errors that name the option."""

import shutil
import subprocess

import imageio_ffmpeg
import pytest

from stereogenbench_data.cli.options import DataOptions, SceneOptions, filter_of
from stereogenbench_data.samples.fields import SwappedSizeWarning
from tests.cli.command import CALLS, refused, succeed


@pytest.mark.parametrize(
    ("words", "option", "value", "cure"),
    [
        (["eval", "score", "d", "p", "--tier", "G1"], "--size", "480,832", "WIDTHxHEIGHT"),
        (["eval", "score", "d", "p", "--tier", "G1"], "--size", "832x0", "1 to 16384"),
        (["eval", "controls", "d"], "--pairs", "0:1", "0-1,0-5"),
        (["eval", "controls", "d"], "--frames", "some", "every:K"),
        (["audit", "d"], "--per-scene", "0", "'all'"),
        (["audit", "d"], "--where", "wide", "NAME=VALUE"),
        (["stats", "d"], "--where", "focal_mm=wide", "18:35"),
        (["index", "d", "-o", "i"], "--where", "caption=red", "family or map"),
        (["stats", "d"], "--where", "min_frames=x", "whole number"),
        (["show", "d"], "--pair", "left", "0-5"),
        (["show", "d"], "--pair", "5-0", "write it as 0-5"),
        (["eval", "controls", "d"], "--pairs", "5-2", "write it as 2-5"),
        (["download", "d", "-o", "o"], "--cameras", "6", "0 to 5"),
        (["pack", "d", "o"], "--part", "first", "I/N"),
        (["synth", "o"], "--part", "3/2", "I/N"),
    ],
)
def test_a_refused_option_is_named_with_its_value_and_what_it_may_be(words, option, value, cure):
    message = refused(*words, option, value)

    assert all(word in message for word in (option, value.partition("=")[0], cure)), message


def test_filters_are_named_and_texts_are_gathered():
    where = ["scene=1", "family=A", "family=B", "focal_mm=18:35", "min_frames=60", "caption=a red"]

    assert SceneOptions(split="eval", where=[*map(filter_of, where)]).filters() == {
        "split": "eval", "scenes": ["1"], "family": ["A", "B"], "focal_mm": (18.0, 35.0),
        "min_frames": 60, "caption": "a red",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "values"),
    [
        (["focal_mm=18:35", "focal_mm=35:50"], "focal_mm is given more than once (18:35, 35:50)"),
        (["baseline_cm=6", "family=A", "baseline_cm=9"], "baseline_cm is given more than once (6:"),
        (["min_frames=9", "min_frames=9"], "min_frames is given more than once (9, 9)"),
        (["caption=red", "caption=blue"], "caption is given more than once (red, blue)"),
        (["split=eval"], "split is given more than once (train, eval)"),
    ],
)
def test_a_filter_of_one_value_that_is_given_two_is_refused_with_both(words, values):
    where = [word for each in words for word in ("--where", each)]

    message = refused("eval", "controls", "d", "--split", "train", *where)
    assert SceneOptions(where=[filter_of("split=train")]).filters() == {"split": ["train"]}

    assert f"--where: {values}" in message
    assert "give it one value." in message


def test_every_command_takes_one_number_for_width_and_height(tmp_path):
    words = ("synth", tmp_path, "--frames", 1, "--workers", 1, "--size")
    sizes = {
        path: option
        for path, call in CALLS.items()
        for option in call.params
        if "--size" in option.opts
    }

    succeed(*words, "64")
    assert "WIDTHxHEIGHT" in refused(*words, "64x")
    assert ("pack",) in sizes
    for path, size in sizes.items():
        context = CALLS[path].make_context(path[-1], [], resilient_parsing=True)
        assert size.process_value(context, "96") == (96, 96), path
        assert size.process_value(context, "96x48") == (48, 96), path


def test_a_size_that_looks_swapped_gives_a_warning_that_names_the_option(small_shards, tmp_path):
    words = ["eval", "inputs", small_shards, tmp_path / "in", "--tier", "G2", "--frames", "first"]
    with pytest.warns(SwappedSizeWarning, match="--size 52x30"):
        succeed(*words, "--size", "30x52", "--workers", "1")


def test_losses_of_depth_are_accepted_beside_what_conventions_state(tmp_path):
    stated = tmp_path / "c.toml"
    stated.write_text('[depth]\nunit_m = 0.01\naccept = ["lossy"]\n')

    (alone,) = DataOptions(data="x", accept=["10-bit"]).stated().shapes
    (both,) = DataOptions(data="x", conventions=stated, accept=["10-bit"]).stated().shapes

    assert (alone.depth.encoding.accept, alone.depth.encoding.unit_m) == ({"10-bit"}, None)
    assert (both.depth.encoding.accept, both.depth.encoding.unit_m) == ({"10-bit", "lossy"}, 0.01)
    assert DataOptions(data="x").stated() is None


def test_commands_read_depth_of_few_bits_where_the_loss_is_accepted(small_release, tmp_path):
    root, out = tmp_path / "release", tmp_path / "sheet.png"
    shutil.copytree(small_release / "eval", root / "eval")
    for path in root.rglob("*_depth.mkv"):
        encode = (imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", path)
        narrow = path.with_suffix(".new.mkv")
        subprocess.run([*encode, "-vf", "format=gray10le", "-c:v", "ffv1", narrow], check=True)
        narrow.replace(path)

    assert "--accept" in refused("show", root, "-o", out)
    succeed("show", root, "-o", out, "--accept", "10-bit")

    assert out.exists()
