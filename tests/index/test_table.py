"""The index: the same rows in memory, on disk and in another process."""

import contextlib
import dataclasses
import json
import os
import pickle
import random

import fsspec.core
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index import table as index_module
from stereogenbench_data.index.arrow import table_digest
from stereogenbench_data.index.table import AssumptionWarning, IncompleteSceneWarning, SceneIndex
from stereogenbench_data.schema.records import Member, Rig, Scene, SceneId, SceneLabels

METADATA = b"stereogenbench_data.index"
FILES = ("baseline.json", "cam_00_rgb.mp4", "cam_00_depth.mkv")


def scene_of(number, *, seed=0):
    """A scene whose every number comes from a seed."""
    rng = random.Random(f"{seed} {number}")
    key = f"train/Uniform/Car_Dealer/scene_{number:06d}"
    size = rng.choice([64, 1280])
    return Scene(
        id=SceneId(key, "train", rng.choice([None, "seen_map"]), "Uniform", "Car_Dealer"),
        labels=SceneLabels(
            scene_label=rng.choice([None, f"label {number}"]),
            scene_index=rng.choice([None, number]),
            character=rng.choice([None, "SK_\u00c4"]),
            aperture_fstop=rng.choice([None, 2.8]),
        ),
        caption=rng.choice(["", 'A caf\u00e9 "in" Vienna.']),
        rig=Rig(
            focal_mm=rng.uniform(18, 85),
            sensor_width_mm=23.76,
            sensor_height_mm=rng.uniform(10, 30),
            image_width_px=size,
            image_height_px=size,
            principal_point_px=rng.choice([None, (31.5, 32.25)]),
            baselines_cm=tuple(rng.uniform(1, 200) for _ in range(15)),
            primary_pair=rng.choice([(0, 1), (2, 5)]),
            image_size_source=rng.choice(["recorded", "default"]),
        ),
        frames=rng.randint(1, 100),
        frame_rate_hz=15.0,
        lateral_m=tuple(rng.uniform(0, 2) for _ in range(6)),
        rig_residual_px=rng.choice([1e-9, float("inf")]),
        depth_unit_m=tuple(rng.choice([0.1, 0.001]) for _ in range(6)),
        depth_unit_source=tuple(rng.choice(["tag", "default"]) for _ in range(6)),
        depth_codec=("ffv1",) * 6,
        depth_pixel_format=tuple(rng.choice(["gray16le", "gray12le"]) for _ in range(6)),
        valid_depth_ratio=rng.choice([None, 0.9459]),
        members={n: Member(f"{key}/{n}", 0, rng.randint(0, 2**40)) for n in FILES},
    )


@pytest.fixture
def scenes():
    return [scene_of(number) for number in range(5)]


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 6))
def test_a_scene_comes_back_from_the_file_as_it_was(tmp_path_factory, seed, count):
    scenes = [scene_of(number, seed=seed) for number in range(count)]

    index = SceneIndex.open(written(scenes, tmp_path_factory.mktemp("root")))

    assert len(index) == count
    assert [index.scene(row) for row in range(count)] == scenes


def test_the_digest_is_the_same_in_any_order_and_in_parts_of_a_table(scenes, tmp_path):
    index = SceneIndex.from_scenes(reversed(scenes), tmp_path)
    table = pq.read_table(written(reversed(scenes), tmp_path))
    pq.write_table(table, tmp_path / "parts.parquet", row_group_size=2)

    assert index.column("key").tolist() == sorted(scene.id.key for scene in scenes)
    assert SceneIndex.from_scenes(scenes, tmp_path).digest == index.digest
    assert SceneIndex.open(tmp_path / "index.parquet").digest == index.digest
    parts = SceneIndex.open(tmp_path / "parts.parquet")
    assert parts.digest == index.digest
    assert parts.column("depth_codec").tolist() == index.column("depth_codec").tolist()


@pytest.mark.parametrize(
    "change",
    [{"frames": 7}, {"lateral_m": (0.5,) * 6}, {"members": {"a.mp4": Member("a.mp4", 0, 1)}}],
)
def test_the_digest_changes_with_a_scene(scenes, tmp_path, change):
    changed = [*scenes[:-1], dataclasses.replace(scenes[-1], **change)]

    before = SceneIndex.from_scenes(scenes, tmp_path).digest

    assert SceneIndex.from_scenes(changed, tmp_path).digest != before


