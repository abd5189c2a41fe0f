"""The right views that are scored: written by a method, or returned when it is called.

Written, of the pair of cameras 00 and 01 of a scene, the frames are in one of

    PREDICTIONS/<scene key>/00-01/000.png ...      or PREDICTIONS/<scene key>/00-01.mp4 (.mkv)
    PREDICTIONS/<item>/000.png ...                 or PREDICTIONS/<item>.mp4 (.mkv)

where <item> is `item_name` of scene and pair, as the exported inputs are called. A PNG is named
after its frame's number in the scene. A video holds every frame of the scene, or just those that
are evaluated, in order.
"""

import hashlib
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import av
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter
from PIL import Image

from stereogenbench_data.errors import EvaluationError, MediaError, StorageError, cure_of
from stereogenbench_data.evaluation.tiers import Tier
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.video import VideoReader, plane_numbers, probe, read_rgb
from stereogenbench_data.samples.fields import Sample

Pair = tuple[int, int]
Size = tuple[int, int]

VIDEO_SUFFIXES: Final = (".mp4", ".mkv")
_ITEM_DIGITS: Final = 16
_PNG_BITS_AT: Final = 24
"""Where a PNG's header has the bits of a channel: Pillow halves 16 of them without a word."""
_RED_GREEN_BLUE: Final = (2, 0, 1)
"""Where the planes of FFmpeg's gbrp are."""


class PredictionFault(EvaluationError):
    """A prediction that is missing, or is not what it must be."""


@dataclass(frozen=True, slots=True)
class PairFrames:
    """The frames of one pair that are scored, and what its prediction must hold.

    Attributes:
        scene: The scene's key.
        pair: Left and right camera.
        frames: The frames that are evaluated, ascending.
        scene_frames: How many frames the scene has.
        size: (height, width) that is evaluated.
        stored_size: (height, width) of the scene's own pictures.
    """

    scene: str
    pair: Pair
    frames: tuple[int, ...]
    scene_frames: int
    size: Size
    stored_size: Size

    @property
    def place(self) -> tuple[str, Pair]:
        """The scene's key and the pair."""
        return self.scene, self.pair

    @property
    def label(self) -> str:
        """The scene and the pair as messages show them."""
        return f"{self.scene}, cameras {pair_name(self.pair)}"


class FrameReader(Protocol):
    """The opened frames of one prediction."""

    def read(self, frame: int) -> Any:
        """Return a frame as uint8 (3, h, w), of the evaluated size or the scene's own."""
        ...

    def close(self) -> None:
        """Close what is open."""
        ...


def pair_name(pair: Pair) -> str:
    """Return a pair as file names have it.

    >>> pair_name((0, 1))
    '00-01'
    """
    return f"{pair[0]:02d}-{pair[1]:02d}"


def item_name(scene: str, pair: Pair) -> str:
    """Return an opaque name of a scene's pair, which reveals no family, map or camera.

    >>> item_name("eval/MapSeenInTrain/Uniform/Town/scene_000001", (0, 1))
    '0b5ca3b34645553c'
    """
    return hashlib.sha256(f"{scene} {pair_name(pair)}".encode()).hexdigest()[:_ITEM_DIGITS]


def frame_name(frame: int) -> str:
    """Return the name of a frame's picture.

    >>> frame_name(7)
    '007.png'
    """
    return f"{frame:03d}.png"


def find_prediction(root: Path, wanted: PairFrames) -> Path:
    """Return the folder of pictures or the video that holds a pair's prediction.

    Raises:
        PredictionFault: If there is none, or more than one.
    """
    places = [
        root / wanted.scene / pair_name(wanted.pair),
        root / item_name(wanted.scene, wanted.pair),
    ]
    named = [
        candidate
        for place in places
        for candidate in (place, *(place.with_name(place.name + end) for end in VIDEO_SUFFIXES))
    ]
    found = [path for path in named if path.is_dir() or (path.suffix and path.is_file())]
    if len(found) == 1:
        return found[0]
    if found:
        raise PredictionFault(
            f"{wanted.label}: has several predictions, {found[0]} and {found[1]}: keep one."
        )
    raise PredictionFault(
        f"{wanted.label}: has no prediction in {root}; expected a folder or video "
        f"{places[0].relative_to(root)} or {places[1].name}."
    )


