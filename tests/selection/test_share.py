"""A share of scenes: so many, or as many as fit, balanced over families and maps."""

from collections import Counter
from pathlib import Path

import pytest

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.plan import balanced_share
from tests.selection.conftest import made_scene

SCENES = {("IPD", "Town"): 30, ("IPD", "Yard"): 30, ("IPD", "Car"): 2, ("Uniform", "Town"): 12}


@pytest.fixture(scope="module")
def index():
    keys = [
        f"train/{family}/{name}/scene_{number:06d}"
        for (family, name), count in SCENES.items()
        for number in range(count)
    ]
    return SceneIndex.from_scenes(map(made_scene, keys), Path("release"))


def share(index, sizes=None, **options):
    rows = range(len(index))
    return balanced_share(index, rows, sizes or [10] * len(index), **options).tolist()


def places(index, rows):
    names = zip(index.column("family")[rows], index.column("map_name")[rows], strict=True)
    return Counter(names)


def test_families_take_turns_and_in_each_its_maps(index):
    chosen = share(index, scenes=20)

    assert places(index, chosen) == {
        ("IPD", "Town"): 4, ("IPD", "Yard"): 4, ("IPD", "Car"): 2, ("Uniform", "Town"): 10,
    }  # fmt: skip


def test_a_share_of_more_scenes_holds_that_of_fewer(index):
    assert set(share(index, scenes=7)) < set(share(index, scenes=8)) < set(share(index, scenes=60))


def test_a_share_depends_on_names_alone(index):
    one = SceneIndex.from_scenes([index.scene(row) for row in reversed(range(74))], Path("other"))

    assert share(one, scenes=9) == share(index, scenes=9)


def test_as_many_scenes_are_taken_as_fit(index):
    assert share(index, max_bytes=99) == share(index, scenes=9)
    assert share(index, max_bytes=90) == share(index, scenes=9)
    assert share(index, max_bytes=10**9) == list(range(74))
    assert share(index, max_bytes=99, scenes=3) == share(index, scenes=3)


def test_scenes_that_are_too_large_by_themselves_are_passed_over(index):
    sizes = [100 if row % 2 else 10 for row in range(74)]

    chosen = share(index, sizes, max_bytes=50)

    assert len(chosen) == 5
    assert not any(row % 2 for row in chosen)


def test_more_scenes_than_there_are_and_too_few_bytes_are_refused(index):
    with pytest.raises(SelectionError, match="75 scenes wanted, and 74 can be chosen"):
        share(index, scenes=75)
    with pytest.raises(SelectionError, match="no scene fits into 9 bytes: the smallest takes 10"):
        share(index, max_bytes=9)
