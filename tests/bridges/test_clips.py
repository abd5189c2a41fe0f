"""Clips as files: what the videos show, what each trainer's manifest says, going on, refusals."""

import csv
import json
import shutil
import tomllib
from dataclasses import replace

import av
import numpy as np
import pandas
import pytest

from stereogenbench_data import SelectionError, StereoPairs
from stereogenbench_data.bridges.clips import export_clips
from stereogenbench_data.errors import MediaError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.encoder import Encoding
from stereogenbench_data.schema.records import DepthEncoding
from tests.servers.tools import files_of, kill_at, killed_fork, small_disk
from tests.shards.shard_files import scenes_of

FIELDS = ("left", "right", "warped_right", "hole", "baseline_m", "frame_rate_hz", "caption",
          "scene", "split", "pair")  # fmt: skip
SHARP = Encoding(crf=1, pixel_format="yuv444p", preset="ultrafast")
QUICK = Encoding(preset="ultrafast")


def decoded(path, *, rate_hz=15):
    """Return the pictures of a video, (t, 3, h, w) uint8, that states this rate."""
    with av.open(path) as container:
        assert container.streams.video[0].average_rate == rate_hz
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return np.stack(pictures).transpose(0, 3, 1, 2)


def difference(one, other):
    return float(np.abs(one.astype(int) - np.asarray(other)).mean())


def records(out):
    return [json.loads(line) for line in (out / "clips.jsonl").read_text().splitlines()]


def exported(data, out, layout="diffsynth", **options):
    options = {"split": "train", "workers": 1, "encoding": QUICK} | options
    return export_clips(data, out, layout=layout, **options)


@pytest.fixture(scope="module")
def everything(indexed_release, tmp_path_factory):
    """An export of two pairs a scene with all videos, sharp enough to be compared."""
    out = tmp_path_factory.mktemp("clips") / "out"
    exported(indexed_release, out, encoding=SHARP, pairs=[(0, 1), (1, 4)])
    return out


@pytest.fixture(scope="module")
def expected(indexed_release):
    options = {"split": "train", "pairs": [(0, 1), (1, 4)], "frames": ("clips", 5)}
    return StereoPairs(indexed_release, fields=FIELDS, **options)


def test_each_video_shows_its_field_and_a_record_says_what_a_clip_is_of(everything, expected):
    found = records(everything)

    assert len(found) == len(expected) == 6
    for record, sample in zip(found, expected, strict=True):
        videos = {kind: decoded(everything / path) for kind, path in record["videos"].items()}
        assert {name: record[name] for name in ("scene", "split", "caption")} == {
            name: sample[name] for name in ("scene", "split", "caption")
        }
        assert record["pair"] == sample["pair"].tolist()
        assert record["frames"] == [0, 1, 2, 3, 4]
        assert record["baseline_m"] == float(sample["baseline_m"])
        assert record["frame_rate_hz"] == float(sample["frame_rate_hz"]) == 15
        assert (record["height"], record["width"]) == (64, 64)
        assert {video.shape for video in videos.values()} == {(5, 3, 64, 64)}
        for kind, name in (("right", "right"), ("left", "left"), ("warped", "warped_right")):
            assert difference(videos[kind], sample[name]) < 1.5
        white = np.repeat(sample["hole"].numpy() * 255, 3, axis=1)
        np.testing.assert_array_equal(videos["mask"], white)
        assert (videos["warped"][white == 255] < 8).mean() > 0.9


def test_diffsynth_reads_its_table_with_pandas(everything, expected):
    table = pandas.read_csv(everything / "metadata.csv")

    assert list(table["prompt"]) == [sample["caption"] for sample in expected]
    # The last digit that pandas reads depends on its version.
    baselines_m = [float(sample["baseline_m"]) for sample in expected]
    np.testing.assert_allclose(table["baseline_m"], baselines_m, rtol=1e-15)
    assert set(table["num_frames"]) == {5}
    columns = ("video", "left_video", "control_video", "vace_video", "vace_video_mask")
    assert {name: set(table[name].str.split("/").str[0]) for name in columns} == {
        "video": {"right"}, "left_video": {"left"}, "control_video": {"warped"},
        "vace_video": {"warped"}, "vace_video_mask": {"mask"},
    }  # fmt: skip
    assert all((everything / path).is_file() for name in columns for path in table[name])


CAPTIONS = ("", "NA", 'Two "quoted" words,\na line\u2028and more')


def test_a_caption_is_one_line_of_text_for_every_trainer(indexed_release, tmp_path):
    index = changed_scenes(indexed_release, caption=("of the eval split", *CAPTIONS))
    for layout in ("diffsynth", "finetrainers", "musubi"):
        assert exported(index, tmp_path / layout, layout).without_caption == 1

    lines = [" ".join(caption.split()) for caption in CAPTIONS]
    read = pandas.read_csv(tmp_path / "diffsynth" / "metadata.csv")["prompt"]
    assert [text.strip() for text in read] == lines
    with (tmp_path / "diffsynth" / "metadata.csv").open(newline="") as file:
        assert next(csv.reader(file))[0] == "video"
        assert len([*csv.reader(file)]) == 3
    assert (tmp_path / "finetrainers" / "prompt.txt").read_text().split("\n") == [*lines, ""]
    texts = sorted((tmp_path / "musubi" / "right").glob("*.txt"))
    assert [text.read_text().strip() for text in texts] == lines


