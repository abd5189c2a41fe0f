"""Cameras filmed by several processes: the job of one camera, and the jobs of many."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from stereogenbench_data.engine.process_pool import run_tasks
from stereogenbench_data.errors import StorageError, SynthesisError, cure_of
from stereogenbench_data.synthesis.camera_writer import write_camera
from stereogenbench_data.synthesis.plan import plan_scene
from stereogenbench_data.synthesis.request import SynthRequest


@dataclass(frozen=True, slots=True)
class CameraJob:
    """One camera of one scene, to be written into a folder."""

    request: SynthRequest
    index: int
    camera: int
    folder: Path

    def run(self, after_frame: Callable[[], None]) -> None:
        """Do the work.

        Raises:
            SynthesisError: If a file cannot be written; the message names the scene.
        """
        plan = plan_scene(self.request, index=self.index)
        try:
            write_camera(plan, camera=self.camera, folder=self.folder, after_frame=after_frame)
        except OSError as error:
            raise SynthesisError(
                f"{plan.key}: camera {self.camera} could not be written to {self.folder}: {error}. "
                + cure_of(error, "See that the disk has room and may be written to.")
                + " Then run again: finished scenes are kept."
            ) from error


def run_jobs(
    jobs: Sequence[CameraJob], *, workers: int, after_frames: Callable[[int], None]
) -> Generator[CameraJob, None, None]:
    """Do jobs in any order and yield each when it is done; close it to stop the rest.

    Args:
        jobs: The work.
        workers: How many processes; 1 works in this one.
        after_frames: Called now and then with how many frames were drawn since it was called.

    Raises:
        SynthesisError: If a job fails or a worker dies; the others are stopped first.
    """
    try:
        yield from run_tasks(_write_camera, jobs, workers=workers, after_bytes=after_frames)
    except StorageError as error:
        raise SynthesisError(str(error)) from error


def _write_camera(job: CameraJob, after_frames: Callable[[int], None]) -> CameraJob:
    with _one_thread():
        job.run(lambda: after_frames(1))
    return job


@contextmanager
def _one_thread() -> Iterator[None]:
    """Draw with one thread: how torch rounds depends on how it shares work out."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
