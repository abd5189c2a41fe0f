"""The videos of many cameras, written by several processes: one job per camera of a scene."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from stereogenbench_data.engine import LOCAL, Engine
from stereogenbench_data.errors import StorageError, SynthesisError, cure_of
from stereogenbench_data.synthesis.camera_writer import write_camera
from stereogenbench_data.synthesis.plan import plan_scene
from stereogenbench_data.synthesis.request import SynthRequest


@dataclass(frozen=True, slots=True)
class CameraJob:
    """One camera of one scene, and the folder for its videos."""

    request: SynthRequest
    index: int
    camera: int
    folder: Path

    def run(self, after_frame: Callable[[], None]) -> None:
        """Render the camera and write its videos.

        Raises:
            SynthesisError: If a file cannot be written; the message names the scene.
        """
        plan = plan_scene(self.request, index=self.index)
        try:
            write_camera(plan, camera=self.camera, folder=self.folder, after_frame=after_frame)
        except OSError as error:
            raise SynthesisError(
                f"{plan.key}: camera {self.camera} cannot be written to {self.folder}: {error}. "
                + cure_of(error, "Check that the disk has free space and may be written to.")
                + " Then run the same request again: complete scenes are kept."
            ) from error


def run_jobs(
    jobs: Sequence[CameraJob],
    *,
    workers: int | None,
    engine: Engine = LOCAL,
    after_frames: Callable[[int], None],
) -> Generator[CameraJob, None, None]:
    """Run jobs in any order and yield each when it is done; close the generator to stop the rest.

    Args:
        jobs: The jobs.
        workers: The number of processes, None for one a core; with 1, this process does the work.
        engine: Where the processes run.
        after_frames: Called repeatedly with the number of frames rendered since the last call.

    Raises:
        SynthesisError: If a job fails or a worker dies; the others are stopped first.
    """
    try:
        yield from engine.map(
            _write_camera,
            jobs,
            name=lambda job: f"{job.request.key(job.index)}, camera {job.camera}",
            workers=workers,
            advance=after_frames,
        )
    except StorageError as error:
        raise SynthesisError(str(error)) from error


def _write_camera(job: CameraJob, after_frames: Callable[[int], None]) -> CameraJob:
    with _one_thread():
        job.run(lambda: after_frames(1))
    return job


@contextmanager
def _one_thread() -> Iterator[None]:
    """Render with one thread: the rounding of torch depends on the number of threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
