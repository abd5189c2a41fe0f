"""Windows on frames, as arithmetic."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.selection.plan import Clips, key_distance, parse_frames

DRAW = (3, 0, 12)


def windows(spec, frames=81, draw=DRAW):
    rule = parse_frames(spec)
    return [rule.window(n, frames=frames, draw=draw) for n in range(rule.count(frames))]


@pytest.mark.parametrize(
    ("spec", "frames", "expected"),
    [
        ("first", 81, [(0,)]),
        ("all", 3, [(0,), (1,), (2,)]),
        (5, 81, [(5,)]),
        ([4, 1], 81, [(1,), (4,)]),
        (range(2), 81, [(0,), (1,)]),
        (("every", 40), 81, [(0,), (40,), (80,)]),
        (("every", 100), 81, [(0,)]),
        (("clips", 2), 5, [(0, 1), (2, 3)]),
        (("clips", 2, 2), 5, [(0, 2)]),
        (("clips", 2, 2, 1), 5, [(0, 2), (1, 3), (2, 4)]),
        (Clips(3), 4, [(0, 1, 2), (1, 2, 3)]),
    ],
    ids=str,
)
def test_a_rule_gives_its_windows(spec, frames, expected):
    assert windows(spec, frames) == expected


@given(st.integers(1, 90), st.integers(1, 12), st.integers(1, 5), st.integers(1, 9))
def test_clips_are_as_many_as_fit(frames, length, stride, step):
    every_start = [
        tuple(range(start, start + length * stride, stride)) for start in range(0, frames, step)
    ]
    fitting = [clip for clip in every_start if clip[-1] < frames]

    if fitting:
        assert windows(("clips", length, stride, step), frames) == fitting
    else:
        with pytest.raises(SelectionError, match="spans"):
            windows(("clips", length, stride, step), frames)


@pytest.mark.parametrize(
    ("spec", "key_frames", "expected"),
    [
        ("all", (0, 4, 8, 12), 4),
        (("every", 2), (0, 4, 8), 2),
        (("every", 3), (0, 4, 8), 1),
        ("all", (0, 4, 9), 1),
        (("clips", 4), (0, 4, 8), 1),
    ],
    ids=str,
)
def test_key_frames_are_regular_windows_apart_or_count_as_unknown(spec, key_frames, expected):
    assert key_distance(parse_frames(spec), key_frames=key_frames) == expected


def test_random_frames_change_with_epoch_seed_and_scene_and_else_stay():
    draws = [(0, 0, 1), (0, 1, 1), (1, 0, 1), (0, 0, 2)]
    found = [tuple(windows(("random", 8), draw=draw)) for draw in draws]

    assert len(set(found)) == 4
    assert found[0] == tuple(windows(("random", 8), draw=draws[0]))


@given(st.integers(1, 5), st.integers(1, 8), st.integers(1, 4), st.integers(0, 2**31))
def test_random_clips_start_anywhere_and_lie_within_the_scene(n, length, stride, epoch):
    found = list(windows(("random clips", n, length, stride), 40, (0, epoch, 99)))

    assert len(set(found)) == n
    assert found == sorted(found)
    for clip in found:
        assert clip == tuple(range(clip[0], clip[0] + length * stride, stride))
        assert 0 <= clip[0] <= clip[-1] < 40


def test_starts_of_random_clips_cover_a_scene_evenly():
    counts = [0] * 7
    for epoch in range(2000):
        for clip in windows(("random clips", 2, 4), 10, (0, epoch, 0)):
            counts[clip[0]] += 1

    assert min(counts) > 485
    assert max(counts) < 660


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("last", "is not understood"),
        (-1, "whole number from 0, got -1"),
        ([1, 1], "names a frame twice"),
        ([1.5], "got 1.5"),
        (("every", 0), "whole number from 1, got 0"),
        (("random", 2, 3), "is not understood"),
        (None, "is not understood"),
        (81, "frame 81 is asked for of a scene with 81 frames, .* min_frames=82"),
        (("random", 82), "82 windows .* more than the 81 frames .* min_frames=82"),
        (("random clips", 67, 16), "67 windows .* more than the 66 clips .* min_frames=82"),
        (("random clips", 1, 82), "spans 82 frames; a scene has 81.*min_frames=82"),
        (("clips", 21, 5), "spans 101 frames; a scene has 81.*min_frames=101"),
    ],
    ids=str,
)
def test_frames_that_mean_nothing_or_that_a_scene_does_not_have_are_refused(spec, message):
    with pytest.raises(SelectionError, match=message):
        windows(spec)
