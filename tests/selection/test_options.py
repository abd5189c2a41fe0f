"""Misspelled options of public calls are answered with all that the call has, nearest first."""

import pytest

from stereogenbench_data import EpochBatches, SceneViews, StereoPairs, StereoPairStream, evaluate
from stereogenbench_data.audit.geometry.audit import audit
from stereogenbench_data.bridges.clips import export_clips
from stereogenbench_data.bridges.export_views import export_views
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.evaluation.controls import score_controls
from stereogenbench_data.evaluation.inputs import export_inputs
from stereogenbench_data.selection.options import nearest_first, options_of, require_options

PAIRS_OPTIONS = {
    "fields", "size", "transform", "depth", "seed", "cache", "check", "buffers",
    "fetch_ahead_bytes",
    "pairs", "direction", "baseline_cm", "balance", "limit", "frames",
    "split", "subset", "family", "map", "character", "animation", "scenes", "focal_mm",
    "valid_depth_ratio", "caption",
}  # fmt: skip


def refusal(call, *arguments, **options):
    """Return the message about an option, and the options that it lists."""
    with pytest.raises(SelectionError, match="has no option") as caught:
        call(*arguments, **options)
    message = str(caught.value)
    return message, message.partition(" It has ")[2].rstrip(".").split(", ")


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("frame", "frames"), ("baselines_cm", "baseline_cm"), ("scene", "scenes"), ("Size", "size"),
     ("famly", "family"), ("focal", "focal_mm")],
)  # fmt: skip
def test_all_options_of_stereo_pairs_are_listed_with_the_nearest_first(small_shards, typed, meant):
    message, listed = refusal(StereoPairs, small_shards, **{typed: "all"})

    assert message.startswith(f"StereoPairs has no option '{typed}'; did you mean '{meant}'?")
    assert listed[0] == meant
    assert set(listed) == PAIRS_OPTIONS


def test_an_option_like_none_is_answered_without_a_guess(small_shards):
    message, listed = refusal(StereoPairs, small_shards, colour="red")

    assert "did you mean" not in message
    assert set(listed) == PAIRS_OPTIONS


@pytest.mark.parametrize("name", ["batch_size", "num_workers", "shuffle"])
def test_an_option_of_the_loader_says_so(small_shards, name):
    message, _ = refusal(StereoPairs, small_shards, **{name: 2})

    assert f"no option '{name}'; it is an option of loader." in message


def test_other_calls_list_their_own_options(small_shards, tmp_path):
    pairs = StereoPairs(small_shards)

    assert refusal(pairs.loader, 2, workers=2)[1][0] == "num_workers"
    assert refusal(SceneViews, small_shards, camera="each")[1][0] == "cameras"
    assert refusal(StereoPairStream, small_shards, 2, shard_groups=2)[1][0] == "shuffle_groups"
    assert refusal(EpochBatches, pairs, 2, droplast=True)[1][0] == "drop_last"
    assert refusal(evaluate, small_shards, tmp_path, tier="G1", worker=2)[1][0] == "workers"
    assert refusal(score_controls, small_shards, protokol=2)[1][0] == "protocol"
    assert refusal(export_inputs, small_shards, tmp_path, tier="G1", frame=2)[1][0] == "frames"
    assert refusal(export_views, small_shards, tmp_path, layout="ply", point=2)[1][0] == "points"
    assert refusal(export_clips, small_shards, tmp_path, layout="musubi", pair=2)[1][0] == "pairs"
    assert refusal(audit, small_shards, journals=2)[1][0] == "journal"


def test_options_are_keyword_only_optional_and_unpacked_parameters():
    def call(data, fields=(), *, size=None, **options):
        """Take some options."""

    assert options_of(call) == ["fields", "size"]
    assert {"pairs", "size", "batch_size"} - set(options_of(StereoPairs)) == {"batch_size"}
    require_options(StereoPairs, PAIRS_OPTIONS)


def test_a_name_that_holds_the_typed_one_whole_is_near():
    assert nearest_first("worker", ["order", "num_workers"]) == ["num_workers", "order"]