def changed_scenes(root, **values):
    """Return an index whose scenes have other values of some attributes, in the index's order."""
    scenes = [
        replace(scene, **{name: each[row] for name, each in values.items()})
        for row, scene in enumerate(scenes_of(root).values())
    ]
    return SceneIndex.from_scenes(scenes, root)


def test_a_video_that_does_not_state_its_rate_is_named(indexed_release, tmp_path):
    timeless = changed_scenes(indexed_release, frame_rate_hz=(0.0,) * 4)

    with pytest.raises(MediaError, match=r"train/.*: its videos state 0 frames a second"):
        exported(timeless, tmp_path)


def test_finetrainers_gets_two_lists_of_equal_length(indexed_release, tmp_path):
    exported(indexed_release, tmp_path, "finetrainers")

    captions = (tmp_path / "prompt.txt").read_text().splitlines()
    videos = (tmp_path / "videos.txt").read_text().splitlines()
    (dataset,) = json.loads((tmp_path / "dataset.json").read_text())["datasets"]
    assert len(captions) == len(videos) == 3
    assert all((tmp_path / video).is_file() for video in videos)
    assert dataset["data_root"] == str(tmp_path)
    assert dataset["video_resolution_buckets"] == [[5, 64, 64]]
    assert not list(tmp_path.glob("metadata.*"))


def test_musubi_gets_a_configuration_and_a_caption_beside_each_video(indexed_release, tmp_path):
    out = tmp_path / 'a "folder" \u00fc\U0001f600'
    exported(indexed_release, out, "musubi")

    config = tomllib.loads((out / "dataset.toml").read_text())
    (dataset,) = config["datasets"]
    assert config["general"]["resolution"] == [64, 64]
    assert dataset["target_frames"] == [5]
    assert (dataset["video_directory"], dataset["control_directory"]) == (
        str(out / "right"), str(out / "warped"),
    )  # fmt: skip
    videos = sorted((out / "right").glob("*.mp4"))
    assert len(videos) == 3
    for video in videos:
        assert video.with_suffix(".txt").read_text().startswith("A figure walks")
        assert (out / "warped" / video.name).is_file()
    assert not (out / "cache").exists()


def test_stereocrafter_gets_grids_of_four(indexed_release, tmp_path):
    one, thin = {"size": (128, 128), "family": "IPD_Gaussian"}, {"stride": 3, "length": 3}
    exported(indexed_release, tmp_path, "stereocrafter", encoding=SHARP, **one, **thin)
    options = {"split": "train", "frames": ("clips", 3, 3)}
    samples = StereoPairs(indexed_release, fields=FIELDS, **options, **one)

    grids = sorted((tmp_path / "grid").glob("*_splatting_results.mp4"))

    assert len(grids) == len(samples) == 1
    for record, sample in zip(records(tmp_path), samples, strict=True):
        assert record["frame_rate_hz"] == 5
        grid, right = (
            decoded(tmp_path / record["videos"][kind], rate_hz=5) for kind in ("grid", "right")
        )
        height, width = grid.shape[2] // 2, grid.shape[3] // 2
        assert (len(grid), height, width) == (3, 128, 128)
        assert difference(grid[..., :height, :width], sample["left"]) < 1.5
        assert difference(grid[..., height:, width:], sample["warped_right"]) < 1.5
        mask = grid[..., height:, :width].mean(axis=1, keepdims=True) / 255
        assert np.array_equal(mask > 0.5, sample["hole"])
        assert np.abs(mask - sample["hole"].numpy()).mean() < 0.01
        assert difference(right, sample["right"]) < 1.5


def test_clips_may_overlap_and_have_their_own_names(indexed_release, tmp_path):
    options = {"length": 5, "step": 1, "family": "IPD_Gaussian", "pairs": [(0, 1), (0, 5)]}
    report = exported(indexed_release, tmp_path, **options)

    assert len(set(report.written)) == 6
    frames = [record["frames"] for record in records(tmp_path)]
    assert frames.count([0, 1, 2, 3, 4]) == frames.count([2, 3, 4, 5, 6]) == 2


# Going on.


@pytest.fixture(scope="module")
def finished(indexed_release, tmp_path_factory):
    """The folder of an export, and the names of its clips; not to be changed."""
    out = tmp_path_factory.mktemp("finished")
    return out, exported(indexed_release, out).written


def test_a_run_that_is_repeated_keeps_what_is_finished(indexed_release, finished):
    out, names = finished
    before = files_of(out)

    again = exported(indexed_release, out)

    assert (len(names), again.written, again.kept) == (3, (), names)
    assert files_of(out) == before


