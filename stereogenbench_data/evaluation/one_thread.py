"""One thread for a while: scores to the last digit the same, whatever else a process does."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from stereogenbench_data.evaluation.pictures import require_opencv
from stereogenbench_data.evaluation.threads import use_one_thread


@contextmanager
def one_thread() -> Iterator[None]:
    """Let OpenCV and torch compute with the calling thread alone while the block runs.

    Raises:
        ExtraError: If OpenCV is not installed.
    """
    opencv = require_opencv()
    before = opencv.getNumThreads(), torch.get_num_threads()
    use_one_thread()
    try:
        yield
    finally:
        opencv.setNumThreads(before[0])
        torch.set_num_threads(before[1])
