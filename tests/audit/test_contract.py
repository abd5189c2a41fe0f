"""Scenes with one thing wrong each: what the pictures say of them, and what they cannot say."""

import json
import math
import re
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data.audit.contract.cameras import CameraCheck
from stereogenbench_data.audit.contract.diagnosis import Rival, SceneDiagnosis
from stereogenbench_data.audit.contract.doctor import diagnose
from stereogenbench_data.audit.contract.hypotheses import LAGS, Hypothesis
from stereogenbench_data.audit.contract.row_matches import match_pairs
from stereogenbench_data.audit.contract.scoring import SURE, Gain, is_ruled_out, pooled
from stereogenbench_data.audit.contract.verdict import (
    DEFAULT,
    QUOTIENT,
    STRETCH,
    TOPICS,
    encoding_line,
    group_by_contract,
    judge,
)
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.render import RAY_CASTING, RayCasting
from stereogenbench_data.synthesis.request import ExportContract, SynthRequest
from tests.audit.corruption import (
    as_inverse,
    as_range,
    as_ray,
    copied,
    depth_of,
    exchange,
    late,
    pictures_of,
    place_cameras,
    rewrite_depth,
    rewrite_rgb,
    scale_camera,
    scaled,
    without_texture,
)
from tests.servers.tools import rewrite_json

UNIT_M = 0.001
FULL_FRAME = RayCasting(sensors_mm=((36, 24),))
RIGHT = SynthRequest(
    family="IPD_Gaussian", size_px=160, height_px=104, frames=9, seed=22, focal_mm=20
)
"""A scene with nothing wrong: wide-angle, oblong, 9 frames."""
LONG_LENS = SynthRequest(family="Uniform", size_px=128, frames=3, seed=109, focal_mm=75)
"""A scene in whose corners a ray is 2.5 % longer than depth along the axis."""
FINE = ExportContract(depth_unit_m=0.0005)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Return the folder of a scene that is drawn once for all tests; not to be changed."""

    @cache
    def drawn(request, renderer=RAY_CASTING, part=(1, 1)):
        root = tmp_path_factory.mktemp("drawn")
        (key,) = synthesise(root, request, renderer=renderer, part=part)
        return root / key

    return drawn


@pytest.fixture
def verdict_on(drawn, tmp_path_factory):
    """Make one thing wrong in a scene, and return the verdict."""

    def verdict_on(corrupt, *, of=(RIGHT,), **options):
        root = tmp_path_factory.mktemp("corrupt")
        corrupt(copied(drawn(*of), root))
        (verdict,) = diagnose(root, workers=1, **({"frames": 1} | options)).verdicts
        return verdict

    return verdict_on


def answer(verdict, topic):
    (found,) = [answer for answer in verdict.answers if answer.topic == topic]
    return found


def wrong_topics(verdict):
    return {answer.topic for answer in verdict.answers if answer.status == "wrong"}


def test_a_right_contract_is_confirmed_question_by_question(verdict_on):
    verdict = verdict_on(lambda folder: None, frames=4)

    assert not verdict.is_wrong
    assert {answer.topic: answer.status for answer in verdict.answers} == {
        QUOTIENT: "confirmed",
        DEFAULT: "confirmed",
        "depth along": "confirmed",
        "stored is": "confirmed",
        "frame lag": "not contradicted",
        "left and right": "confirmed",
        "flip of depth": "confirmed",
        STRETCH: "confirmed",
    }
    assert verdict.fits
    assert verdict.encoding is None
    assert verdict.choices == ()
    assert verdict.tested_cameras == tuple(range(6))
    assert verdict.quotient == pytest.approx(1, rel=0.005)


def test_ray_depth_behind_a_long_lens_is_distinguished_from_a_unit_that_is_a_little_off(verdict_on):
    ray, unit = (
        verdict_on(corrupt, of=(LONG_LENS,), frames=2)
        for corrupt in (
            lambda folder: rewrite_depth(folder, as_ray(folder)),
            lambda folder: rewrite_depth(folder, tags=1.013),
        )
    )

    assert ray.encoding == DepthEncoding(kind="ray")
    assert ray.quotient == pytest.approx(1, rel=0.005)
    assert wrong_topics(ray) == {"depth along"}
    assert unit.encoding is None
    assert answer(unit, "depth along").status == "confirmed"
    assert unit.quotient == pytest.approx(1 / 1.013, rel=0.005)


FITTING = CameraCheck(0.9, untested=())


def diagnosed(**changes):
    """A scene's diagnosis: the declared contract holds, and no other answer was tested."""
    planar = Hypothesis()
    basics = {
        "key": "scene", "views": 1, "matches": 999,
        "unit_m": UNIT_M, "unit_source": "tag",
        "encoding": DepthEncoding(), "declared": planar, "best": planar, "scale_error": 0.001,
        "check": FITTING,
    }  # fmt: skip
    return SceneDiagnosis(**(basics | changes))


