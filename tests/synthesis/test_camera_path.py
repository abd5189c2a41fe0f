from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.synthesis.planning import propose
from stereogenbench_data.synthesis.renderer import ScenePlan, Spawn
from stereogenbench_data.synthesis.request import SynthRequest

angles = st.floats(-180, 180)
rotators = st.tuples(st.floats(-90, 90), angles, angles).map(np.array)


@given(rotator_deg=rotators, offset_cm=st.tuples(*[st.floats(-1e6, 1e6)] * 3).map(np.array))
@settings(max_examples=50, deadline=None)
def test_centres_keep_their_distances_at_any_offset(rotator_deg, offset_cm):
    places_cm = np.array([0.0, 1.0, 6.5, 60.0, 150.0, 749.0])
    drawn = propose(SynthRequest(), index=0, number=0)
    plan = ScenePlan(
        replace(drawn, places_cm=places_cm, offset_cm=offset_cm), Spawn(np.zeros(3), 0.0),
        centres_m=np.array([[-5.23, 0.77, 1.81]]), rotators_deg=rotator_deg[None],
        subject_m=np.ones(1),
    )  # fmt: skip

    centres_cm = plan.world_locations_cm(0)

    distances_cm = np.linalg.norm(centres_cm[1:] - centres_cm[:-1], axis=1)
    np.testing.assert_allclose(distances_cm, np.diff(places_cm), rtol=0, atol=1e-9)


def test_focal_lengths_are_proposed_over_the_range_of_the_release():
    focal_mm = [propose(SynthRequest(), index=index, number=0).focal_mm for index in range(60)]

    assert 18 <= min(focal_mm) < 25
    assert 78 < max(focal_mm) <= 85
