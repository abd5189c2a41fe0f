"""Misspelled options of public calls are answered with the nearest one, and all in their order."""

import pytest

from stereogenbench_data import EpochBatches, SceneViews, StereoPairs, StereoPairStream, evaluate
from stereogenbench_data.audit.geometry.audit import audit
from stereogenbench_data.bridges.clips import export_clips
from stereogenbench_data.bridges.export_views import export_views
from stereogenbench_data.errors import SelectionError, SynthesisError
from stereogenbench_data.evaluation.controls import score_controls
from stereogenbench_data.evaluation.inputs import export_inputs
from stereogenbench_data.synthesis.request import SynthRequest


def refusal(call, *arguments, **options):
    """Return the option that a message takes for the one that was meant, and those it lists."""
    with pytest.raises(SelectionError, match="has no option") as caught:
        call(*arguments, **options)
    message, _, listed = str(caught.value).partition(" It has ")
    meant = message.partition("did you mean '")[2].removesuffix("'?")
    return meant, listed.rstrip(".").split(", ")


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("frame", "frames"), ("baselines_cm", "baseline_cm"), ("Size", "size"), ("colour", "")],
)
def test_a_misspelled_option_is_answered_with_the_nearest_one_and_all(small_shards, typed, meant):
    guess, listed = refusal(StereoPairs, small_shards, **{typed: "all"})

    assert guess == meant
    assert {"fields", "size", "split", "pairs", "frames"} <= set(listed)


def test_an_option_of_the_loader_says_so(small_shards):
    expected = "StereoPairs has no option 'num_workers'; it is an option of loader."
    with pytest.raises(SelectionError, match=expected):
        StereoPairs(small_shards, num_workers=2)


def test_other_calls_list_their_own_options(small_shards, tmp_path):
    pairs = StereoPairs(small_shards)

    assert refusal(pairs.loader, 2, workers=2)[0] == "num_workers"
    assert refusal(SceneViews, small_shards, camera="each")[0] == "cameras"
    assert refusal(StereoPairStream, small_shards, 2, shard_groups=2)[0] == "shuffle_groups"
    assert refusal(EpochBatches, pairs, 2, droplast=True)[0] == "drop_last"
    assert refusal(evaluate, small_shards, tmp_path, tier="G1", worker=2)[0] == "workers"
    assert refusal(score_controls, small_shards, protokol=2)[0] == "protocol"
    assert refusal(export_inputs, small_shards, tmp_path, tier="G1", frame=2)[0] == "frames"
    assert refusal(export_views, small_shards, tmp_path, layout="ply", point=2)[0] == "points"
    assert refusal(export_clips, small_shards, tmp_path, layout="musubi", pair=2)[0] == "pairs"
    assert refusal(audit, small_shards, frame=2)[0] == "frames"


def test_a_misspelled_family_of_drawn_scenes_is_answered_with_the_nearest_one():
    with pytest.raises(SynthesisError, match="got 'Unifrom'; did you mean 'Uniform'"):
        SynthRequest(family="Unifrom")