def judged(**changes):
    return judge([diagnosed(**changes)])


def test_a_unit_that_the_other_kind_explains_as_well_is_left_open():
    scene = diagnosed(
        is_scaled=True, scale=1.02, rivals=(Rival("kind", "ray", Gain(0.01, 0.02), 1.001),)
    )

    verdict = judge([scene])
    told = judge([replace(scene, rivals=(Rival("kind", "ray", SURE),))])

    assert not verdict.fits
    assert verdict.encoding is None
    assert answer(verdict, QUOTIENT).status == "cannot tell"
    assert "if depth is along the optical axis, as declared if it is not" in (
        answer(verdict, QUOTIENT).note
    )
    assert wrong_topics(told) == {QUOTIENT}


def test_a_wrong_quotient_does_not_accuse_the_unit():
    verdict = judged(
        is_scaled=True,
        scale=1.05,
        scale_error=1e-3,
        rivals=(Rival("kind", "ray", Gain(0.01, 0.02), 1.05),),
    )

    assert verdict.contradicted == ["depth scale 0.95238 x declared ± 0.28%"]


@pytest.mark.parametrize("question", TOPICS)
@pytest.mark.parametrize("behind_db", [math.nan, 0.01, 9.0])
def test_an_answer_is_confirmed_only_where_all_others_were_tested_and_lost(question, behind_db):
    others = [getattr(each, question) for each in Hypothesis().alternatives(question)]
    lost, last = Gain(9.0, 0.1), Gain(behind_db, 0.1)
    # Of lags, the next one.
    different = others.index(1) if question == "frame_lag" else len(others) - 1
    rivals = [Rival(question, other, last if number == different else lost)
              for number, other in enumerate(others)]  # fmt: skip

    found = answer(judged(rivals=tuple(rivals)), TOPICS[question])

    assert found.status == ("confirmed" if behind_db == 9.0 else "cannot tell")
    assert ("not tested" in found.note) == math.isnan(behind_db)


@pytest.mark.parametrize(
    ("best", "tested", "status", "found"),
    [
        (0, (1,), "cannot tell", ""),
        (0, (-1, 1), "confirmed", "0"),
        (1, (-1, 0), "wrong", "1 or 2"),
        (3, (-1, 0, 1), "wrong", "3 or 2 or beyond"),
    ],
)
def test_a_lag_whose_neighbours_no_frame_could_test_is_left_open(best, tested, status, found):
    rivals = tuple(
        Rival("frame_lag", lag, Gain(9.0 if lag in tested else math.nan, 0.1))
        for lag in LAGS
        if lag != best
    )

    lag = answer(judged(best=Hypothesis(frame_lag=best), rivals=rivals), "frame lag")

    assert (lag.status, lag.found) == (status, found)
    assert ("not tested" in lag.note) == (len(tested) < len(LAGS) - 1)
    assert ("beyond" in lag.note) == (abs(best) == 3)


