"""Options that select samples: scenes, pairs, frames and the size of pictures."""

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from stereogenbench_data.cli.help import SCENES
from stereogenbench_data.cli.options import SceneOptions, complete_from, pair_of

PairsOption = Annotated[
    str,
    typer.Option(help="primary, adjacent, all, or such as 0-1,0-5.", rich_help_panel=SCENES),
]
FramesOption = Annotated[
    str,
    typer.Option(help="all, first, every:K, or such as 0,40,80.", rich_help_panel=SCENES),
]
BaselineOption = Annotated[
    tuple[float, float] | None,
    typer.Option(help="Baselines, such as 10 60.", rich_help_panel=SCENES),
]


@dataclass(frozen=True, kw_only=True)
class SampleSelectionOptions(SceneOptions):
    """Which pairs and frames of which scenes a command takes."""

    pairs: PairsOption = "primary"
    frames: FramesOption = "all"
    baseline_cm: BaselineOption = None

    def selection(self) -> dict[str, Any]:
        """Return the options of `StereoPairs` that select samples.

        Raises:
            typer.BadParameter: If the text of the pairs or of the frames cannot be parsed.
        """
        baseline = {} if self.baseline_cm is None else {"baseline_cm": self.baseline_cm}
        return self.filters() | baseline | {"pairs": pairs_option(self.pairs)} | self.windows()

    def windows(self) -> dict[str, Any]:
        """Return the option of `StereoPairs` that selects frames.

        Raises:
            typer.BadParameter: If the text of the frames cannot be parsed.
        """
        return {"frames": frames_option(self.frames)}


@dataclass(frozen=True, kw_only=True)
class ExportedSceneOptions(SceneOptions):
    """Which scenes are exported for training: those of the eval split only if it is named."""

    split: Annotated[
        str | None,
        typer.Option(
            help="train; eval only if you say so [train].",
            rich_help_panel=SCENES,
            autocompletion=complete_from(("train", "eval")),
        ),
    ] = None


def pairs_option(text: str) -> Any:
    """Return the pairs of ``--pairs`` as `StereoPairs` takes them."""
    if text in ("primary", "adjacent", "all"):
        return text
    bare = text.strip("() ").replace(" ", "")
    one = bare.replace(",", "-") if bare.replace(",", "", 1).isdecimal() else bare
    pairs = [each.split("-") for each in one.split(",")]
    if not all(len(pair) == 2 and all(map(str.isdecimal, pair)) for pair in pairs):
        raise typer.BadParameter(
            f"{text!r} is not primary, adjacent, all or pairs such as 0-1,0-5.",
            param_hint="--pairs",
        )
    return [pair_of("-".join(pair), option="--pairs") for pair in pairs]


def frames_option(text: str) -> Any:
    """Return the frames of ``--frames`` as `StereoPairs` takes them."""
    if text in ("all", "first"):
        return text
    every, _, step = text.partition(":")
    if every == "every" and step.isdecimal():
        return ("every", int(step))
    if all(map(str.isdecimal, text.split(","))):
        return [int(number) for number in text.split(",")]
    raise typer.BadParameter(
        f"{text!r} is not all, first, every:K or numbers such as 0,40,80.", param_hint="--frames"
    )


def parse_picture_size(text: str) -> tuple[int, int]:
    """Return (height, width) of ``--size``, which is WIDTHxHEIGHT."""
    from stereogenbench_data.errors import FieldError
    from stereogenbench_data.samples.size import parse_size

    try:
        return parse_size(text)
    except FieldError as error:
        raise typer.BadParameter(str(error), param_hint="--size") from None
