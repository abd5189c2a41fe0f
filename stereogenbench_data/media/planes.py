"""The stored numbers of one plane of a decoded picture."""

import numpy as np
from av.video.frame import VideoFrame
from jaxtyping import UInt8, UInt16


def plane_numbers(
    frame: VideoFrame, plane: int, *, dtype: str, per_pixel: int = 1
) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """Return a plane that is as high as the picture, as a view of the frame's own memory.

    Args:
        frame: A picture, whose rows may be padded.
        plane: Which plane, from 0.
        dtype: "u1", "<u2" or ">u2", as the numbers are stored.
        per_pixel: How many numbers stand in the plane for each pixel.

    Returns:
        (h, w * per_pixel), of the dtype as stored.
    """
    source = frame.planes[plane]
    row_length = source.line_size // np.dtype(dtype).itemsize
    numbers = np.frombuffer(memoryview(source), dtype=dtype, count=frame.height * row_length)
    return numbers.reshape(frame.height, row_length)[:, : frame.width * per_pixel]
