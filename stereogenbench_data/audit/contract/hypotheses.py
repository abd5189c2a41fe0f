"""The questions that the doctor asks about a depth encoding, and hypotheses that answer them."""

from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args

from stereogenbench_data.schema.records import DepthEncoding, DepthForm, DepthKind
from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS

Flip = Literal["none", "vertical", "horizontal"]
Content = Literal["rgb", "depth"]
Question = Literal["kind", "form", "frame_lag", "order", "flip"]

LAGS: Final = (-3, -2, -1, 0, 1, 2, 3)
_SAME: Final = tuple(range(CAMERA_COUNT))
_KINDS_OF_FILES: Final[dict[str, tuple[Content, ...]]] = {
    "": ("rgb", "depth"), "pictures": ("rgb",), "depth": ("depth",),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Order:
    """The camera of each file of some kinds; every such exchange is its own inverse."""

    cameras: tuple[int, ...] = _SAME
    contents: tuple[Content, ...] = ()
    is_mirrored: bool = False


def _orders() -> dict[str, _Order]:
    """Return every order of cameras under test, by its description."""
    orders = {"as recorded": _Order(), "mirrored": _Order(is_mirrored=True)}
    for words, contents in _KINDS_OF_FILES.items():
        orders[f"{words} reversed".strip()] = _Order(_SAME[::-1], contents)
    for words, contents in _KINDS_OF_FILES.items():
        for pair in CAMERA_PAIRS:
            swapped = dict(zip(pair, pair[::-1], strict=True))
            cameras = tuple(swapped.get(camera, camera) for camera in _SAME)
            subject = f"{words} of cameras" if words else "cameras"
            name = f"{subject} {pair[0]} and {pair[1]} exchanged"
            orders[name] = _Order(cameras, contents)
    return orders


_ORDERS: Final = _orders()
_ANSWERS: Final[dict[Question, tuple[Any, ...]]] = {
    "kind": ("planar", "ray"),
    "form": ("depth", "inverse"),
    "frame_lag": LAGS,
    "order": tuple(_ORDERS),
    "flip": get_args(Flip),
}
QUESTIONS: Final = tuple(_ANSWERS)


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A contract without its lengths: one answer to each question.

    Attributes:
        kind: "planar" or "ray".
        form: "depth" or "inverse".
        frame_lag: RGB frame t shows what depth frame t + frame_lag measured.
        order: The camera of each file. "mirrored": the recorded positions run the other way;
            "exchanged": the files of two cameras are exchanged; "reversed": camera c has the files
            of camera 5 - c. It concerns pictures, depth, or both.
        flip: How stored depth is flipped.
    """

    kind: DepthKind = "planar"
    form: DepthForm = "depth"
    frame_lag: int = 0
    order: str = "as recorded"
    flip: Flip = "none"

    @classmethod
    def declared(cls, encoding: DepthEncoding) -> "Hypothesis":
        """Return the hypothesis of a depth encoding, with pictures and cameras as recorded."""
        return cls(kind=encoding.kind, form=encoding.form, frame_lag=encoding.frame_lag)

    def changed(self, question: Question, answer: Any) -> "Hypothesis":
        """Return the hypothesis with another answer to one question."""
        return replace(self, **{question: answer})

    def changes_from(self, other: "Hypothesis") -> tuple[Question, ...]:
        """Return the questions to which the two give different answers."""
        return tuple(name for name in QUESTIONS if getattr(self, name) != getattr(other, name))

    def alternatives(self, question: Question) -> tuple["Hypothesis", ...]:
        """Return the hypotheses with another answer to one question."""
        return tuple(
            self.changed(question, answer)
            for answer in _ANSWERS[question]
            if answer != getattr(self, question)
        )

    @property
    def is_mirrored(self) -> bool:
        """Whether the recorded positions of the cameras run the other way."""
        return _ORDERS[self.order].is_mirrored

    def camera_of(self, file: int, *, content: Content) -> int:
        """Return the camera of a file by its number."""
        order = _ORDERS[self.order]
        return order.cameras[file] if content in order.contents else file

    def depth_file(self, rgb_file: int) -> int:
        """Return the number of the depth file that belongs to a picture's file."""
        return self.camera_of(self.camera_of(rgb_file, content="rgb"), content="depth")

    def reads_alike(self, other: "Hypothesis", *, left: int, right: int) -> bool:
        """Tell whether both use the same depth and positions for the pictures of two files."""
        mine, theirs = (
            [each.is_mirrored, each.depth_file(left)]
            + [each.camera_of(file, content="rgb") for file in (left, right)]
            for each in (self, other)
        )
        return mine == theirs and self.changed("order", other.order) == other
