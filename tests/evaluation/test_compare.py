"""An evaluation that is made twice is the same, and one other bit makes it another."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from stereogenbench_data.evaluation.predictions import frame_name, item_name
from stereogenbench_data.evaluation.report import document, page
from stereogenbench_data.evaluation.tables import tables_of
from tests.evaluation.conftest import scored


def reported(scores):
    return json.loads(json.dumps(document([scores], tables_of([scores]))))


@pytest.fixture(scope="module")
def changed(other_views, scored_index, tmp_path_factory):
    """The same right views encoded otherwise, one of them with another pixel."""
    root = tmp_path_factory.mktemp("changed")
    kept, pixel = root / "encoded" / "views", root / "pixel" / "views"
    shutil.copytree(other_views, kept)
    for path in kept.rglob("*.png"):
        Image.open(path).save(path, compress_level=0)
    shutil.copytree(kept, pixel)
    path = pixel / item_name(scored_index.column("key")[0], (0, 1)) / frame_name(0)
    picture = np.array(Image.open(path))
    picture[3, 4, 0] ^= 1
    Image.fromarray(picture).save(path)
    return kept, pixel


def test_the_same_right_views_give_the_same_report_and_one_other_bit_is_found(
    scored_index, other_views, changed, protocol
):
    first, same, other = (
        scored(scored_index, views, protocol, name="a") for views in (other_views, *changed)
    )

    assert first.views_sha256 == same.views_sha256 != other.views_sha256
    assert reported(first) == reported(same)
    mean, others = (
        reported(one)["tables"][0]["rows"][0]["values"]["psnr"]["mean"] for one in (first, other)
    )
    assert mean != others
    text = page([first], tables_of([first]))
    for told in ("- protocol: version 2\n", first.views_sha256, f"sha256 {scored_index.digest}"):
        assert told in text