def test_a_scene_of_one_frame_does_not_tell_the_lag(verdict_on):
    one_frame = SynthRequest(family="Uniform", size_px=96, frames=1, seed=3, focal_mm=35)
    verdict = verdict_on(lambda folder: None, of=(one_frame,))

    assert not verdict.is_wrong
    assert answer(verdict, "frame lag").status == "cannot tell"
    assert answer(verdict, "frame lag").note.startswith(
        "not tested, for lack of frames or of motion: -3, -2"
    )
    assert answer(verdict, "depth along").status == "confirmed"


@pytest.mark.parametrize(
    ("scale", "error", "status"),
    [
        (1.001, 0.001, "confirmed"),
        (1.008, 0.001, "cannot tell"),
        (1.013, 0.006, "cannot tell"),
        (1.001, 0.020, "cannot tell"),
    ],
)
def test_a_quotient_is_confirmed_if_its_interval_lies_within_the_margin(scale, error, status):
    verdict = judged(scale=scale, scale_error=error)

    assert not verdict.is_wrong
    assert answer(verdict, QUOTIENT).status == status


@pytest.mark.parametrize(
    ("scenes", "status"),
    [
        # Mean and its two errors: one for the search, a wider one for the interval.
        ([(0.39, 0.10, 0.24)], "not contradicted"),
        ([(9.0, 0.1, 0.1), (1.0, 0.1, 0.1)], "confirmed"),
        ([(9.0, 0.1, 0.1), (0.5, 0.1, 0.2)], "not contradicted"),
    ],
)
def test_confirmed_never_stands_beside_an_interval_that_reaches_the_margin(scenes, status):
    diagnoses = [
        diagnosed(
            key=f"scene {number}",
            rivals=(Rival("form", "inverse", Gain(mean, error, wide_db=wide)),),
        )
        for number, (mean, error, wide) in enumerate(scenes)
    ]  # fmt: skip

    found = answer(judge(diagnoses), TOPICS["form"])

    assert found.status == status
    lows_db = [mean - 1.96 * wide for mean, _, wide in scenes]
    assert (min(lows_db) >= 0.15) == (status == "confirmed")


@pytest.mark.parametrize(
    ("check", "words"),
    [
        (
            replace(FITTING, problems=("depth of camera 2 is 0.5 x that of the others",)),
            "camera 2",
        ),
        (replace(FITTING, unexplained=(5,)), ""),
        (replace(FITTING, untested=(5,)), ""),
    ],
)
def test_nothing_is_pasted_and_nothing_fits_while_a_camera_does_not(check, words):
    rivals = (Rival("kind", "planar", Gain(9.0, 0.1)),)
    verdict = judged(best=Hypothesis(kind="ray"), rivals=rivals, check=check)
    sound = judged(best=Hypothesis(kind="ray"), rivals=rivals)

    assert sound.encoding == DepthEncoding(kind="ray")
    assert verdict.encoding is None
    assert not verdict.fits
    assert verdict.is_wrong == bool(words or not (verdict.problems or verdict.unexplained_cameras))
    assert words in " ".join(verdict.problems)


@pytest.mark.parametrize(
    ("unsure", "status"), [((1,), "wrong"), ((-1, 1), "cannot tell"), ((-2,), "cannot tell")]
)
def test_a_lag_is_called_wrong_only_if_those_that_fit_lie_on_one_side_of_it(unsure, status):
    """The further a lag is from the right one, the worse it fits: so right lags are neighbours."""
    rivals = tuple(
        Rival("frame_lag", lag, Gain(0.2 if lag in unsure else 2.0, 0.15))
        for lag in (-3, -2, -1, 0, 1, 3)
    )
    verdict = judged(best=Hypothesis(frame_lag=2), rivals=rivals)

    assert answer(verdict, "frame lag").status == status


def test_a_scene_with_a_faulty_camera_gets_a_verdict_of_its_own():
    faulty = replace(FITTING, problems=("depth of camera 2 is 0.5 x that of the others",))
    scenes = [diagnosed(key="a"), diagnosed(key="b", check=faulty), diagnosed(key="c")]

    groups = group_by_contract(scenes)

    assert sorted([scene.key for scene in group] for group in groups) == [["a", "c"], ["b"]]


