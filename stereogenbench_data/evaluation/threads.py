"""One thread a process: for workers that share a machine's cores among themselves."""

import torch

from stereogenbench_data.evaluation.pictures import require_opencv


def use_one_thread() -> None:
    """Let OpenCV and torch compute in this process with the calling thread alone.

    Raises:
        ExtraError: If OpenCV is not installed.
    """
    require_opencv().setNumThreads(1)
    torch.set_num_threads(1)
