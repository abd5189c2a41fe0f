"""Generation as a whole: parts, resuming, what is refused after rendering, reports."""

import json
from dataclasses import dataclass

import numpy as np
import pytest

from stereogenbench_data.audit.geometry.audit import audit
from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.schema.release import FAMILIES
from stereogenbench_data.synthesis.filters import LIMITS, check_poses
from stereogenbench_data.synthesis.maps import MAPS, open_map
from stereogenbench_data.synthesis.planning import plan_scene
from stereogenbench_data.synthesis.produce import FOLDER, plan_scenes, synthesise
from stereogenbench_data.synthesis.render import RAY_CASTING, RayCasting
from stereogenbench_data.synthesis.renderer import RenderedView
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.scene_files import check_pictures
from tests.servers.tools import files_of

SMALL = {"size_px": 32, "frames": 2, "seed": 9}
MIXED = ("SynthRoom", "SynthYard", "SynthHall")


# Accepted plans.


@pytest.mark.parametrize(
    "asked",
    [{"map_name": name} for name in MAPS] + [{"family": name} for name in FAMILIES[1:]],
    ids=str,
)
def test_every_accepted_frame_passes_all_filters_and_moves_little(asked):
    plan = plan_scene(SynthRequest(size_px=64, **asked), index=1)[0]
    world, rig = open_map(plan.proposal), plan.proposal.rig
    frames = range(plan.proposal.request.frames)
    body_m = np.stack([world.subject_points_m(plan.spawn, frame=frame) for frame in frames])

    reasons = check_poses(plan.centres_m, plan.rotators_deg, body_m=body_m, rig=rig, world=world)
    step_m, turn_deg = plan.steps()

    assert (reasons == "").all()
    assert len(step_m) == 80
    assert np.ptp(plan.rotators_deg[:, 2]) > 1
    assert 0 < step_m.min() <= step_m.max() <= LIMITS.step_m
    assert turn_deg.max() <= LIMITS.turn_deg
    assert np.abs(np.diff(turn_deg)).max() <= LIMITS.jerk_deg


# Parts and resuming.


def test_parts_together_are_the_same_scenes_as_one_run(tmp_path):
    request = SynthRequest(scenes=3, family="Uniform", map_name=MIXED, **SMALL | {"frames": 1})

    whole = synthesise(tmp_path / "whole", request)
    second = synthesise(tmp_path / "parts", request, part=(2, 2))
    first = synthesise(tmp_path / "parts", request, part=(1, 2))

    assert [first[0], second[0], first[1]] == whole
    assert files_of(tmp_path / "parts") == files_of(tmp_path / "whole")


@pytest.mark.parametrize("part", [(0, 2), (3, 2)])
def test_a_part_that_is_none_is_refused(tmp_path, part):
    with pytest.raises(SynthesisError, match=r"part ./.: .* from 1 to the second"):
        synthesise(tmp_path, SynthRequest(**SMALL), part=part)


def test_a_map_without_room_ends_with_the_reasons(tmp_path, monkeypatch):
    monkeypatch.setattr("stereogenbench_data.synthesis.planning.MOST_PROPOSALS", 5)

    with pytest.raises(SynthesisError, match=r"all of 5 proposals are refused \(.* Choose wider"):
        plan_scenes(
            tmp_path, SynthRequest(family="Uniform", map_name="SynthCorridor", focal_mm=85, **SMALL)
        )


# After rendering.


@dataclass(frozen=True)
class Spoilt(RayCasting):
    """A renderer that spoils the views of one proposal."""

    number: int = 0
    picture: object = np.array
    depth_m: object = np.array

    def views(self, plan, *, cameras):
        for view in RAY_CASTING.views(plan, cameras=cameras):
            spoilt = RenderedView(self.picture(view.picture), self.depth_m(view.depth_m))
            yield spoilt if plan.proposal.number <= self.number else view


def test_a_scene_that_fails_after_rendering_is_replaced_by_its_next_proposal(tmp_path):
    request = SynthRequest(map_name="SynthYard", **SMALL)
    plan, _ = plan_scene(request, index=0)
    renderer = Spoilt(number=plan.proposal.number, picture=lambda picture: picture // 64)

    (key,) = synthesise(tmp_path, request, renderer=renderer)

    marker = json.loads((tmp_path / key / "_scene_complete.json").read_text())
    assert marker["synthesis"]["proposal"] > plan.proposal.number


def put(value, where):
    """Return what sets a part of every picture, or of every depth map, to a value."""

    def change(shown):
        shown = np.array(shown)
        shown[where] = value
        return shown

    return change


@pytest.mark.parametrize(
    ("spoilt", "reason", "checks"),
    [
        ({"picture": lambda picture: put(21, picture > 90)(picture * 0 + 9)}, "", set()),
        ({"picture": lambda picture: put(120, np.s_[2:4])(picture // 64)}, "dark", {"too dark"}),
        ({"picture": lambda picture: picture // 24 + 90}, "flat", {"flat"}),
        ({"depth_m": put(np.inf, np.s_[:18])}, "", set()),
        ({"depth_m": put(np.inf, np.s_[:22])}, "invalid_depth", {"invalid depth"}),
        ({"depth_m": put(0.1, np.s_[:16, :8])}, "", set()),
        ({"depth_m": put(0.1, np.s_[:, :2])}, "border_occluder", {"occluder"}),
    ],
)  # fmt: skip
def test_the_audit_finds_in_pictures_what_generation_refuses_and_nothing_else(
    tmp_path, monkeypatch, spoilt, reason, checks
):
    refusals = []
    monkeypatch.setattr(
        "stereogenbench_data.synthesis.produce.check_pictures",
        lambda measured: refusals.append(check_pictures(measured)),  # and pass all
    )
    synthesise(
        tmp_path, SynthRequest(map_name="SynthYard", **SMALL), renderer=Spoilt(9999, **spoilt)
    )

    found = {each.check for each in audit(tmp_path, workers=1).findings}

    assert [refusal.reason if refusal else "" for refusal in refusals] == [reason]
    assert found & {"too dark", "flat", "invalid depth", "occluder"} == checks


def test_a_renderer_that_always_fails_its_checks_ends_with_the_reason(tmp_path, monkeypatch):
    monkeypatch.setattr("stereogenbench_data.synthesis.produce._MOST_RENDERED", 2)

    with pytest.raises(SynthesisError, match=r"2 rendered proposals .* dark .* Check the renderer"):
        synthesise(
            tmp_path,
            SynthRequest(scenes=2, map_name="SynthYard", **SMALL),
            renderer=Spoilt(number=9999, picture=lambda picture: picture // 64),
        )
    assert [path.name for path in tmp_path.iterdir()] == [FOLDER]
    assert not list(tmp_path.rglob("*.mp4"))


def test_wide_rigs_are_refused_more(tmp_path):
    request = SynthRequest(
        scenes=24, family="Uniform", map_name=("SynthYard", "SynthHall"), **SMALL
    )
    planned = plan_scenes(tmp_path, request).values()
    refused = [each for scene in planned for each in scene.refused]
    accepted = [scene.plan.proposal for scene in planned]
    proposed_cm, realised_cm = (
        np.median([np.diff(proposal.places_cm) for proposal in proposals])
        for proposals in ([proposal for proposal, _ in refused] + accepted, accepted)
    )

    assert any(refusal.reason == "collision" for _, refusal in refused)
    assert proposed_cm == pytest.approx(75.5, abs=12)
    assert realised_cm < proposed_cm - 5
