"""Training shards: what `size=` gives on the fly, decoded fast, with an error that is known."""

import json
import math
import re
import shutil
import tarfile
import zlib
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from PIL import Image

from stereogenbench_data import (
    PAIR_FIELDS,
    EnlargedSizeWarning,
    FewerPairsWarning,
    StereoPairs,
    evaluate,
    export_inputs,
    score_controls,
)
from stereogenbench_data.audit.contract.doctor import diagnose
from stereogenbench_data.audit.geometry.audit import audit
from stereogenbench_data.errors import MediaError, SchemaError, ShardError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.encoder import (
    QUALITIES,
    measured_error,
    write_pictures,
)
from stereogenbench_data.media.video import probe
from stereogenbench_data.schema.release import TRAINING_JSON
from stereogenbench_data.schema.training import parse_training
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings
from stereogenbench_data.shards.unpack import unpack
from stereogenbench_data.shards.verify import verify
from stereogenbench_data.sources.files import try_locked
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest
from tests.cli.command import succeed
from tests.datasets.conftest import same
from tests.servers.tools import require_module
from tests.shards.shard_files import alter_scene, bytes_of, flip_byte, scenes_of

SIZE = (24, 32)
SETTINGS = TrainingSettings(SIZE)
PICTURES = ("left", "right", "warped_right")
FIELDS = tuple(name for name in PAIR_FIELDS if name not in ("__url__", *PICTURES))
KEY = "train/Uniform/SynthStage/scene_000001"


@pytest.fixture(scope="module", autouse=True)
def blosc2():
    require_module("blosc2")


@pytest.fixture(scope="module")
def release(once):
    """Three scenes of 18 frames, more than two runs between key frames; not to be changed."""

    def make(root):
        for family, scenes in (("IPD_Gaussian", 1), ("Uniform", 2)):
            request = SynthRequest(family=family, scenes=scenes, size_px=48, frames=18)
            synthesise(root, request, workers=1)
        SceneIndex.open(root).write(root / "index.parquet")

    return once("training_release", make)


@pytest.fixture(scope="module")
def packed(release, once):
    """Its training shards by the default settings; not to be changed."""
    return once("training_shards", lambda out: pack(release, out, training=SETTINGS, workers=1))