def test_the_same_export_is_the_same_bytes_with_more_processes(indexed_release, finished, tmp_path):
    assert exported(indexed_release, tmp_path, workers=2).written == finished[1]
    assert files_of(tmp_path) == files_of(finished[0])


@pytest.mark.parametrize("damage", ["video cut", "record removed", "mask removed"])
def test_a_clip_that_is_not_whole_is_written_again(indexed_release, finished, tmp_path, damage):
    before, names = files_of(finished[0]), finished[1]
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    if damage == "video cut":
        video = tmp_path / "right" / f"{names[1]}.mp4"
        video.write_bytes(video.read_bytes()[:-100])
    elif damage == "record removed":
        (tmp_path / "clips" / f"{names[1]}.json").unlink()
    else:
        shutil.rmtree(tmp_path / "mask")

    again = exported(indexed_release, tmp_path)

    assert again.written == (names if damage == "mask removed" else names[1:2])
    assert files_of(tmp_path) == before


def test_a_depth_contract_is_stated_alike_by_every_process(indexed_release, tmp_path):
    """Sets of texts have another order in each process."""
    contract = DepthEncoding(unit_m=0.05, accept=frozenset({"lossy", "8-bit", "chroma"}))

    exported(indexed_release, tmp_path, depth=contract, length=1)

    stated = json.loads((tmp_path / "export.json").read_text())["depth"]
    assert (stated["unit_m"], stated["accept"]) == (0.05, ["8-bit", "chroma", "lossy"])


def test_a_killed_run_goes_on_to_the_bytes_of_an_unbroken_one(indexed_release, tmp_path):
    out, usual = tmp_path / "killed", {"pairs": [(0, 1), (1, 4)]}

    assert killed_fork(
        lambda: exported(indexed_release, out, "musubi", progress=kill_at(15), **usual)
    )
    assert not (out / "dataset.toml").exists()
    report = exported(indexed_release, out, "musubi", **usual)
    exported(indexed_release, tmp_path / "whole", "musubi", **usual)

    assert len(report.kept) >= 2
    assert len(report.written) + len(report.kept) == 6
    found, whole = files_of(out), files_of(tmp_path / "whole")
    assert found.keys() == whole.keys()
    assert {name for name in found if found[name] != whole[name]} == {"dataset.toml"}


# Refusals.


def test_evaluation_scenes_need_an_explicit_word(indexed_release, tmp_path):
    exported(indexed_release, tmp_path / "plain", split=None)
    exported(indexed_release, tmp_path / "named", split="eval")
    exported(indexed_release, tmp_path / "both", split=("train", "eval"))

    assert [record["split"] for record in records(tmp_path / "plain")] == ["train"] * 3
    assert [record["split"] for record in records(tmp_path / "named")] == ["eval"]
    assert [record["split"] for record in records(tmp_path / "both")].count("eval") == 1
    for selection in ({"subset": "seen_map"}, {"scenes": records(tmp_path / "named")[0]["scene"]}):
        with pytest.raises(SelectionError, match="split train left"):
            exported(indexed_release, tmp_path / "none", split=None, **selection)
    assert not (tmp_path / "none").exists()


def test_a_folder_of_another_export_is_refused_by_what_differs(indexed_release, finished):
    out, before = finished[0], files_of(finished[0])

    for change, named in (
        ({"layout": "musubi"}, "layout"),
        ({"size": (32, 32)}, "size"),
        ({"encoding": Encoding()}, "encoding"),
        ({"family": "Uniform"}, "selection"),
        ({"pairs": "all"}, "selection"),
    ):
        with pytest.raises(StorageError, match=rf"an export of other {named}[.\w]*: .*remove"):
            exported(indexed_release, out, **change)
    assert files_of(out) == before


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"size": (33, 64)}, MediaError, r"64x33 pixels .* yuv420p .* yuv444p"),
        ({"length": 81}, SelectionError, r"81 frames .* spans 81 frames; a scene has 7"),
        ({"length": 0}, SelectionError, r"give 1 or 5"),
        ({"stride": 0}, SelectionError, r"from 1, got 0"),
        ({"step": 0}, SelectionError, r"from 1, got 0"),
        ({"layout": "sora"}, SelectionError, r"must be one of diffsynth, .*, got 'sora'"),
        ({"frames": "all"}, SelectionError, "export_clips has no option 'frames'"),
        ({"direction": "right_to_left"}, SelectionError, "choose pairs='primary'"),
        ({"pairs": "sweep"}, SelectionError, "choose pairs='primary'"),
    ],
)
def test_what_cannot_be_exported_is_refused(indexed_release, tmp_path, options, error, said):
    with pytest.raises(error, match=said):
        exported(indexed_release, tmp_path, **options)
    assert not list(tmp_path.rglob("*.mp4"))


def test_a_full_disk_is_named_and_leaves_whole_files(indexed_release, tmp_path):
    with small_disk(tmp_path / "disk", size="128k") as place:
        with pytest.raises(StorageError, match=r"cannot be written \(No space left .*Make room"):
            exported(indexed_release, place / "out", pairs="all")
        for path in place.rglob("*.mp4"):
            assert len(decoded(path)) == 5