@pytest.mark.parametrize("bits", [10, 13])
def test_depth_in_few_steps_gives_no_false_alarm(verdict_on, bits):
    def coarse(units):
        known = (units > 0) & (units < 65535)
        return np.where(known, (units >> bits << bits) | 1 << (bits - 1), units)

    verdict = verdict_on(lambda folder: rewrite_depth(folder, coarse))

    assert not verdict.is_wrong
    assert answer(verdict, QUOTIENT).status == "cannot tell"


def primary_pair_swapped(folder):
    def swap(document):
        pair = document["primary_stereo_pair"]
        pair["left_camera"], pair["right_camera"] = pair["right_camera"], pair["left_camera"]

    rewrite_json(folder / "baseline.json", swap)


def exchanged(cameras, **options):
    return lambda folder: exchange(folder, cameras, **options)


@pytest.mark.parametrize(
    ("corrupt", "topic", "found"),
    [
        (lambda folder: rewrite_depth(folder, late(-2)), "frame lag", "-2"),
        (lambda folder: rewrite_depth(folder, lambda u: np.flip(u, 2)), "flip of depth",
         "horizontal"),
        (primary_pair_swapped, "left and right", "mirrored or reversed"),
        (exchanged({1: 2, 2: 1}), "left and right", "cameras 1 and 2 exchanged"),
        (exchanged({1: 2, 2: 1}, kinds=("rgb.mp4",)), "left and right",
         "pictures of cameras 1 and 2 exchanged"),
        (exchanged({2: 4, 4: 2}, kinds=("depth.mkv",)), "left and right",
         "depth of cameras 2 and 4 exchanged"),
    ],
    ids=["lag", "flip", "primary pair", "exchanged", "exchanged pictures", "exchanged depth"],
)  # fmt: skip
def test_what_is_wrong_is_found_and_no_unit_stands_for_it(verdict_on, corrupt, topic, found):
    verdict = verdict_on(corrupt, frames=5 if topic == "frame lag" else 1)

    assert wrong_topics(verdict) == {topic}
    told = answer(verdict, topic).found
    assert told == found or found in told.split(" or ")
    assert verdict.encoding in (None, DepthEncoding(frame_lag=-2))
    assert verdict.encoding is None or topic == "frame lag"
    assert verdict.choices == ()
    assert verdict.agreement > 0.5


@pytest.mark.parametrize(
    ("corrupt", "quotient"),
    [
        (lambda folder: rewrite_depth(folder, tags=0.97), 1 / 0.97),
        (lambda folder: scale_camera(folder, focal_length_mm=0.95), 0.95),
    ],
    ids=["unit", "focal length"],
)
def test_a_wrong_quotient_is_measured_and_no_unit_is_pasted(verdict_on, corrupt, quotient):
    verdict = verdict_on(corrupt)

    assert wrong_topics(verdict) == {QUOTIENT}
    assert verdict.quotient == pytest.approx(quotient, rel=0.005)
    assert verdict.encoding is None
    unit, focal = (choice.partition(": ") for choice in verdict.choices[:2])
    assert (unit[0], focal[0]) == (
        "if focal length and baselines are right", "if unit and baselines are right",
    )  # fmt: skip
    factor = float(focal[2].removeprefix("a focal length of ").partition(" x ")[0])
    assert factor == pytest.approx(1 / quotient, rel=0.005)
    assert quotient < 1 or unit[2] == encoding_line(DepthEncoding(unit_m=UNIT_M))


def test_inverse_depth_is_found_with_its_unit(verdict_on):
    seen = {}

    def corrupt(folder):
        change = as_inverse(folder)
        seen["unit_m"] = UNIT_M * 1e4 * float(change(np.full((1, 1, 1), 10000)).item())
        rewrite_depth(folder, change)

    verdict = verdict_on(corrupt)

    assert wrong_topics(verdict) == {"stored is"}
    assert verdict.encoding is None
    (choice,) = verdict.choices
    told = eval(choice.split(": ")[1], {"DepthEncoding": DepthEncoding})
    assert told.form == "inverse"
    assert told.unit_m == pytest.approx(seen["unit_m"], rel=0.005)


