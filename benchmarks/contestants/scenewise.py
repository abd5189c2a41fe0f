"""Plain webdataset and Hugging Face datasets: whole scenes from shards, with a decode step.

A scene is one sample of a shard. The decode step decodes each needed video of the scene once, from
memory, and yields the scene's pairs one after another. So frames of one scene follow each other;
shuffling them over scenes would need a buffer of many scenes' samples.
"""

import io
import json
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import av
import numpy as np
from torch.utils.data import IterableDataset

from benchmarks.contestants.rig import camera_files, rgb_of, sample_of, unit_m_of
from benchmarks.workloads import Job, Wanted
from stereogenbench_data.index.table import SceneIndex


def shards_of(job: Job) -> list[str]:
    """Return the paths of the shards of the workload's scenes, as far as they are packed.

    A workload of more scenes than are packed is read in part: each scene costs the same here.
    """
    index = SceneIndex.open(job.material.shards)
    shards = {
        str(index.column("key")[row]): index.scene(row).members["baseline.json"].path
        for row in range(len(index))
    }
    names = list(dict.fromkeys(shards[key] for key in job.keys if key in shards))
    return [f"{job.material.shards}/{name}" for name in names]


def decoded(job: Job, key: str, files: dict[str, bytes]) -> Iterator[dict[str, Any]]:
    """Yield a scene's samples: the decode step."""
    workload = job.workload
    wanted = job.of_scene[key]
    text: Any = files["baseline.json"]
    document = text if isinstance(text, dict) else json.loads(text)  # datasets parses by itself
    names = camera_files(wanted, both_ways=workload.both_ways)
    moments: dict[tuple[int, ...], list[Wanted]] = {}
    for sample in wanted:
        moments.setdefault(sample.frames, []).append(sample)
    last = max(frames[-1] for frames in moments)
    containers = {name: av.open(io.BytesIO(files[name])) for name in names}
    for container in containers.values():
        container.streams.video[0].codec_context.thread_count = 1
    videos = {name: container.decode(video=0) for name, container in containers.items()}
    recent: dict[int, dict[str, Any]] = {}
    for index in range(last + 1):
        recent[index] = {name: next(video) for name, video in videos.items()}
        for frames in [frames for frames in moments if frames[-1] == index]:
            arrays = {number: _arrays(recent[number], workload.size) for number in frames}
            for sample in moments[frames]:
                yield sample_of(
                    workload, sample, document,
                    colours=partial(_shown, arrays), depth=partial(_stored, arrays, containers),
                )  # fmt: skip
        earliest = min((frames[0] for frames in moments if frames[-1] > index), default=index)
        for number in [number for number in recent if number < earliest]:
            del recent[number]
    for container in containers.values():
        container.close()


def _arrays(frames: dict[str, Any], size: tuple[int, int] | None) -> dict[str, np.ndarray]:
    """Return pictures (3, h, w) and stored depth (h, w) of one frame."""
    return {
        name: frame.to_ndarray() if name.endswith(".mkv") else rgb_of(frame, size)
        for name, frame in frames.items()
    }


def _shown(arrays: dict[int, dict[str, np.ndarray]], camera: int) -> list[np.ndarray]:
    return [each[f"cam_{camera:02d}_rgb.mp4"] for each in arrays.values()]


def _stored(
    arrays: dict[int, dict[str, np.ndarray]], containers: dict[str, Any], camera: int
) -> tuple[list[np.ndarray], float]:
    name = f"cam_{camera:02d}_depth.mkv"
    return [each[name] for each in arrays.values()], unit_m_of(containers[name])


class DecodedScenes(IterableDataset[dict[str, Any]]):
    """A stream of scenes' files, decoded."""

    def __init__(self, job: Job, scenes: Callable[[], Any]) -> None:
        """Take a function that makes an iterable of scenes; torch's workers share its shards."""
        self._job = job
        self._scenes = scenes()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yield samples."""
        for scene in self._scenes:
            yield from decoded(self._job, scene["__key__"], scene)


def webdataset_samples(job: Job) -> IterableDataset[dict[str, Any]]:
    """Return samples through plain webdataset."""
    return webdataset_stream(job, shards_of(job))


def webdataset_stream(job: Job, shards: list[str]) -> IterableDataset[dict[str, Any]]:
    """Return the samples of some shards through plain webdataset."""
    import webdataset

    names = set(job.files)

    def is_needed(member: str) -> bool:
        return member.rsplit("/", 1)[-1].partition(".")[2] in names

    return DecodedScenes(
        job,
        lambda: webdataset.WebDataset(
            shards, shardshuffle=False, select_files=is_needed, empty_check=False
        ),
    )


def hugging_face_samples(job: Job) -> IterableDataset[dict[str, Any]]:
    """Return samples through Hugging Face datasets, streaming."""
    return hugging_face_stream(job, shards_of(job))


def hugging_face_stream(job: Job, shards: list[str]) -> IterableDataset[dict[str, Any]]:
    """Return the samples of some shards through Hugging Face datasets, streaming."""
    from datasets import Features, Value, load_dataset

    columns = {name: Value("binary") for name in job.files}
    features = Features({**columns, "__key__": Value("string"), "__url__": Value("string")})
    return DecodedScenes(
        job,
        lambda: load_dataset(
            "webdataset",
            data_files={"train": shards},
            split="train",
            streaming=True,
            features=features,
        ),
    )