def test_the_digest_is_pinned(tmp_path):
    index = SceneIndex.from_scenes([scene_of(3)], tmp_path)

    assert index.digest == "d8430dfdc4393c312ed3befc674b33d0ef5319ab286f9ec702ce0f210d3bddd4"


def test_columns_are_arrays_that_cannot_be_changed(scenes, tmp_path):
    index = SceneIndex.from_scenes(scenes, tmp_path)

    baselines_cm = index.column("baselines_cm")

    assert (baselines_cm.shape, baselines_cm.dtype) == ((5, 15), np.float64)
    np.testing.assert_array_equal(baselines_cm[2], scenes[2].rig.baselines_cm)
    np.testing.assert_array_equal(index.column("lateral_m")[4], scenes[4].lateral_m)
    assert index.column("frames").dtype == np.int64
    assert index.column("character").tolist() == [scene.labels.character for scene in scenes]
    assert index.column("depth_unit_source")[1].tolist() == list(scenes[1].depth_unit_source)
    ratios = [scene.valid_depth_ratio or np.nan for scene in scenes]
    np.testing.assert_array_equal(index.column("valid_depth_ratio"), ratios)
    for name in ("baselines_cm", "frames", "key", "valid_depth_ratio"):
        with pytest.raises(ValueError, match="read-only"):
            index.column(name)[0] = 0


@pytest.mark.parametrize("name", ["nothing", "members"])
def test_a_column_that_is_not_there_is_named_with_those_that_are(scenes, tmp_path, name):
    with pytest.raises(StorageError, match=f"has no column '{name}'; it has key, split, family"):
        SceneIndex.from_scenes(scenes, tmp_path).column(name)


@pytest.mark.parametrize("row", [-1, 5])
def test_a_row_that_is_not_there_is_named(scenes, tmp_path, row):
    with pytest.raises(StorageError, match=f"there is no row {row}; the index has 5"):
        SceneIndex.from_scenes(scenes, tmp_path).scene(row)


def test_two_scenes_of_one_key_are_refused(scenes, tmp_path):
    with pytest.raises(StorageError, match="scene_000001' is listed twice"):
        SceneIndex.from_scenes([*scenes, scenes[1]], tmp_path)


@pytest.mark.parametrize(
    ("name", "path"),
    [("a", "../x"), ("a", "/etc/passwd"), ("a", "a/../../b"), ("a", "a\\b"), ("a", ""),
     ("../x", "a.tar"), ("/etc/passwd", "a.tar"), ("a/b", "a.tar"), ("", "a.tar")],
)  # fmt: skip
def test_a_path_or_a_name_that_could_leave_its_folder_is_refused(scenes, tmp_path, name, path):
    bad = dataclasses.replace(scenes[0], members={name: Member(path, 0, 1)})

    with pytest.raises(StorageError, match="is not a path inside the data's root"):
        SceneIndex.from_scenes([bad], tmp_path)


def written(scenes, root):
    """Write the index of some scenes at their root."""
    SceneIndex.from_scenes(scenes, root).write(root / "index.parquet")
    return root / "index.parquet"


def altered(path, edit):
    """Rewrite an index with another table or another description of itself."""
    table = pq.read_table(path)
    head = json.loads(table.schema.metadata[METADATA])
    table = edit(table, head) or table
    pq.write_table(table.replace_schema_metadata({METADATA: json.dumps(head)}), path)


def with_path(path):
    def edit(table, head):
        rows = table.to_pylist()
        rows[2]["members"][1]["path"] = path
        return pa.Table.from_pylist(rows, schema=table.schema)

    return edit


def with_shard(name, *, size):
    facts = {name: {"size": size, "sha256": "", "members": 1}}
    return lambda table, head: head["shards"].update(facts)


@pytest.mark.parametrize(
    ("edit", "match"),
    [
        (lambda table, head: head.update(format=2), "of format 2, and this version .* reads fo"),
        (lambda table, head: head.update(broken=3), "description of itself was altered"),
        (with_shard("x.tar", size="1"), "description of itself was altered"),
        (with_shard("../x.tar", size=1), "description of itself was altered"),
        (lambda table, head: table.drop_columns(["frames"]), r"not those of an index \(see frames"),
        (lambda table, head: table.set_column(0, "key", pa.array(range(5))), r"index \(see key"),
        (lambda table, head: table.take([1, 0, 2, 3, 4]), "is listed twice or out of order"),
        (with_path("train/other"), "its rows were changed"),
        (with_path("../../etc/passwd"), "'../../etc/passwd' is not a path inside the data's root"),
    ],
)
def test_an_altered_index_is_refused(scenes, tmp_path, edit, match):
    path = written(scenes, tmp_path)
    altered(path, edit)

    with pytest.raises(StorageError, match=match):
        SceneIndex.open(path)