def test_files_numbered_one_too_high_are_seen_and_nothing_is_pasted(verdict_on):
    verdict = verdict_on(lambda folder: exchange(folder, {c: (c + 1) % 6 for c in range(6)}))

    assert not verdict.fits
    assert verdict.encoding is None
    assert verdict.choices == ()
    assert "confirmed" not in {found.status for found in verdict.answers}


@pytest.mark.parametrize(
    ("corrupt", "words"),
    [
        (depth_of(1, scaled(1.05)), r"depth of camera 1 is 1\.0[45]\d* x that of the others"),
        (depth_of(3, late(2)), r"depth of camera 3 fits better with a lag of \+2 frames"),
        (depth_of(0, lambda units: np.flip(units, 1)),
         r"depth of camera 0 fits better flipped \(vertical\)"),
        (lambda folder: depth_of(4, as_inverse(folder))(folder),
         r"depth of camera 4 fits worse than that of file \d does in its place"),
        (pictures_of(0, lambda pictures: np.roll(pictures, -1, axis=1)),
         r"pictures of camera 0 are [01]\.\d px higher, or show another moment"),
        (pictures_of(1, lambda pictures: pictures[:, :, ::-1]),
         "pictures of camera 1 do not fit those of the others.*"),
        (pictures_of(1, lambda pictures: np.roll(pictures, 3, axis=2)),
         "pictures of camera 1 do not fit those of the others.*"),
        (pictures_of(5, late(3)),
         "pictures of camera 5 are 3 frames late, or its recorded place is wrong"),
        (lambda folder: place_cameras(folder, {3: 1.2}), ".*camera 3.*another place.*"),
    ],
    ids=["5 % more", "lagged", "flipped", "inverse", "higher", "mirrored", "shifted", "late",
         "elsewhere"],
)  # fmt: skip
def test_what_is_wrong_with_files_of_one_camera_is_named(verdict_on, corrupt, words):
    verdict = verdict_on(corrupt, frames=2)

    (problem,) = verdict.problems
    assert re.fullmatch(words, problem)
    assert verdict.is_wrong
    assert not verdict.fits
    assert verdict.encoding is None
    assert verdict.choices == ()
    assert "confirmed" not in {found.status for found in verdict.answers}


WIDE = SynthRequest(family="Uniform", size_px=96, frames=9, seed=5, scenes=2)


def of_another_scene(*names):
    """Return the change that takes files from the other scene."""

    def corrupt(folder, other):
        for name in names:
            shutil.copy(other / name, folder / name)

    return corrupt


def other_rig(folder, other):
    """Take the other scene's poses, and record the baselines that they have."""
    frames = json.loads((other / "trajectory.json").read_text())["frames"]
    rewrite_json(folder / "trajectory.json", lambda own: own.update(frames=frames))
    place_cameras(folder, {})


@pytest.fixture(scope="module")
def two_wide_scenes(tmp_path_factory):
    """Two scenes in which cameras see so much more than others that pairs as wide differ."""
    root = tmp_path_factory.mktemp("wide")
    first, second = synthesise(root, WIDE)
    return root / second, root / first


@pytest.mark.parametrize(
    ("corrupt", "words"),
    [
        (lambda folder, _: place_cameras(folder, {3: 1.05}), "camera 3 .* px further right, .*"),
        (lambda folder, _: place_cameras(folder, {3: 0.95}), "camera 3 .* px further left, .*"),
        (lambda folder, _: pictures_of(3, lambda seen: np.roll(seen, 1, axis=2))(folder),
         "camera 3 .* (0.9|1.0) px further right, another moment or another place, or its .*"),
        (of_another_scene("cam_02_rgb.mp4", "cam_02_depth.mkv"), "camera 2 do not fit .*"),
    ],
    ids=["elsewhere", "elsewhere the other way", "one pixel aside", "another scene's"],
)  # fmt: skip
def test_no_camera_beside_the_wrong_one_is_named(two_wide_scenes, tmp_path, corrupt, words):
    scene, other = two_wide_scenes
    corrupt(copied(scene, tmp_path), other)

    (verdict,) = diagnose(tmp_path, frames=2, workers=1).verdicts

    (problem,) = verdict.contradicted
    assert re.fullmatch(f"pictures of {words}", problem)