def stamp_prediction(path: Path) -> str:
    """Return a text that changes when the files of a prediction do: names, sizes, times.

    A link to nowhere is a file like others: reading it is the fault.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        facts = file.stat() if file.exists() else file.lstat()
        digest.update(f"{file.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:_ITEM_DIGITS]


def open_prediction(path: Path, wanted: PairFrames) -> FrameReader:
    """Open a prediction that `find_prediction` found.

    Raises:
        PredictionFault: If it has another number of frames, or is not a video.
    """
    if path.is_dir():
        return _PngReader(path, wanted)
    return _VideoFileReader(path, wanted)


class _PngReader:
    def __init__(self, folder: Path, wanted: PairFrames) -> None:
        self._folder = folder
        self._wanted = wanted
        there = {file.name for file in folder.iterdir()}
        missing = [frame for frame in wanted.frames if frame_name(frame) not in there]
        if missing:
            raise PredictionFault(
                f"{wanted.label}: {folder} lacks {len(missing)} of {len(wanted.frames)} frames, "
                f"the first is {frame_name(missing[0])}."
            )
        known = {frame_name(frame) for frame in range(wanted.scene_frames)}
        odd = sorted(name for name in there - known if name.endswith(".png"))
        if odd:
            raise PredictionFault(
                f"{wanted.label}: {folder} holds {odd[0]}, and the scene has "
                f"{wanted.scene_frames} frames, {frame_name(0)} to "
                f"{frame_name(wanted.scene_frames - 1)}."
            )

    def read(self, frame: int) -> Any:
        path = self._folder / frame_name(frame)
        try:
            with path.open("rb") as file:
                bits = file.read(_PNG_BITS_AT + 1)[_PNG_BITS_AT:]
                with Image.open(file, formats=["PNG"]) as image:
                    self._require(image, path, bits=bits)
                    pixels = np.asarray(image)
        except (OSError, SyntaxError, ValueError, zlib.error) as error:
            if isinstance(error, PredictionFault):
                raise
            if isinstance(error, OSError) and cure_of(error):
                raise StorageError(
                    f"{path}: cannot be read ({error.strerror}). {cure_of(error)}"
                ) from error
            raise PredictionFault(
                f"{self._wanted.label}: {path} cannot be read as a picture ({error})."
            ) from error
        except Image.DecompressionBombError as error:
            raise PredictionFault(
                f"{self._wanted.label}: {path} is too large ({error})."
            ) from error
        return np.ascontiguousarray(pixels.transpose(2, 0, 1))

    def _require(self, image: Image.Image, path: Path, *, bits: bytes) -> None:
        if image.mode != "RGB" or bits != b"\x08":
            depth = f" of {bits[0]} bits" if bits else ""
            raise PredictionFault(
                f"{self._wanted.label}: {path} has pixels of mode {image.mode}{depth}: write "
                f"8-bit RGB."
            )
        _require_size((image.height, image.width), path, self._wanted)

    def close(self) -> None:
        """Nothing is kept open."""


class _VideoFileReader:
    def __init__(self, path: Path, wanted: PairFrames) -> None:
        self._path = path
        self._wanted = wanted
        with self._faults():
            facts = probe(path, name=str(path))
            _require_size((facts.height_px, facts.width_px), path, wanted)
            self._order = self._numbers(facts.frames)
            self._reader = VideoReader(path, name=str(path), frames=facts.frames)

    def _numbers(self, count: int) -> dict[int, int]:
        """Return the position of each evaluated frame in the video."""
        if count == self._wanted.scene_frames:
            return {frame: frame for frame in self._wanted.frames}
        if count == len(self._wanted.frames):
            return {frame: place for place, frame in enumerate(self._wanted.frames)}
        raise PredictionFault(
            f"{self._wanted.label}: {self._path} holds {count} frames; expected "
            f"{self._wanted.scene_frames} (the scene's) or {len(self._wanted.frames)} (those "
            f"evaluated)."
        )

    def read(self, frame: int) -> Any:
        with self._faults():
            return read_rgb(self._reader, self._order[frame])

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except (MediaError, StorageError) as error:
            raise PredictionFault(f"{self._wanted.label}: {error}") from error

    def close(self) -> None:
        self._reader.close()


def scaled_rgb(picture: Any, *, size: Size, scaler: VideoReformatter) -> Any:
    """Return a (3, h, w) uint8 picture at another size, by area where it shrinks, else bicubic.

    A picture that has the size already is not touched.
    """
    if picture.shape[1:] == size:
        return picture
    shrinks = size[0] * size[1] < picture.shape[1] * picture.shape[2]
    frame = scaler.reformat(
        av.VideoFrame.from_ndarray(
            np.ascontiguousarray(picture.transpose(1, 2, 0)), format="rgb24"
        ),
        width=size[1],
        height=size[0],
        format="gbrp",
        interpolation=Interpolation.AREA if shrinks else Interpolation.BICUBIC,
        threads=1,
    )
    return np.stack([plane_numbers(frame, plane, dtype="u1") for plane in _RED_GREEN_BLUE])


def require_picture(picture: Any, wanted: PairFrames, *, where: str) -> None:
    """Refuse what a method returned unless it is a right view of the evaluated size.

    Raises:
        PredictionFault: Naming the scene, what was found and what is expected.
    """
    if picture.shape != (3, *wanted.size) or picture.dtype != np.uint8:
        raise PredictionFault(
            f"{wanted.label}: {where} gave {picture.dtype} {tuple(picture.shape)} for a frame; "
            f"expected uint8 {(3, *wanted.size)}."
        )


def _require_size(found: Size, path: Path, wanted: PairFrames) -> None:
    if found not in (wanted.size, wanted.stored_size):
        raise PredictionFault(
            f"{wanted.label}: {path} is {found[1]}x{found[0]}; expected "
            f"{wanted.size[1]}x{wanted.size[0]}, or the scene's own "
            f"{wanted.stored_size[1]}x{wanted.stored_size[0]}."
        )


Method = Callable[[dict[str, Any]], Any]
"""Takes a batch of a tier's inputs, frames of one pair in order, and returns the right views:
uint8, or floats of 0 to 1, (n, 3, h, w)."""


class PredictionReader(Protocol):
    """The right views of one scene while it is scored."""

    def read(self, wanted: PairFrames, samples: Sequence[Sample]) -> Sequence[Any]:
        """Return the right view of each sample, frames of one pair in order: uint8 (3, h, w).

        Each is of the evaluated size, or of that of the scene's own pictures.
        """
        ...

    def close(self) -> None:
        """Close what is open."""
        ...


class PredictionSource(Protocol):
    """A source of right views."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Fields of a sample that it needs."""
        ...

    def stamp(self, wanted: PairFrames) -> str:
        """Return a text that changes when the right views of a pair do.

        Raises:
            PredictionFault: If there are none, or several that could be meant.
        """
        ...

    def open(self, index: SceneIndex) -> PredictionReader:
        """Open a scene; the index holds it, and other scenes that are read for it."""
        ...