def test_a_foreign_parquet_file_is_refused(tmp_path):
    pq.write_table(pa.table({"a": [1]}), tmp_path / "other.parquet")

    with pytest.raises(StorageError, match="a Parquet file, but not an index"):
        SceneIndex.open(tmp_path / "other.parquet")


@pytest.mark.parametrize("keep", [0, 0.99])
def test_a_truncated_index_is_refused(scenes, tmp_path, keep):
    path = written(scenes, tmp_path)
    os.truncate(path, int(keep * path.stat().st_size))

    with pytest.raises(StorageError, match=r"not a readable Parquet file .* cut short"):
        SceneIndex.open(path)


def test_bytes_that_changed_inside_an_index_never_change_a_scene(scenes, tmp_path):
    path = written(scenes, tmp_path)
    content = path.read_bytes()
    rng = random.Random(0)
    for _ in range(40):
        damaged = bytearray(content)
        damaged[rng.randrange(len(content))] ^= rng.randrange(1, 256)
        path.write_bytes(damaged)
        with contextlib.suppress(StorageError):
            assert SceneIndex.open(path).scene(0) == scenes[0]


def test_an_index_behind_a_url_is_fetched_and_its_data_lie_beside_it(scenes, web):
    SceneIndex.from_scenes(scenes, "https://elsewhere").write(web.folder / "index.parquet")
    for url in (web.url, f"{web.url}/", f"{web.url}/index.parquet"):
        web.asked.clear()
        index = SceneIndex.open(url)

        assert index.root == web.url
        assert index.digest == SceneIndex.from_scenes(scenes, web.url).digest
        assert {asked.path for asked in web.asked} == {"index.parquet"}


def test_an_index_behind_a_url_that_is_far_too_large_is_not_fetched(web, monkeypatch):
    monkeypatch.setattr(index_module, "MAX_INDEX_BYTES", 99)
    (web.folder / "index.parquet").write_bytes(bytes(100))

    with pytest.raises(StorageError, match=r"an index may have 99 bytes, this one has 100. It was"):
        SceneIndex.open(web.url)
    assert web.sent == 1


def test_no_secret_is_written_into_an_index(scenes, tmp_path):
    for root, told in (
        ("https://me:word@host/data?key=secret", "https://host/data"),
        ("s3://key:word@bucket/data", "s3://bucket/data"),
        ("zip://data::http://me:word@host/a.zip", "zip://data::http://host/a.zip"),
    ):
        index = SceneIndex.from_scenes(scenes, root)

        assert index.where == told
        with pytest.raises(StorageError, match=f"{told} : the URL has a login or a query"):
            index.write(tmp_path / "kept.parquet")
    assert list(tmp_path.iterdir()) == []


def test_an_index_above_its_data_remembers_where_they_are(scenes, tmp_path):
    (tmp_path / "data").mkdir()
    SceneIndex.from_scenes(scenes, tmp_path / "data").write(tmp_path / "index.parquet")

    assert SceneIndex.open(tmp_path / "index.parquet").root == str(tmp_path / "data")
    (tmp_path / "data").rmdir()
    with pytest.raises(StorageError, match=f"its data were at {tmp_path}/data, which is not a f"):
        SceneIndex.open(tmp_path / "index.parquet")


def test_an_index_elsewhere_opens_once_the_user_says_where_its_data_are(scenes, tmp_path):
    (tmp_path / "data").mkdir()
    kept = tmp_path / "a" / "index.parquet"
    SceneIndex.from_scenes(scenes, tmp_path / "data").write(kept)

    told = rf"{kept}: .*{tmp_path}/data.* SceneIndex.open\('{kept}', root=...\), or --root"
    with pytest.raises(StorageError, match=told):
        SceneIndex.open(kept)
    for root in (tmp_path / "data", str(tmp_path / "data"), (tmp_path / "data").as_uri()):
        assert SceneIndex.open(kept, root=root).root == str(tmp_path / "data")
    kept.rename(tmp_path / "data" / "index.parquet")
    assert SceneIndex.open(tmp_path / "data", root=tmp_path / "a").root == str(tmp_path / "a")