def test_where_most_places_are_wrong_no_camera_is_named(two_wide_scenes, tmp_path):
    scene, other = two_wide_scenes
    other_rig(copied(scene, tmp_path), other)

    (verdict,) = diagnose(tmp_path, frames=2, workers=1).verdicts

    assert verdict.contradicted == [
        "cameras disagree in places or columns of pictures, and no majority of them agrees"
    ]


def of_all_maps(family, *, seed, number, scenes=3, size_px=96):
    """Return how one of some scenes is drawn whose maps are any."""
    of = {"family": family, "size_px": size_px, "seed": seed, "scenes": scenes, "frames": 9}
    return SynthRequest(map_name=RAY_CASTING.maps, **of), RAY_CASTING, (number, scenes)


def test_a_camera_elsewhere_does_not_make_the_quotient_of_all_wrong(verdict_on):
    scene = of_all_maps("IPD_Gaussian", seed=12, number=2)
    verdict = verdict_on(lambda folder: place_cameras(folder, {5: 0.95}), of=scene, frames=4)

    assert verdict.contradicted == []
    assert answer(verdict, QUOTIENT).status == "cannot tell"


def test_depth_is_not_accused_at_matches_that_are_false(verdict_on):
    """The outermost camera is so far away that no other pair is as wide."""
    scene = of_all_maps("Uniform", seed=11, number=1)
    verdict = verdict_on(pictures_of(5, lambda seen: seen[:, ::-1]), of=scene, frames=4)

    assert verdict.contradicted == []
    assert verdict.unexplained_cameras == (5,)


def test_a_flip_accuses_depth_or_pictures():
    rivals = tuple(Rival("flip", flip, Gain(9.0, 0.1)) for flip in ("none", "vertical"))
    verdict = judged(best=Hypothesis(flip="horizontal"), rivals=rivals)

    flip = answer(verdict, "flip of depth")

    assert (flip.status, flip.found) == ("wrong", "horizontal")
    assert flip.note == "or the pictures are flipped"
    assert verdict.contradicted == [
        "flip of depth horizontal, not none (or the pictures are flipped)"
    ]


def test_two_cameras_that_differ_are_both_named(verdict_on):
    def corrupt(folder):
        rewrite_depth(folder, scaled(2.0), cameras=[1])
        rewrite_depth(folder, scaled(1.2), cameras=[4])

    verdict = verdict_on(corrupt)

    first, second = verdict.problems
    assert re.fullmatch(r"depth of camera 1 is (2|1\.99\d*|2\.00\d*) x that of the others", first)
    assert second.startswith("depth of camera 4 is 1.")


def test_pictures_of_most_cameras_in_other_rows_are_told_as_that(verdict_on):
    def corrupt(folder):
        for camera, rows in {1: 1, 3: -1, 4: 2, 5: -2}.items():
            pictures_of(camera, lambda pictures, by=rows: np.roll(pictures, by, axis=1))(folder)

    verdict = verdict_on(corrupt)

    assert all(
        "cameras disagree in rows of pictures, and no majority of them agrees" in problem
        for problem in verdict.problems
    )
    assert verdict.problems


def six_equal_views(folder):
    exchange(folder, dict.fromkeys(range(6), 0))


