"""The right views that are scored: written by a method, or returned when it is called.

Written, the frames of cameras 00 and 01 of a scene are in one of

    PREDICTIONS/<scene key>/00-01/000.png ...      or PREDICTIONS/<scene key>/00-01.mp4 (.mkv)
    PREDICTIONS/<item>/000.png ...                 or PREDICTIONS/<item>.mp4 (.mkv)

where <item> is the `item_name` of scene and pair, as exported inputs are called. A PNG is named
after its frame's number in the scene. A video holds every frame of the scene, or just those that
are evaluated, in order.
"""

import hashlib
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import av
import numpy as np
import torch
from av.video.reformatter import Interpolation, VideoReformatter
from PIL import Image

from stereogenbench_data.errors import (
    MediaError,
    PredictionError,
    StorageError,
    cure_of,
    describe_os_error,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.video import VideoReader, probe, read_rgb
from stereogenbench_data.samples.fields import Request, Sample
from stereogenbench_data.samples.load import SampleDecoder
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.plan import Address

Pair = tuple[int, int]
Size = tuple[int, int]

VIDEO_SUFFIXES: Final = (".mp4", ".mkv")
_ITEM_DIGITS: Final = 16
_PNG_BITS_AT: Final = 24
"""Where a PNG's header has the bits of a channel, which Pillow reduces from 16 to 8 unasked."""
_UNREADABLE: Final = (
    OSError, SyntaxError, ValueError, EOFError, zlib.error, zipfile.BadZipFile,
    Image.DecompressionBombError,
)  # fmt: skip
"""What Pillow, numpy and zipfile raise of a file that is damaged or of another kind."""


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
    def item(self) -> str:
        """The name of its exported inputs and of its prediction, as `item_name` makes it."""
        return item_name(self.scene, self.pair)

    @property
    def label(self) -> str:
        """The scene and the pair as messages show them."""
        return f"{self.scene}, cameras {pair_name(self.pair)}"


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


@contextmanager
def open_frames(
    index: SceneIndex,
    fields: tuple[str, ...],
    *,
    size: Size | None = None,
    depth: DepthEncoding | None = None,
) -> Iterator[Callable[[int, Pair, int], Sample]]:
    """Yield a function that loads the sample of one frame, by the scene's row, pair and frame.

    Args:
        index: The scenes.
        fields: What a sample has (`PAIR_FIELDS`).
        size: (height, width); None for the stored size.
        depth: A depth encoding instead of the one that files and release state.
    """
    request = Request(kind="pairs", fields=fields, layout="single", size=size, depth=depth)
    with closing(SampleDecoder(index, request)) as loader:
        yield lambda row, pair, frame: loader.load(
            Address(row, pair[0], (pair[1],), (frame,)), clip="frame"
        )


def find_prediction(
    root: Path, wanted: PairFrames, *, suffixes: Sequence[str] = VIDEO_SUFFIXES
) -> Path:
    """Return the folder of frames or the video that holds a pair's prediction.

    Args:
        root: The predictions.
        wanted: The pair.
        suffixes: Those of videos; none where a folder alone can hold it.

    Raises:
        PredictionError: If there is none, or more than one.
    """
    places = [root / wanted.scene / pair_name(wanted.pair), root / wanted.item]
    named = [
        candidate
        for place in places
        for candidate in (place, *(place.with_name(place.name + end) for end in suffixes))
    ]
    found = [path for path in named if path.is_dir() or (path.suffix and path.is_file())]
    if len(found) == 1:
        return found[0]
    if found:
        raise PredictionError(
            f"{wanted.label}: has several predictions, {found[0]} and {found[1]}: keep one."
        )
    raise PredictionError(
        f"{wanted.label}: has no prediction in {root}; expected a "
        f"{'folder or video' if suffixes else 'folder'} "
        f"{places[0].relative_to(root)} or {places[1].name}."
    )


def stamp_prediction(path: Path) -> str:
    """Return a text that changes when the files of a prediction do: names, sizes, times.

    A broken link gets a stamp; the error comes when it is read.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        facts = file.stat() if file.exists() else file.lstat()
        digest.update(f"{file.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:_ITEM_DIGITS]


@contextmanager
def readable(path: Path, *, where: str, what: str) -> Iterator[None]:
    """Turn errors of reading a file of a prediction into one that names it.

    Args:
        path: The file.
        where: The scene and the pair.
        what: What the file should be.

    Raises:
        PredictionError: If the file is damaged or of another kind.
        StorageError: If the machine cannot read it now.
    """
    try:
        yield
    except _UNREADABLE as error:
        if isinstance(error, OSError) and cure_of(error):
            raise StorageError(describe_os_error(f"{path}: cannot be read", error)) from error
        raise PredictionError(f"{where}: {path} cannot be read as {what} ({error}).") from error


@contextmanager
def open_views(path: Path, wanted: PairFrames) -> Iterator[Callable[[Sample], Any]]:
    """Yield a function that reads the right views of a prediction that `find_prediction` found.

    Of a sample it returns uint8 (3, h, w), of the evaluated size or the scene's own, and raises
    PredictionError if the frame is not.

    Raises:
        PredictionError: If the prediction has another number of frames, or is not a video.
    """
    if path.is_dir():
        _require_pngs(path, wanted)
        yield lambda sample: _read_png(path / frame_name(int(sample["frame_index"])), wanted)
        return
    with _problems_named(wanted):
        facts = probe(path, name=str(path))
        _require_size((facts.height_px, facts.width_px), path, wanted)
        if facts.frames not in (wanted.scene_frames, len(wanted.frames)):
            raise PredictionError(
                f"{wanted.label}: {path} holds {facts.frames} frames; expected "
                f"{wanted.scene_frames} (the scene's) or {len(wanted.frames)} (those evaluated)."
            )
        reader = VideoReader(path, name=str(path), frames=facts.frames)
    whole = facts.frames == wanted.scene_frames
    places = {frame: frame if whole else n for n, frame in enumerate(wanted.frames)}

    def read(sample: Sample) -> Any:
        with _problems_named(wanted):
            return read_rgb(reader, places[int(sample["frame_index"])])

    with closing(reader):
        yield read


@contextmanager
def _problems_named(wanted: PairFrames) -> Iterator[None]:
    """Turn errors of a video into the prediction's."""
    try:
        yield
    except (MediaError, StorageError) as error:
        raise PredictionError(f"{wanted.label}: {error}") from error


def _require_pngs(folder: Path, wanted: PairFrames) -> None:
    """Raise unless a folder holds a picture of each evaluated frame, and none beyond the scene."""
    there = {file.name for file in folder.iterdir()}
    missing = [frame for frame in wanted.frames if frame_name(frame) not in there]
    if missing:
        raise PredictionError(
            f"{wanted.label}: {folder} lacks {len(missing)} of {len(wanted.frames)} frames, "
            f"the first is {frame_name(missing[0])}."
        )
    known = {frame_name(frame) for frame in range(wanted.scene_frames)}
    odd = sorted(name for name in there - known if name.endswith(".png"))
    if odd:
        raise PredictionError(
            f"{wanted.label}: {folder} holds {odd[0]}, and the scene has {wanted.scene_frames} "
            f"frames, {frame_name(0)} to {frame_name(wanted.scene_frames - 1)}."
        )


def _read_png(path: Path, wanted: PairFrames) -> Any:
    with readable(path, where=wanted.label, what="a picture"), path.open("rb") as file:
        bits = file.read(_PNG_BITS_AT + 1)[_PNG_BITS_AT:]
        with Image.open(file, formats=["PNG"]) as image:
            mode, pixels = image.mode, np.asarray(image)
    if mode != "RGB" or bits != b"\x08":
        raise PredictionError(
            f"{wanted.label}: {path} has pixels of mode {mode} of {bits[0]} bits: write 8-bit RGB."
        )
    _require_size((pixels.shape[0], pixels.shape[1]), path, wanted)
    return np.ascontiguousarray(pixels.transpose(2, 0, 1))


def _require_size(found: Size, path: Path, wanted: PairFrames) -> None:
    if found not in (wanted.size, wanted.stored_size):
        raise PredictionError(
            f"{wanted.label}: {path} is {found[1]}x{found[0]}; expected "
            f"{wanted.size[1]}x{wanted.size[0]}, or the scene's own "
            f"{wanted.stored_size[1]}x{wanted.stored_size[0]}."
        )


def scaled_rgb(picture: Any, *, size: Size, scaler: VideoReformatter) -> Any:
    """Return a (3, h, w) uint8 picture at another size, by area where it shrinks, else bicubic.

    A picture that has the size already is returned as it is.
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
    return np.ascontiguousarray(frame.to_ndarray().transpose(2, 0, 1))


Method = Callable[[dict[str, Any]], Any]
"""Takes a batch of a tier's inputs, frames of one pair in order, and returns the right views:
uint8, or floats of 0 to 1, (n, 3, h, w)."""

Read = Callable[[PairFrames, Sequence[Sample]], Sequence[Any]]
"""Takes the samples of some frames of one pair, in order, and returns what is scored of them: right
views, uint8 (3, h, w), of the evaluated size or of that of the scene's own pictures; or disparity,
float64 (h, w)."""

OpenPair = Callable[[Path, PairFrames], AbstractContextManager[Callable[[Sample], Any]]]
"""Opens what was written for a pair, and yields a function that reads the frame of a sample."""


class PredictionSource(Protocol):
    """A source of right views."""

    @property
    def name(self) -> str:
        """What tables call it."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Fields of a sample that it needs."""

    def stamp(self, wanted: PairFrames) -> str:
        """Return a text that changes when the right views of a pair do.

        Raises:
            PredictionError: If there are none, or several that could be meant.
        """

    def open(self, index: SceneIndex) -> AbstractContextManager[Read]:
        """Open a scene; the index holds it, and other scenes that are read for it."""


@dataclass(frozen=True, slots=True)
class PredictionFolder:
    """What a method wrote: right views, in the layout of `predictions`, unless told otherwise.

    Attributes:
        name: What tables call the method.
        root: The folder.
        open_pair: Opens what it holds for a pair.
        suffixes: Those of videos; none where a folder of frames alone can hold a pair.
        inputs: Nothing of a sample.
    """

    name: str
    root: Path
    open_pair: OpenPair = open_views
    suffixes: tuple[str, ...] = VIDEO_SUFFIXES
    inputs: tuple[str, ...] = ()

    def stamp(self, wanted: PairFrames) -> str:
        """Return the stamp of the files."""
        return stamp_prediction(find_prediction(self.root, wanted, suffixes=self.suffixes))

    @contextmanager
    def open(self, index: SceneIndex) -> Iterator[Read]:
        """Yield a function that reads the files of a scene; each is opened when it is needed."""
        opened: dict[Pair, Callable[[Sample], Any]] = {}
        with ExitStack() as stack:

            def read(wanted: PairFrames, samples: Sequence[Sample]) -> list[Any]:
                if wanted.pair not in opened:
                    path = find_prediction(self.root, wanted, suffixes=self.suffixes)
                    opened[wanted.pair] = stack.enter_context(self.open_pair(path, wanted))
                return [opened[wanted.pair](sample) for sample in samples]

            yield read


Accept = Callable[[torch.Tensor, tuple[int, int, int]], torch.Tensor]
"""Takes what a callable returned, and (n, h, w) of what it was given; returns n answers, or raises
ValueError with what was found and what is expected."""


def accept_views(returned: torch.Tensor, given: tuple[int, int, int]) -> torch.Tensor:
    """Return right views that a callable returned, as uint8."""
    count, height, width = given
    expected = f"uint8, or floats of 0 to 1, {(count, 3, height, width)}"
    if returned.is_floating_point() and returned.numel():
        low, high = float(returned.min()), float(returned.max())
        if not (low >= 0 and high <= 1):
            raise ValueError(f"floats of {low:g} to {high:g}; expected 0 to 1, or uint8")
        precise = returned.to(torch.promote_types(returned.dtype, torch.float32))
        returned = (precise * 255).round().to(torch.uint8)
    if returned.shape != (count, 3, height, width) or returned.dtype != torch.uint8:
        raise ValueError(f"{returned.dtype} {tuple(returned.shape)}; expected {expected}")
    return returned


@dataclass(frozen=True, slots=True)
class CalledMethod:
    """A method that is called with batches of frames.

    Attributes:
        name: What tables call the method.
        method: The callable.
        inputs: Fields of a sample that it is given.
        accept: Checks what it returns.
    """

    name: str
    method: Method
    inputs: tuple[str, ...]
    accept: Accept = accept_views

    def stamp(self, wanted: PairFrames) -> str:
        """Return the name: a change of what a callable computes cannot be seen."""
        return f"called {self.name}"

    @contextmanager
    def open(self, index: SceneIndex) -> Iterator[Read]:
        """Yield a function that calls the method."""
        yield self._read

    def _read(self, wanted: PairFrames, samples: Sequence[Sample]) -> list[Any]:
        """Return what the method answers, frame by frame."""
        given = {
            name: torch.from_numpy(np.stack([np.asarray(each[name]) for each in samples]))
            for name in self.inputs
        }
        answer = self.method(given)
        where = f"{wanted.label}: {self.name}"
        try:
            tensor = torch.as_tensor(answer).detach().cpu()
        except (RuntimeError, TypeError, ValueError) as error:
            raise PredictionError(
                f"{where} returned a {type(answer).__name__} that is not one array ({error})."
            ) from error
        try:
            return list(self.accept(tensor, (len(samples), *wanted.size)).numpy())
        except ValueError as error:
            raise PredictionError(
                f"{where} was given {len(samples)} frames and returned {error}."
            ) from None
