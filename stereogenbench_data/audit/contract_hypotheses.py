"""What may be wrong with a depth contract: a table of questions, and what each answer changes."""

from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args

from stereogenbench_data.schema.records import DepthEncoding, DepthForm, DepthKind
from stereogenbench_data.schema.release import CAMERA_COUNT

Flip = Literal["none", "vertical", "horizontal"]
Order = Literal[
    "as recorded",
    "mirrored",
    "primary pair swapped",
    "pictures of the primary pair swapped",
    "depth of the primary pair swapped",
    "reversed",
    "pictures reversed",
    "depth reversed",
]
Question = Literal["kind", "form", "frame_lag", "order", "flip"]

LAGS: Final = (-3, -2, -1, 0, 1, 2, 3)
_ANSWERS: Final[dict[Question, tuple[Any, ...]]] = {
    "kind": ("planar", "ray"),
    "form": ("depth", "inverse"),
    "frame_lag": LAGS,
    "order": get_args(Order),
    "flip": get_args(Flip),
}
QUESTIONS: Final = tuple(_ANSWERS)


@dataclass(frozen=True, slots=True)
class Structure:
    """All of a contract that is not a length: one answer to each question.

    Attributes:
        kind: "planar" or "ray".
        form: "depth" or "inverse".
        frame_lag: RGB frame t shows what depth frame t + frame_lag measured.
        order: Which camera each file is of. "mirrored": the recorded places run the other way;
            "swapped": files of the primary pair's two cameras are exchanged; "reversed": files
            of camera c are those of camera 5 - c. Of pictures, of depth, or of both.
        flip: How stored depth is turned over.
    """

    kind: DepthKind = "planar"
    form: DepthForm = "depth"
    frame_lag: int = 0
    order: Order = "as recorded"
    flip: Flip = "none"

    @classmethod
    def declared(cls, encoding: DepthEncoding) -> "Structure":
        """Return what a depth contract says, pictures and cameras as they are recorded."""
        return cls(kind=encoding.kind, form=encoding.form, frame_lag=encoding.frame_lag)

    def changed(self, question: Question, answer: Any) -> "Structure":
        """Return the structure with another answer to one question."""
        return replace(self, **{question: answer})

    def changes_from(self, other: "Structure") -> tuple[Question, ...]:
        """Return the questions to which the two give different answers."""
        return tuple(name for name in QUESTIONS if getattr(self, name) != getattr(other, name))

    def alternatives(self, question: Question) -> tuple["Structure", ...]:
        """Return the structures that differ from this one in the answer to one question."""
        return tuple(
            self.changed(question, answer)
            for answer in _ANSWERS[question]
            if answer != getattr(self, question)
        )

    def camera_of(
        self, file: int, *, content: Literal["rgb", "depth"], primary: tuple[int, int]
    ) -> int:
        """Return the camera that a numbered file is of."""
        other = "depth" if content == "rgb" else "pictures"
        if self.order in ("as recorded", "mirrored") or self.order.startswith(other):
            return file
        if self.order.endswith("reversed"):
            return CAMERA_COUNT - 1 - file
        exchanged = {primary[0]: primary[1], primary[1]: primary[0]}
        return exchanged.get(file, file)

    def depth_file(self, rgb_file: int, *, primary: tuple[int, int]) -> int:
        """Return the number of the depth file that belongs to a numbered picture."""
        camera = self.camera_of(rgb_file, content="rgb", primary=primary)
        # Every exchange is its own inverse.
        return self.camera_of(camera, content="depth", primary=primary)