@pytest.mark.parametrize(
    ("corrupt", "note"),
    [
        (without_texture, "no texture"),
        (six_equal_views, "too little parallax"),
        (lambda folder: rewrite_depth(folder, lambda units: units * 0), "no depth"),
    ],
    ids=["no texture", "no parallax", "no depth"],
)
def test_pictures_that_show_no_disparity_and_files_without_depth_decide_nothing(
    verdict_on, corrupt, note
):
    verdict = verdict_on(corrupt)

    assert not verdict.is_wrong
    assert {answer.status for answer in verdict.answers} == {"cannot tell"}
    assert note in verdict.answers[0].note


LITTLE = SynthRequest(
    family="IPD_Gaussian", size_px=130, height_px=98, frames=7, seed=905311003, focal_mm=79.7,
    contract=FINE,
)  # fmt: skip
"""Disparities of two pixels, whose errors look like other mistakes."""


def test_a_shift_where_little_is_seen_does_not_make_the_unit_wrong(verdict_on):
    shifted = pictures_of(1, lambda pictures: np.roll(pictures, 2, axis=2))
    verdict = verdict_on(shifted, of=(LITTLE,))

    (problem,) = verdict.problems
    assert problem.startswith("pictures of camera 1 do not fit those of the others")
    assert wrong_topics(verdict) == set()


def test_a_unit_where_little_is_seen_is_not_taken_for_a_lag(verdict_on):
    flatter = replace(LITTLE, size_px=128, height_px=84)
    verdict = verdict_on(lambda folder: rewrite_depth(folder, tags=0.976), of=(flatter, FULL_FRAME))

    assert answer(verdict, "frame lag").status == "cannot tell"
    assert verdict.encoding is None


def test_ray_depth_is_not_taken_for_what_explains_few_of_the_matches(verdict_on):
    request = SynthRequest(
        family="Uniform", size_px=170, height_px=128, frames=1, seed=905311007, focal_mm=92.2,
        contract=FINE,
    )  # fmt: skip
    verdict = verdict_on(
        lambda folder: rewrite_depth(folder, lambda units: np.flip(units, 1)),
        of=(request, FULL_FRAME),
    )

    assert wrong_topics(verdict) <= {"flip of depth"}
    assert answer(verdict, "flip of depth").status != "confirmed"
    assert verdict.encoding is None
    assert not verdict.fits


def test_a_lag_that_moves_predictions_by_less_than_a_tenth_of_a_pixel_was_not_tested(verdict_on):
    """Where pictures move by 0.01 px a frame, their codec repeats parts of earlier ones."""
    scene = of_all_maps("IPD_Gaussian", seed=1, number=4, scenes=4, size_px=128)
    verdict = verdict_on(lambda folder: None, of=scene)

    lag = answer(verdict, "frame lag")

    assert (lag.status, verdict.is_wrong) == ("cannot tell", False)
    assert lag.note.startswith("not tested, for lack of frames or of motion: -3, -2, -1, 1, 2, 3")


def test_a_scene_in_which_nothing_moves_does_not_tell_the_lag(verdict_on):
    def still(frames):
        return np.repeat(frames[:1], len(frames), axis=0)

    def corrupt(folder):
        rewrite_depth(folder, still)
        rewrite_rgb(folder, still)

    verdict = verdict_on(corrupt)

    assert not verdict.is_wrong
    assert answer(verdict, "frame lag").status == "cannot tell"
    assert answer(verdict, QUOTIENT).status == "confirmed"


def test_the_contract_requested_about_may_be_given(verdict_on):
    verdict = verdict_on(lambda folder: None, depth=DepthEncoding(unit_m=0.1, kind="ray"))

    assert wrong_topics(verdict) == {QUOTIENT, "depth along"}
    assert 0.1 * verdict.quotient == pytest.approx(UNIT_M, rel=0.005)
    assert verdict.encoding is None
    assert verdict.choices[0].endswith(encoding_line(DepthEncoding(unit_m=UNIT_M)))


