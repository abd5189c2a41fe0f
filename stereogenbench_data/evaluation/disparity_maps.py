"""The disparity maps that are scored: written by a method, or returned when it is called.

Written, the frames of cameras 00 and 01 of a scene are in one of

    PREDICTIONS/<scene key>/00-01/000.<kind> ...       PREDICTIONS/<item>/000.<kind> ...

where <item> is the `item_name` of scene and pair, and <kind> one of

    pfm     "Pf", width and height, a scale whose sign is the byte order and whose magnitude is
            ignored, rows from the bottom up; nan or inf: no answer (Middlebury)
    png     16 bits, disparity times 256; 0: no answer (KITTI). It ends at 255.996 px
    npy     one array of numbers; nan or inf: no answer
    npz     the same, its only array or the one that is called "disparity"

A map is (h, w), or (1, h, w), in pixels of the size that is scored.
"""

import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from PIL import Image

from stereogenbench_data.errors import PredictionError
from stereogenbench_data.evaluation.predictions import PairFrames, frame_name, readable
from stereogenbench_data.samples.fields import Sample

PNG_PER_PX: Final = 256
PNG_ENDS_PX: Final = 65535 / PNG_PER_PX
"""The largest disparity that KITTI's PNG holds."""

_PFM_HEAD: Final = re.compile(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,32})\s")
_HEAD_BYTES: Final = 128

Matcher = Callable[[dict[str, Any]], Any]
"""Takes ``left`` and ``right``, uint8 (n, 3, h, w), frames of one pair in order, and returns their
disparity in px, floats (n, h, w) or (n, 1, h, w)."""


@contextmanager
def open_maps(
    folder: Path, wanted: PairFrames, *, max_disparity_px: float | None = None
) -> Iterator[Callable[[Sample], Any]]:
    """Yield a function that reads the disparity map of a sample, float64 (h, w).

    Args:
        folder: The folder of the pair's maps.
        wanted: The pair.
        max_disparity_px: Pixels whose true disparity is this or more are not scored.
    """

    def read(sample: Sample) -> Any:
        path = _file_of(folder, int(sample["frame_index"]), wanted)
        if path.suffix == ".png":  # It cannot hold all truth that may be scored.
            truth_px = sample["disparity"][sample["valid"]]
            if max_disparity_px is not None:
                truth_px = truth_px[truth_px < max_disparity_px]
            if truth_px.size and truth_px.max() > PNG_ENDS_PX:
                raise PredictionError(
                    f"{wanted.label}: {path} is a PNG of KITTI's, which ends at {PNG_ENDS_PX:.3f} "
                    f"px, and the true disparity goes up to {truth_px.max():.1f} px. Write PFM or "
                    f"npy, or pass max_disparity_px."
                )
        return read_disparity(path, size=wanted.size, where=wanted.label)

    yield read


def accept_disparity(returned: torch.Tensor, given: tuple[int, int, int]) -> torch.Tensor:
    """Return disparity that a callable returned, as float64 (n, h, w)."""
    maps = returned[:, 0] if returned.dim() == 4 and returned.shape[1] == 1 else returned
    if maps.shape != given or not maps.is_floating_point():
        raise ValueError(
            f"{returned.dtype} {tuple(returned.shape)}; expected floats {given}, or with an axis "
            f"of 1 after the first"
        )
    return maps.to(torch.float64)


def _file_of(folder: Path, frame: int, wanted: PairFrames) -> Path:
    """Return the file of a frame.

    Raises:
        PredictionError: If there is none, or more than one.
    """
    name = frame_name(frame).removesuffix(".png")
    found = [path for kind in _READERS if (path := folder / f"{name}{kind}").is_file()]
    if len(found) != 1:
        there = f"both {found[0].name} and {found[1].name}: keep one" if found else (
            f"no {name} of {', '.join(_READERS)}"
        )  # fmt: skip
        raise PredictionError(f"{wanted.label}: {folder} has {there}.")
    return found[0]


def read_disparity(path: Path, *, size: tuple[int, int], where: str) -> np.ndarray:
    """Return a disparity map of a file, float (h, w), px; nan or inf where there is no answer.

    Args:
        path: The file; its suffix tells the kind.
        size: (height, width) that it must have.
        where: What errors begin with.

    Raises:
        PredictionError: If it is not such a map.
        StorageError: If it cannot be read.
    """
    with readable(path, where=where, what="a disparity map"):
        found = _READERS[path.suffix](path, size)
        found = found[0] if found.ndim == 3 and len(found) == 1 else found
        _require_shape(found.shape, size)
        if found.dtype.kind not in "fiu":
            raise ValueError(f"it holds {found.dtype}, no numbers")
    return found.astype(np.float64)


def _require_shape(shape: tuple[int, ...], size: tuple[int, int]) -> None:
    if shape != size:
        raise ValueError(
            f"its shape is {shape}, where {size} is scored, with disparity in pixels of that size"
        )


def _read_png(path: Path, size: tuple[int, int]) -> np.ndarray:
    with path.open("rb") as file, Image.open(file, formats=["PNG"]) as image:
        if image.mode not in ("I;16", "I"):
            raise ValueError(f"pixels of mode {image.mode}, where KITTI's have one of 16 bits")
        stored = np.asarray(image)
    return np.where(stored == 0, np.nan, stored / PNG_PER_PX)


def _read_pfm(path: Path, size: tuple[int, int]) -> np.ndarray:
    with path.open("rb") as file:
        head = _PFM_HEAD.match(file.read(_HEAD_BYTES))
        if head is None or head[1] != b"Pf" or not float(head[4]):
            raise ValueError("its head is not that of a PFM of one channel")
        _require_shape((int(head[3]), int(head[2])), size)
        file.seek(head.end())
        content = file.read(4 * size[0] * size[1] + 1)
    order = "<" if float(head[4]) < 0 else ">"
    return np.frombuffer(content, dtype=f"{order}f4").reshape(size)[::-1]


def _read_npz(path: Path, size: tuple[int, int]) -> np.ndarray:
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        name = "disparity.npy" if "disparity.npy" in names else names[0] if names else ""
        if not name.endswith(".npy") or (name != "disparity.npy" and len(names) > 1):
            raise ValueError(f"it holds {', '.join(names)[:80]!r}, and no array 'disparity'")
        most = 16 * size[0] * size[1] + 4096
        if archive.getinfo(name).file_size > most:
            raise ValueError(f"{name} is larger than a map of {size[0]} x {size[1]} can be")
        with archive.open(name) as file:
            array: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return array


_READERS: Final[Mapping[str, Callable[[Path, tuple[int, int]], np.ndarray]]] = {
    ".png": _read_png,
    ".pfm": _read_pfm,
    # Mapped, so that an array of another size is not read.
    ".npy": lambda path, size: np.load(path, mmap_mode="r", allow_pickle=False),
    ".npz": _read_npz,
}