def test_a_root_that_is_no_folder_is_refused(scenes, tmp_path):
    path = written(scenes, tmp_path)
    (tmp_path / "tree").mkdir()

    for root in (tmp_path / "gone", path):
        with pytest.raises(StorageError, match=r"not a folder, and was named as the root"):
            SceneIndex.open(path, root=root)
    with pytest.raises(StorageError, match=r"the path is empty"):
        SceneIndex.open(path, root="")
    with pytest.raises(StorageError, match=r"tree: has no index.parquet, and a root was named"):
        SceneIndex.open(tmp_path / "tree", root=tmp_path)


def recording(scenes, path, root):
    """Write an index that records a root, whatever it is."""
    path.parent.mkdir(exist_ok=True)
    SceneIndex.from_scenes(scenes, path.parent).write(path)
    altered(path, lambda table, head: head.update(root=root))
    return path


@pytest.mark.filterwarnings("ignore::stereogenbench_data.index.table.StaleIndexWarning")
@pytest.mark.parametrize(
    "root",
    [
        "reference://x::data:application/json;base64,e30=",
        "hf://datasets/a/b@main/x",
        "s3://key:word@bucket/x",
        "https://example.org/x?key=word",
        "https://example.org/\x1b[31m",
        "http://[::1",
        "FILE:///etc",
        "../other",
        "link",
        "a\0b",
    ],
)
def test_a_root_not_beside_the_index_is_the_users_own_word(scenes, tmp_path, monkeypatch, root):
    monkeypatch.setattr(fsspec.core, "url_to_fs", None)
    (tmp_path / "other").mkdir()
    path = recording(scenes, tmp_path / "a" / "index.parquet", root)
    (tmp_path / "a" / "link").symlink_to(tmp_path / "other")

    with pytest.raises(StorageError, match=rf"{path}: .*root=\.\.\.\), or --root") as caught:
        SceneIndex.open(path)
    message = str(caught.value)
    assert not any(secret in message for secret in ("word@", "key=", "\x1b", "\0"))
    assert SceneIndex.open(path, root="https://example.org/x").root == "https://example.org/x"

    # Data beside the index come first, whatever it records.
    place = tmp_path / "a" / scenes[0].members["baseline.json"].path
    place.parent.mkdir(parents=True)
    place.write_bytes(b"")
    assert SceneIndex.open(path).root == str(tmp_path / "a")


def with_row(**values):
    def change(rows):
        rows[2].update(values)

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (with_row(image_height_px=0), "image_height_px is 0, not 1 to 65536"),
        (with_row(frames=-3), "frames is -3, not 1 to"),
        (with_row(focal_mm=float("nan")), "focal_mm is nan, not"),
        (with_row(baselines_cm=[-1.0] * 15), "baselines_cm is -1.0, not"),
        (with_row(lateral_m=[float("inf")] * 6), "lateral_m is inf, not"),
        (with_row(rig_residual_px=float("nan")), "rig_residual_px is nan, not 0 to inf"),
        (with_row(depth_unit_m=[0.0] * 6), "depth_unit_m is 0.0, not"),
        (with_row(primary_left=6), "primary_left is 6, not 0 to 5"),
        (with_row(split="test"), "split is 'test', not"),
        (with_row(family="a/b"), "family is 'a/b', not"),
        (with_row(map_name="\x1b[31m"), r"map_name is .*, not"),
        (with_row(training_quality="[small](http://x)"), "training_quality is '.small"),
        (with_row(worst_psnr_db=[-float("inf")] * 6), "worst_psnr_db is -inf, not 0"),
        (with_row(valid_depth_ratio=float("nan")), "valid_depth_ratio is nan, not 0 to 1"),
        (lambda rows: rows[1]["members"][0].update(size=-1), "size is -1, not 0 to"),
        (lambda rows: rows[1]["members"][0].update(offset=2**62), "offset is 4611686018427387904"),
    ],
)
def test_a_value_that_no_scene_has_is_refused_by_itself(scenes, tmp_path, change, match):
    def edit(table, head):
        rows = table.to_pylist()
        change(rows)
        table = pa.Table.from_pylist(rows, schema=table.schema)
        head["digest"] = table_digest(table.replace_schema_metadata())
        return table

    path = written(scenes, tmp_path)
    altered(path, edit)

    with pytest.raises(StorageError, match=rf"index.parquet: {match}"):
        SceneIndex.open(path)