def test_a_unit_and_a_sensor_that_are_wrong_alike_show_from_frame_to_frame(verdict_on):
    def widen(folder):
        scale_camera(folder, sensor_width_mm=1.4, sensor_height_mm=1.4)

    verdict = verdict_on(widen, depth=DepthEncoding(unit_m=UNIT_M / 1.4))

    assert answer(verdict, QUOTIENT).status == "confirmed"
    assert wrong_topics(verdict) == {STRETCH}
    focal = float(re.search(r"focal length ([0-9.]+) x", answer(verdict, STRETCH).found)[1])
    assert focal == pytest.approx(1.4, rel=0.06)


def test_scenes_with_different_contracts_get_verdicts_of_their_own(drawn, tmp_path):
    for number, change, factor in ((7, scaled(1 / 23.9), 23.9), (8, scaled(1), 10.0)):
        folder = copied(drawn(RIGHT), tmp_path)
        rewrite_depth(folder, change, tags=factor)
        folder.rename(folder.with_name(f"scene_{number:06d}"))
    copied(drawn(RIGHT), tmp_path)

    report = diagnose(tmp_path, frames=1, workers=1)

    (wrong,) = (verdict for verdict in report.verdicts if verdict.is_wrong)
    right = [verdict for verdict in report.verdicts if verdict is not wrong]
    assert report.is_wrong
    assert wrong.scenes[0].endswith("scene_000008")
    assert [len(verdict.scenes) for verdict in right] == [1, 1]
    for verdict in right:
        assert verdict.quotient == pytest.approx(1, rel=0.01)
        assert answer(verdict, QUOTIENT).status == "confirmed"


def test_depth_of_a_stated_range_is_confirmed(verdict_on):
    def normalise(folder):
        rewrite_depth(folder, as_range(0.5, 60.5, unit_m=UNIT_M), tags={})

    verdict = verdict_on(normalise, depth=DepthEncoding(unit_m=60 / 65535, offset_m=0.5))

    assert answer(verdict, QUOTIENT).status == "confirmed"
    assert verdict.fits


def test_the_scene_that_was_rendered_elsewhere_is_confirmed(shared_scenes):
    (verdict,) = diagnose(shared_scenes, frames=1, workers=1).verdicts

    assert not verdict.is_wrong
    assert verdict.fits
    assert verdict.quotient == pytest.approx(1, rel=0.005)


def test_matching_finds_a_shift_of_either_sign_to_a_part_of_a_pixel():
    texture = np.random.default_rng(0).normal(120, 40, (40, 96)).astype(np.float32)
    smooth = (texture[:, :-2] + 2 * texture[:, 1:-1] + texture[:, 2:]) / 4
    left, right = smooth[:, 10:80], smooth[:, 13:83]

    for pictures, shift_px in (((left, right), 3.0), ((right, left), -3.0)):
        matches = match_pairs(dict(enumerate(pictures)), [(0, 1)])[0, 1]

        assert len(matches) > 1000
        np.testing.assert_allclose(matches[:, 2], shift_px, atol=0.2)


@given(scenes=st.lists(st.tuples(st.floats(-9, 9), st.floats(0.01, 9)), min_size=1, max_size=5))
def test_what_is_pooled_is_at_least_as_sure_as_each_part(scenes):
    parts = [pooled([Gain(*scene)]) for scene in scenes]

    gain = pooled([Gain(*scene) for scene in scenes])

    assert gain.error_db <= min(part.error_db for part in parts) * (1 + 1e-9)
    assert gain.low_db > 0 or not all(part.low_db > 0 for part in parts)


@pytest.mark.parametrize(
    ("scenes", "clear"),
    [
        ([Gain(9.0, 0.5), Gain(15.0, 0.5)], True),
        ([Gain(9.0, 0.5), Gain(0.1, 0.5)], True),
        ([Gain(0.4, 0.2), Gain(0.1, 0.5)], False),
        ([Gain(9.0, 0.5), Gain(-8.0, 0.5)], False),
        ([SURE, Gain(0.0, 0.02)], True),
        ([], False),
    ],
)
def test_what_one_scene_rules_out_is_ruled_out_unless_another_says_the_opposite(scenes, clear):
    assert is_ruled_out(scenes) == clear
