"""Mosaic's Streaming: whole scenes from MDS shards, downloaded to a local disk, with a decode step.

A scene is one sample of its shards, as in the tar files, and a shard holds one scene. Streaming
downloads shards ahead of what is read (``predownload``, its default), by the S3 API, which the
server of the benchmark answers for plain reading.
"""

import contextlib
import importlib.machinery
import json
import os
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torch.utils.data import IterableDataset

from benchmarks.contestants.scenewise import decoded
from benchmarks.workloads import Job
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.members import MemberSource


def streaming_module() -> Any:
    """Return the module ``streaming``.

    It imports torchvision for picture datasets that nothing here uses. Where torchvision is missing
    or made for another build of torch, empty modules stand in for it during that import.

    Raises:
        ImportError: If it is not installed.
    """
    stands_in = False
    try:
        import torchvision  # noqa: F401
    except (ImportError, RuntimeError):
        stands_in = True
        _forget_torchvision()
        for name, held in (
            ("torchvision", {}), ("torchvision.datasets", {"VisionDataset": object}),
            ("torchvision.transforms", {}), ("torchvision.transforms.functional", {"to_tensor": 0}),
        ):  # fmt: skip
            module = types.ModuleType(name)
            module.__spec__ = importlib.machinery.ModuleSpec(name, None, is_package=True)
            module.__path__ = []
            module.__dict__.update(held)
            sys.modules[name] = module
    try:
        import streaming
    finally:
        if stands_in:
            _forget_torchvision()
    return streaming


def _forget_torchvision() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        del sys.modules[name]


def write_shards(index: SceneIndex, out: Path) -> None:
    """Write scenes as MDS shards of one scene each: the bytes of all their files."""
    source = MemberSource(index.root, shards=index.shards)
    columns = {"__key__": "str"} | {_column(name): "bytes" for name in index.scene(0).members}
    writer = streaming_module().MDSWriter
    with writer(out=str(out), columns=columns, size_limit=1 << 16) as target:
        for scene in map(index.scene, range(len(index))):
            row: dict[str, Any] = {"__key__": scene.id.key}
            for name in scene.members:
                with source.open(scene, name) as file:
                    row[_column(name)] = file.read()
            target.write(row)


def _column(name: str) -> str:
    return name.replace(".", "_")


def repeat_shards(distinct: Path, out: Path, *, count: int) -> None:
    """Write so many shards that are links to a few in turn, with their index."""
    index = json.loads((distinct / "index.json").read_text())
    shards = [shard for shard in index["shards"] if shard["samples"]]
    repeated = []
    for number in range(count):
        shard = json.loads(json.dumps(shards[number % len(shards)]))
        name = f"shard.{number:05d}.mds"
        if not (out / name).exists():
            os.link(distinct / shard["raw_data"]["basename"], out / name)
        shard["raw_data"]["basename"] = name
        repeated.append(shard)
    (out / "index.json").write_text(json.dumps(index | {"shards": repeated}))


class MosaicScenes(IterableDataset[dict[str, Any]]):
    """The samples of scenes that Streaming streams."""

    def __init__(self, job: Job, *, server: str, remote: str, local: Path) -> None:
        """Open a stream.

        Args:
            job: The samples of each scene.
            server: The URL of a server that answers the S3 API.
            remote: The place of the shards, ``s3://...``.
            local: An empty folder that it downloads to.
        """
        os.environ |= {
            "S3_ENDPOINT_URL": server, "AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "word",
            "AWS_EC2_METADATA_DISABLED": "true", "AWS_DEFAULT_REGION": "us-east-1",
        }  # fmt: skip
        streaming = streaming_module()
        with contextlib.suppress(OSError):
            streaming.base.util.clean_stale_shared_memory()
        self._job = job
        self._scenes = streaming.StreamingDataset(
            remote=remote, local=str(local), shuffle=False, batch_size=1
        )
        for stream in self._scenes.streams:
            # Forked workers would share the connection over which this process read the index.
            stream._downloader.clean_up()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yield samples."""
        for scene in self._scenes:
            files = {name: scene[_column(name)] for name in self._job.files}
            yield from decoded(self._job, scene["__key__"], files)