def test_a_few_broken_scenes_of_a_tree_are_left_out_with_one_warning(make_scene, root):
    for number in range(4):
        make_scene(f"train/Uniform/Car_Dealer/scene_{number:06d}")
    (root / "train/Uniform/Car_Dealer/scene_000002" / "baseline.json").write_text("{}")

    with pytest.warns(IncompleteSceneWarning, match="1 scene cannot be used:") as caught:
        index = SceneIndex.open(root)

    assert len(caught) == 1
    assert "scene_000002/baseline.json: 4 problems" in str(caught[0].message)
    assert len(index) == 3


def test_twenty_scenes_that_fail_alike_are_told_as_a_format(make_scene, root):
    for number in range(21):
        folder = make_scene(f"train/Uniform/Car_Dealer/scene_{number:06d}")
        (folder / "baseline.json").write_text('{"lens": {}}')

    with pytest.raises(StorageError, match="none of the 20 scenes that were looked at can be used"):
        SceneIndex.open(root)


@pytest.mark.parametrize("count", [1, 3])
def test_where_no_scene_has_its_mark_all_are_opened_and_that_is_told(make_scene, root, count):
    for number in range(count):
        (make_scene(f"train/a/b/scene_{number}") / "_scene_complete.json").unlink()

    with pytest.warns(AssumptionWarning, match=rf"_scene_complete.*\({count} scene") as told:
        index = SceneIndex.open(root)

    assert (len(index), len(told)) == (count, 1)
    make_scene("eval/MapSeenInTrain/a/b/scene_9")
    with pytest.raises(StorageError, match="scene_0: has no _scene_complete"):
        SceneIndex.open(root, wanted=lambda scene: scene.split == "train")


def test_what_was_left_out_is_reported_when_the_index_is_opened(scenes, tmp_path):
    index = SceneIndex.from_scenes(scenes, tmp_path)
    index.incomplete = {"train/a/b/c": "is empty"}
    index.broken = {"train/a/b/d": "has no baseline.json"}
    index.write(tmp_path / "index.parquet")

    with pytest.warns(IncompleteSceneWarning, match=r"(?s)2 scenes.*b/c: is empty.*b/d: has no b"):
        opened = SceneIndex.open(tmp_path)

    assert (opened.incomplete, opened.broken) == (index.incomplete, index.broken)


def test_seek_tables_are_kept_apart_and_change_no_digest(tmp_path):
    plain = [scene_of(number) for number in range(3)]
    tabled = [dataclasses.replace(each, seek_tables=bytes([n])) for n, each in enumerate(plain)]
    index = SceneIndex.from_scenes(tabled[::-1], tmp_path)
    index.write(tmp_path / "with.parquet")
    SceneIndex.from_scenes(plain, tmp_path).write(tmp_path / "without.parquet")
    SceneIndex.open(tmp_path / "with.parquet", root=tmp_path).write(tmp_path / "again.parquet")

    opened = SceneIndex.open(tmp_path / "again.parquet", root=tmp_path)
    other = SceneIndex.open(tmp_path / "without.parquet", root=tmp_path)

    assert opened.digest == other.digest == index.digest
    assert opened.seek_tables(1) is None
    assert opened.load_seek_tables()
    parts, copy = SceneIndex.of_parts(*opened.parted()), pickle.loads(pickle.dumps(opened))
    for each in (opened, parts, copy):
        assert [each.seek_tables(row) for row in range(3)] == [b"\0", b"\1", b"\2"]
    assert not other.load_seek_tables()
    assert other.seek_tables(1) is None
    assert opened.scene(1) == tabled[1] == plain[1]


@pytest.mark.parametrize("column", [pa.array(["a", "b"]), pa.array([1, 2])])
def test_seek_tables_of_another_kind_are_as_good_as_none(column, tmp_path):
    path = written([scene_of(0), scene_of(1)], tmp_path)
    altered(path, lambda table, head: table.append_column("seek_tables", column))

    assert not SceneIndex.open(path).load_seek_tables()