@dataclass(frozen=True, slots=True)
class PredictionFolder:
    """Right views that a method wrote, in the layout of `predictions`.

    Attributes:
        name: What tables call the method.
        root: The folder.
        inputs: Nothing of a sample.
    """

    name: str
    root: Path
    inputs: tuple[str, ...] = ()

    def stamp(self, wanted: PairFrames) -> str:
        """Return a text that changes when the files do.

        Raises:
            PredictionFault: If there are none, or several that could be meant.
        """
        return stamp_prediction(find_prediction(self.root, wanted))

    def open(self, index: SceneIndex) -> "_FolderReader":
        """Begin to read a scene's predictions."""
        return _FolderReader(self.root)


class _FolderReader:
    def __init__(self, root: Path) -> None:
        self._root = root
        self._open: dict[Pair, FrameReader] = {}

    def read(self, wanted: PairFrames, samples: Sequence[Sample]) -> list[Any]:
        if wanted.pair not in self._open:
            self._open[wanted.pair] = open_prediction(find_prediction(self._root, wanted), wanted)
        frames = self._open[wanted.pair]
        return [frames.read(int(sample["frame_index"])) for sample in samples]

    def close(self) -> None:
        for frames in self._open.values():
            frames.close()
        self._open.clear()


@dataclass(frozen=True, slots=True)
class CalledMethod:
    """A method that is called with batches of its tier's inputs.

    Attributes:
        name: What tables call the method.
        method: The callable.
        tier: What it is given.
    """

    name: str
    method: Method
    tier: Tier

    @property
    def inputs(self) -> tuple[str, ...]:
        """Fields of a sample that it needs."""
        return self.tier.inputs

    def stamp(self, wanted: PairFrames) -> str:
        """Return the name: a change of what a callable computes cannot be seen."""
        return f"called {self.name}"

    def open(self, index: SceneIndex) -> "CalledMethod":
        """Open a scene."""
        return self

    def read(self, wanted: PairFrames, samples: Sequence[Sample]) -> Sequence[Any]:
        """Return what the method makes of a batch, as uint8 pictures."""
        given = self.method(batch_of([self.tier.inputs_of(sample) for sample in samples]))
        pictures = _as_pictures(given, count=len(samples), wanted=wanted, where=self.name)
        for picture in pictures:
            require_picture(picture, wanted, where=self.name)
        return pictures

    def close(self) -> None:
        """Nothing is kept open."""


def batch_of(inputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return inputs as one dict of tensors with a batch axis in front."""
    import torch

    return {
        name: torch.from_numpy(np.stack([np.asarray(each[name]) for each in inputs]))
        for name in inputs[0]
    }


def _as_pictures(given: Any, *, count: int, wanted: PairFrames, where: str) -> Sequence[Any]:
    """Return a method's answer as an array of uint8 where it holds floats of 0 to 1."""
    if hasattr(given, "detach"):
        tensor = given.detach().cpu()
        given = (tensor.float() if tensor.is_floating_point() else tensor).numpy()
    try:
        array = np.asarray(given)
    except (RuntimeError, TypeError, ValueError) as error:
        raise PredictionFault(
            f"{wanted.scene}: {where} returned a {type(given).__name__} that is not one array "
            f"({error}); expected ({count}, 3, {wanted.size[0]}, {wanted.size[1]})."
        ) from error
    if array.ndim != 4 or len(array) != count or array.size == 0:
        raise PredictionFault(
            f"{wanted.scene}: {where} was given {count} frames and returned {array.dtype} "
            f"{tuple(array.shape)}; expected ({count}, 3, {wanted.size[0]}, {wanted.size[1]})."
        )
    if array.dtype.kind != "f":
        return list(array)
    if not (np.isfinite(array).all() and array.min() >= 0 and array.max() <= 1):
        raise PredictionFault(
            f"{wanted.scene}: {where} returned floats of {array.min():g} to {array.max():g}; "
            f"expected 0 to 1, or uint8."
        )
    return list((array * 255).round().astype(np.uint8))
