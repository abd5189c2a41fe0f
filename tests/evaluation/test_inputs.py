"""Exported inputs: each tier's, whole, the same however they are written, and nothing leaks."""

import json
import struct

import numpy as np
import pytest
from PIL import Image

from stereogenbench_data import EvaluationError, StereoPairs
from stereogenbench_data.evaluation.inputs import export_inputs
from stereogenbench_data.evaluation.predictions import item_name
from tests.evaluation.conftest import FRAMES, SIZE
from tests.servers.tools import files_of
from tests.shards.shard_files import scenes_of


def export(index, out, tier, **options):
    return export_inputs(index, out, tier=tier, size=SIZE, workers=1, **options)


@pytest.fixture(scope="module")
def exported(scored_index, tmp_path_factory):
    folders = {}
    for tier in ("G0", "G1", "G2"):
        folders[tier] = tmp_path_factory.mktemp(tier)
        export(scored_index, folders[tier], tier)
    return folders


def test_inputs_are_the_samples_fields(scored_index, exported):
    pairs = StereoPairs(
        scored_index, frames="all", size=SIZE,
        fields=("left", "disparity", "warped_right", "hole", "baseline_m", "intrinsics", "scene"),
    )  # fmt: skip
    sample = pairs[1]
    item = item_name(sample["scene"], (0, 1))
    folder = exported["G0"] / item

    for name in ("left", "warped_right"):
        np.testing.assert_array_equal(
            np.asarray(Image.open(folder / name / "001.png")), sample[name].permute(1, 2, 0)
        )
    hole = np.asarray(Image.open(folder / "hole" / "001.png"))
    np.testing.assert_array_equal(hole, sample["hole"][0] * np.uint8(255))
    np.testing.assert_array_equal(np.load(folder / "disparity" / "001.npy"), sample["disparity"][0])
    camera = json.loads((exported["G1"] / item / "camera.json").read_text())
    assert camera["baseline_m"] == float(sample["baseline_m"])
    assert camera["intrinsics"] == sample["intrinsics"].tolist()


def test_g1_holds_no_depth_and_no_right_view(exported):
    kinds = {path.name for path in exported["G1"].rglob("*") if not path.name[0].isdigit()}

    assert {"left", "camera.json", "inputs.json"} <= kinds
    assert not {"disparity", "warped_right", "hole"} & {p.name for p in exported["G1"].rglob("*")}


def test_g2_leaks_nothing_by_name_or_by_content(scored_index, exported):
    everything = files_of(exported["G2"])
    pictures = [name for name in everything if name != "inputs.json"]
    told = json.loads(everything["inputs.json"])
    forbidden = {b"baseline", b"depth", b"disparity", b"right", b"intrinsic", b"focal"}
    numbers = []
    for scene in scenes_of(scored_index.root).values():
        forbidden |= {scene.id.key.encode(), scene.id.family.encode(), scene.id.map_name.encode()}
        numbers += [*scene.rig.baselines_cm, scene.rig.focal_mm]
    forbidden |= {f"{number:.6g}".encode() for number in numbers}
    forbidden |= {struct.pack("<d", value) for n in numbers for value in (n, n / 100)}

    assert all(name.split("/")[1] == "left" for name in pictures)
    assert set(told) == {"tier", "size", "frames", "data"}
    for name, content in everything.items():
        for word in forbidden:
            assert word not in content.replace(scored_index.digest.encode(), b""), (name, word)
            assert word not in name.encode()


def test_the_pictures_of_g2_have_no_metadata(exported):
    for path in exported["G2"].rglob("*.png"):
        content, chunks, place = path.read_bytes(), [], 8
        while place < len(content):
            size = int.from_bytes(content[place : place + 4], "big")
            chunks.append(content[place + 4 : place + 8])
            place += 12 + size

        assert set(chunks) == {b"IHDR", b"IDAT", b"IEND"}


def test_a_stopped_export_goes_on_and_keeps_what_is_whole(scored_index, tmp_path):
    done = []

    def stop(count, total):
        done.append(count)
        if count > FRAMES + 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(scored_index, tmp_path, "G1", progress=stop)
    (kept,) = [path for path in tmp_path.iterdir() if path.is_dir()]
    before = kept.stat().st_mtime_ns
    items = export(scored_index, tmp_path, "G1")

    assert kept.stat().st_mtime_ns == before
    assert all(len(list((tmp_path / item / "left").iterdir())) == FRAMES for item in items)
    assert not list(tmp_path.glob(".*.unfinished"))


def test_a_folder_of_other_inputs_is_refused_by_what_differs(scored_index, tmp_path):
    export(scored_index, tmp_path, "G2", frames=[0])

    with pytest.raises(EvaluationError, match="holds inputs of other tier"):
        export(scored_index, tmp_path, "G1", frames=[0])
    with pytest.raises(EvaluationError, match="holds inputs of other frames"):
        export(scored_index, tmp_path, "G2", frames=[1])