@pytest.fixture
def shards(packed, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(packed, tmp_path / "shards")


def psnr_db(one, other):
    """Return how alike the left pictures of two samples are."""
    difference = one["left"].float() - other["left"].float()
    return 10 * math.log10(255**2 / np.square(difference.numpy().astype(float)).mean())


def training_json(folder, key):
    member = scenes_of(folder)[key].members[TRAINING_JSON]
    return (folder / member.path).read_bytes()[member.offset :][: member.size]


def document_of(folder, key):
    return json.loads(training_json(folder, key))


def test_all_but_pictures_is_bit_for_bit_what_size_gives(release, packed):
    derived = StereoPairs(packed, pairs="all", frames="all", fields=FIELDS)
    on_the_fly = StereoPairs(release, pairs="all", frames="all", fields=FIELDS, size=SIZE)

    assert len(derived) == len(on_the_fly) == 3 * 15 * 18
    assert all(same(derived[number], on_the_fly[number]) for number in range(0, 810, 53))


def test_pictures_have_the_psnr_that_the_index_states(release, packed):
    derived = StereoPairs(packed, pairs=[(1, 4)], frames="all", fields=("left", "scene"))
    on_the_fly = StereoPairs(release, pairs=[(1, 4)], frames="all", fields=("left",), size=SIZE)
    found = {}
    for one, other in zip(derived, on_the_fly, strict=True):
        found.setdefault(one["scene"], []).append(psnr_db(one, other))

    for key, scene in scenes_of(packed).items():
        decibels = found[key]
        assert scene.training.psnr_db[1] == pytest.approx(np.mean(decibels), abs=0.0011)
        assert scene.training.worst_psnr_db[1] == pytest.approx(min(decibels), abs=0.0011)
        assert scene.training.psnr_db[1] <= np.mean(decibels)
        assert scene.training.worst_psnr_db[1] <= min(decibels)


def test_the_index_says_from_what_and_how_scenes_were_derived(release, packed):
    source, index = SceneIndex.open(release), SceneIndex.open(packed)

    assert index.is_derived
    assert not source.is_derived
    assert "32x24" in index.derivation
    assert source.digest[:12] in index.derivation
    for row in range(len(index)):
        scene, released = index.scene(row), source.scene(row)
        rig = scene.rig
        assert (rig.image_width_px, rig.image_height_px) == (32, 24)
        assert rig.recorded_size_px == (48, 48)
        assert scene.training.source_digest == source.digest
        assert (scene.training.quality, scene.training.codec) == ("balanced", "h264")
        assert json.loads(scene.training.settings)["options"]["crf"] == "10"
        assert scene.key_frames == (0, 4, 8, 12, 16)
        assert scene.depth_codec == ("blosc2",) * 6
        assert replace(
            scene, rig=released.rig, members={}, key_frames=(0,), training=None, depth_codec=()
        ) == replace(released, members={}, depth_codec=())


def test_a_scene_says_so_itself_and_keeps_the_released_metadata(release, packed):
    document = document_of(packed, KEY)
    with tarfile.open(packed / "train-Uniform-000000.tar") as tar:
        texts = {
            name.partition(".")[2]: tar.extractfile(name).read()
            for name in tar.getnames()
            if name.startswith(KEY) and "cam_" not in name
        }
        videos = {name: tar.extractfile(f"{KEY}.{name}").read() for name in document["files"]}

    assert json.loads(texts.pop(TRAINING_JSON)) == document
    assert texts == {name: (release / KEY / name).read_bytes() for name in texts}
    assert len(texts) == 5
    assert document["source"]["key"] == KEY
    sizes = [(document[of]["width_px"], document[of]["height_px"]) for of in ("derived", "source")]
    assert sizes == [(32, 24), (48, 48)]
    assert {"av", "blosc2", "stereogenbench-data"} <= set(document["versions"])
    for name, file in document["files"].items():
        assert len(videos[name]) == file["bytes"]
        assert f"{zlib.crc32(videos[name]):08x}" == file["crc32"]


def test_the_same_input_gives_the_same_bytes_by_workers_and_parts(packed, release, tmp_path):
    pack(release, tmp_path / "two", training=SETTINGS, workers=2)
    first = pack(release, tmp_path / "parts", training=SETTINGS, part=(1, 2), workers=1)
    second = pack(release, tmp_path / "parts", training=SETTINGS, part=(2, 2), workers=1)

    assert (first.index, len(first.missing)) == (None, 1)
    assert second.missing == ()
    assert bytes_of(tmp_path / "two") == bytes_of(tmp_path / "parts") == bytes_of(packed)


def test_more_processes_than_shards_share_the_scenes(packed, release, tmp_path):
    report = pack(release, tmp_path, training=SETTINGS, rows=[1, 2], workers=2)

    shard = "train-Uniform-000000.tar"
    assert report.packed == (shard,)
    assert (tmp_path / shard).read_bytes() == (packed / shard).read_bytes()
    assert not list((tmp_path / ".parts").glob("*.derived"))


def test_a_scene_that_another_process_derives_is_left_to_it(release, tmp_path):
    folder = tmp_path / ".parts" / "train-Uniform-000000.derived" / KEY
    folder.parent.mkdir(parents=True)

    with (
        try_locked(folder.with_name(f".{folder.name}.lock")),
        pytest.raises(ShardError, match=r"scene_000001: another process .*--part I/N"),
    ):
        pack(release, tmp_path, training=SETTINGS, rows=[2], workers=1)


def test_a_finished_pack_is_kept_and_leaves_no_files_of_scenes(shards, release):
    left = shards / ".parts" / "train-Uniform-000000.derived" / KEY / TRAINING_JSON
    left.parent.mkdir(parents=True)
    left.write_bytes(b"{}")
    report = pack(release, shards, training=SETTINGS, workers=1)

    assert report.packed == ()
    assert report.index is not None
    assert not list((shards / ".parts").glob("*.derived"))


class Killed(Exception):
    """The process ends here."""


def pack_until_three_quarters(release, out, **how):
    """Pack training shards, and end as if killed."""

    def killed(done, total):
        if done > 0.75 * total:
            raise Killed

    with pytest.raises(Killed):
        pack(release, out, training=SETTINGS, workers=1, progress=killed, **how)


def test_a_killed_run_loses_at_most_one_scene(packed, release, tmp_path):
    rows = [1, 2]  # those of Uniform
    pack_until_three_quarters(release, tmp_path, rows=rows)
    whole = list(tmp_path.glob(f".parts/*.derived/**/{TRAINING_JSON}"))
    before = {path: path.stat().st_mtime_ns for path in whole[0].parent.iterdir()}
    seen = []

    def watching(done, total):
        if not seen:
            seen.append({path: path.stat().st_mtime_ns for path in before})

    pack(release, tmp_path, training=SETTINGS, rows=rows, workers=1, progress=watching)

    assert len(whole) == 1
    assert not list(tmp_path.glob("*.tmp"))
    assert seen == [before]
    shard = "train-Uniform-000000.tar"
    assert (tmp_path / shard).read_bytes() == (packed / shard).read_bytes()


def test_derived_files_that_were_damaged_before_the_shard_are_made_again(packed, release, tmp_path):
    pack_until_three_quarters(release, tmp_path)
    flip_byte(next(tmp_path.glob(".parts/*.derived/**/cam_03_rgb.mp4")))
    pack(release, tmp_path, training=SETTINGS, workers=1)

    assert bytes_of(tmp_path) == bytes_of(packed)


def test_other_settings_or_another_source_are_another_plan(shards, release, tmp_path):
    with pytest.raises(ShardError, match=r"plan\.json: .* \(plan, training differ\)"):
        pack(release, shards, training=TrainingSettings(SIZE, "small"), workers=1)
    for other in ({"training": SETTINGS, "rows": [0]}, {}):
        with pytest.raises(ShardError, match="another plan"):
            pack(release, shards, workers=1, **other)


def test_shards_are_a_source_as_their_release_is(packed, release, tmp_path):
    pack(release, tmp_path / "source", depth_codec="blosc2", workers=1)
    pack(tmp_path / "source", tmp_path / "out", training=SETTINGS, workers=1)

    one, other = document_of(tmp_path / "out", KEY), document_of(packed, KEY)
    assert one["files"] == other["files"]
    assert one["source"]["index_digest"] != other["source"]["index_digest"]


def test_a_url_is_a_source_as_its_folder_is(packed, release, tmp_path, web):
    shutil.copytree(release, tmp_path / "web", dirs_exist_ok=True)

    pack(web.url, tmp_path / "out", training=SETTINGS, rows=[0], workers=1)

    key = SceneIndex.open(release).scene(0).id.key
    found, expected = document_of(tmp_path / "out", key), document_of(packed, key)
    assert found["files"] == expected["files"]


def test_some_cameras_and_scenes_are_kept_and_their_pairs_are_said_to_be_fewer(release, tmp_path):
    settings = TrainingSettings(SIZE, cameras=(0, 1, 3))
    pack(release, tmp_path, training=settings, rows=[1], workers=1)

    scene = SceneIndex.open(tmp_path).scene(0)
    assert len(scene.held_videos) == 6
    lacking = [camera for camera in range(6) if math.isnan(scene.training.psnr_db[camera])]
    assert lacking == [2, 4, 5]
    with pytest.raises(StorageError, match="cam_02"):
        StereoPairs(tmp_path, pairs=[(0, 2)])
    assert verify(tmp_path, mode="decode", workers=1).problems == ()

    with pytest.warns(FewerPairsWarning, match="pairs='all' gives 3 of 15 pairs") as warned:
        found = StereoPairs(tmp_path, pairs="all", fields=("pair", "left", "disparity"))
    with pytest.warns(FewerPairsWarning, match="pairs='adjacent' gives 1 of 5 pairs"):
        adjacent = StereoPairs(tmp_path, pairs="adjacent", fields=("pair",))
    batches = found.loader(1, shuffle=False, num_workers=0)

    assert [batch["pair"][0].tolist() for batch in batches] == [[0, 1], [0, 3], [1, 3]]
    assert (len(adjacent), adjacent[0]["pair"].tolist()) == (1, [0, 1])
    assert [each.filename for each in warned] == [__file__]


def test_a_scene_that_lacks_a_camera_is_derived_without_it(release, tmp_path):
    source = SceneIndex.open(release)
    scene = source.scene(1)
    held = {name: member for name, member in scene.members.items() if "cam_02" not in name}
    index = SceneIndex.from_scenes([replace(scene, members=held)], release)

    pack(index, tmp_path, training=SETTINGS, workers=1)
    with pytest.raises(ShardError, match=rf"{scene.id.key}: has no cam_02_rgb\.mp4"):
        pack(index, tmp_path / "not", training=TrainingSettings(SIZE, cameras=(1, 2)), workers=1)

    assert len(SceneIndex.open(tmp_path).scene(0).held_videos) == 10


@pytest.mark.parametrize(
    ("request_", "size", "key_frames"),
    [
        (SynthRequest(family="Uniform", scenes=1, size_px=40, frames=1), (17, 23), (0,)),
        (SynthRequest(family="Uniform", scenes=1, size_px=36, frames=17), (18, 34), (0, 8, 16)),
    ],
)
def test_scenes_of_other_lengths_and_sizes(tmp_path, request_, size, key_frames):
    synthesise(tmp_path / "release", request_, workers=1)
    is_odd = size[0] % 2 == 1
    settings = TrainingSettings(size, "high" if is_odd else "small")
    pack(tmp_path / "release", tmp_path / "out", training=settings, workers=1)

    options = {"frames": "all", "fields": ("left", "disparity", "valid")}
    derived = StereoPairs(tmp_path / "out", **options)
    on_the_fly = StereoPairs(tmp_path / "release", **options, size=size)
    last = derived[len(derived) - 1], on_the_fly[len(derived) - 1]
    assert torch.equal(last[0]["disparity"], last[1]["disparity"])
    assert psnr_db(*last) > 25
    assert SceneIndex.open(tmp_path / "out").scene(0).key_frames == key_frames
    report = verify(tmp_path / "out", mode="decode", workers=1)
    assert (report.problems, report.videos_decoded) == ((), 12)


def test_h264_refuses_odd_sides_by_name():
    with pytest.raises(MediaError, match=r"31x24.*even.*quality 'high'"):
        TrainingSettings((24, 31), "balanced")


def test_larger_pictures_than_released_are_refused(release, tmp_path):
    with pytest.raises(ShardError, match=r"scene_000000: .*48x48 .*64x24 are asked for"):
        pack(release, tmp_path, training=TrainingSettings((24, 64)), workers=1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("cameras", "told"), [((), ""), ((3, 1), r".*ascending"), ((6,), r".*0 to 5")]
)
def test_cameras_that_cannot_be_are_refused(cameras, told):
    with pytest.raises(ShardError, match=f"cameras {re.escape(str(cameras))}{told}"):
        TrainingSettings(SIZE, cameras=cameras)


# What reads them, and what refuses them.


def test_a_smaller_size_works_on_top_and_a_larger_one_warns(packed):
    smaller = StereoPairs(packed, size=(12, 16), fields=("left", "disparity", "intrinsics"))[0]
    with pytest.warns(EnlargedSizeWarning, match=r"32x24.*\(48, 48\)"):
        StereoPairs(packed, size=(48, 48))

    plain = StereoPairs(packed, fields=("intrinsics",))[0]
    assert smaller["left"].shape == (3, 12, 16)
    assert torch.allclose(smaller["intrinsics"][0] * 2, plain["intrinsics"][0])


@pytest.mark.parametrize(
    "work",
    [
        lambda data, out: evaluate(data, out, tier="G1"),
        lambda data, out: export_inputs(data, out, tier="G1"),
        lambda data, out: score_controls(data),
        lambda data, out: audit(data),
        lambda data, out: diagnose(data),
        lambda data, out: pack(data, out, training=TrainingSettings((12, 16)), workers=1),
    ],
    ids=["eval score", "eval inputs", "eval controls", "audit", "doctor", "pack"],
)
def test_what_needs_released_pictures_refuses_derived_ones(packed, tmp_path, work):
    (tmp_path / "out").mkdir()
    with pytest.raises(StorageError, match=r"training shards, derived at 32x24.*released data"):
        work(packed, tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_unpacked_training_shards_are_a_folder_of_derived_scenes(packed, tmp_path):
    unpack(packed, tmp_path)
    (tmp_path / "index.parquet").unlink(missing_ok=True)
    folder, shards = scenes_of(tmp_path), scenes_of(packed)

    for key, scene in folder.items():
        for name in ("training", "rig", "key_frames", "rig_residual_px"):
            assert repr(getattr(scene, name)) == repr(getattr(shards[key], name))
    one, other = (StereoPairs(each, fields=("disparity",))[1] for each in (tmp_path, packed))
    assert torch.equal(one["disparity"], other["disparity"])


# Damage and alteration.


def test_an_altered_psnr_contradicts_the_shard(shards):
    def better(scene):
        return {"training": replace(scene.training, psnr_db=(60.0,) * 6)}

    alter_scene(shards, KEY, better)

    problems = verify(shards, workers=1).problems
    (problem, *_) = [each for each in problems if each.member == TRAINING_JSON]
    assert problem.scene == KEY
    assert "60.0" in problem.found


@pytest.mark.parametrize(
    ("alter", "found"),
    [
        (lambda text: text[:-40], "not valid JSON"),
        (lambda text: text.replace(b'"psnr_db": ', b'"psnr_db": 1'), "psnr_db"),
        (lambda text: text.replace(b"cam_00_rgb.mp4", b"../../etc"), "files"),
        (lambda text: text.replace(b"[0, 4, 8, 12, 16]", b"[0, 8, 4, 12, 16]"), "key_frames"),
        (lambda text: text.replace(b'"crc32": "', b'"crc32": "x'), "invalid literal"),
        (lambda text: text.replace(b'"format": 1', b'"format": 2'), "format 2"),
        (lambda text: text.replace(b'"width_px": 32', b'"width_px": 0'), "width_px"),
        (lambda text: text.replace(b'"width_px": 48', b'"width_px": 48.5'), r"width_px .*48\.5"),
        (lambda text: text.replace(b'"width_px": 48', b'"width_px": 1e999'), "width_px .*inf"),
        (lambda text: text.replace(b'"balanced"', b'"a quality"'), "quality, .*a quality"),
        (lambda text: text.replace(b'"balanced"', b"3"), "a value .*expected string"),
    ],
)
def test_an_altered_description_is_refused_with_its_place(packed, alter, found):
    text = alter(training_json(packed, KEY))

    with pytest.raises(SchemaError, match=rf"shard/training\.json: .*{found}"):
        parse_training(text, where="shard/training.json")


def moving(count):
    """Pictures of a smooth texture that moves by three pixels a frame."""
    coarse = np.random.default_rng(0).integers(0, 256, (6, 20, 3), dtype=np.uint8)
    wide = np.asarray(Image.fromarray(coarse).resize((160, 48), Image.Resampling.BICUBIC))
    moved = [wide[:32, 3 * place : 3 * place + 48] for place in range(count)]
    return np.stack(moved).transpose(0, 3, 1, 2)


@pytest.mark.parametrize(
    ("quality", "rate_hz"),
    [("small", Fraction(15)), ("balanced", Fraction(24)), ("high", Fraction(30000, 1001))],
)
def test_a_video_is_written_the_same_each_time_and_read_back(tmp_path, quality, rate_hz):
    pictures = moving(19)
    one, other = tmp_path / "one.mp4", tmp_path / "other.mp4"
    for path in (one, other):
        write_pictures(pictures, path, quality=quality, rate_hz=rate_hz)
    error = measured_error(pictures, one, name="one")
    facts = probe(one, name="one.mp4")

    assert one.read_bytes() == other.read_bytes()
    assert 20 < error.worst_psnr_db <= error.psnr_db < 100
    assert facts.frames == 19
    assert facts.frame_rate_hz == pytest.approx(float(rate_hz), rel=1e-4)
    distance = QUALITIES[quality].key_frame_distance
    assert facts.key_frames == tuple(range(0, 19, distance))


@pytest.mark.parametrize("quality", ["balanced", "high"])
def test_a_neighbouring_frame_in_the_place_of_one_and_a_lost_one_are_found(tmp_path, quality):
    pictures = moving(10)
    write_pictures(pictures, tmp_path / "a.mp4", quality=quality, rate_hz=Fraction(15))

    with pytest.raises(MediaError, match=r"video: frame \d shows frame \d of its source"):
        measured_error(np.roll(pictures, 1, axis=0), tmp_path / "a.mp4", name="video")
    with pytest.raises(MediaError, match="holds 10 frames where 11 are expected"):
        measured_error(moving(11), tmp_path / "a.mp4", name="video")


# The command.


def test_the_command_derives_and_verifies(release, tmp_path):
    out = tmp_path / "train"
    packed = succeed(
        "pack", release, out, "--size", "32x24", "--quality", "small", "--cameras", "0,1",
        "--where", "family=Uniform", "--workers", 1,
    )  # fmt: skip
    verified = succeed("verify", out, "--deep", "--workers", 1)

    assert "2 scenes" in packed.stdout
    assert "derived at 32x24 (quality small, h264)" in verified.stdout
    assert "8 videos decoded; 0 problems" in verified.stdout
