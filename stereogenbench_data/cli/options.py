"""Options that several commands share, in groups, each declared once, and how their texts are read.

A group is a dataclass whose fields are options. A command takes it as one parameter; `grouped`
shows typer the fields in its place.
"""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from stereogenbench_data.cli.data import open_data
from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS

if TYPE_CHECKING:
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.schema.conventions import Conventions
    from stereogenbench_data.schema.records import SceneId

SCENES: Final = "Which scenes"
"""Panel of the help for the options that select scenes, pairs and frames."""

_RANGES: Final = ("focal_mm", "valid_depth_ratio", "baseline_cm")
"""Filters of ``--where`` that take two numbers."""
_OF_PATH: Final = ("split", "family", "map", "scenes")
"""Filters that the path of a scene answers."""


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that has, for typer, one option for each field of its groups.

    Args:
        command: A function. Each parameter whose type is a dataclass is a group of options, which
            are keyword-only.
    """
    parameters = inspect.signature(command).parameters
    groups: dict[str, Any] = {
        name: each.annotation for name, each in parameters.items() if is_dataclass(each.annotation)
    }

    @wraps(command)
    def called(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
        command(**values)

    options: list[inspect.Parameter] = []
    for name, parameter in parameters.items():
        if name in groups:
            options += inspect.signature(groups[name]).parameters.values()
        else:
            options.append(parameter.replace(kind=parameter.KEYWORD_ONLY))
    described: Any = called
    described.__signature__ = inspect.Signature(options)
    called.__annotations__ = {option.name: option.annotation for option in options}
    return called


def option(*words: str, panel: str | None = None, **settings: Any) -> Any:
    """Return an option of a command.

    Args:
        *words: Its names, if they are not those of the parameter, then the text of its help.
        panel: Panel of the help.
        **settings: Of ``typer.Option``.
    """
    *names, text = words
    return typer.Option(*names, help=text, rich_help_panel=panel, **settings)


def flag(name: str, text: str) -> Any:
    """Return an option that takes no value; newer typer shows the type ``<bool>`` for such."""
    return option(name, text, metavar="")


def out_folder(text: str) -> Path:
    """Return the folder that a command writes, as it was typed; not the one of an empty text."""
    if not text:
        raise typer.BadParameter("the path is empty: name a folder, or . for this one.")
    return Path(text)


def size_of(text: str) -> tuple[int, int]:
    """Return (height, width) of a size, which is WIDTHxHEIGHT, or N of a square."""
    from stereogenbench_data.errors import FieldError
    from stereogenbench_data.samples.fields import require_size

    try:
        return require_size(f"{text}x{text}" if text.isdecimal() else text)
    except FieldError as error:
        raise typer.BadParameter(str(error)) from None


def cameras_of(text: str) -> tuple[int, ...]:
    """Return the numbers of cameras such as 0,2,5, ascending."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) < CAMERA_COUNT for part in parts):
        raise typer.BadParameter(f"{text!r}: write numbers from 0 to 5, such as 0,1.")
    return tuple(sorted({int(part) for part in parts}))


def pair_of(text: str) -> tuple[int, int]:
    """Return the two cameras of a pair such as 0-5, the left one first."""
    left, _, right = text.partition("-")
    if not (left.strip().isdecimal() and right.strip().isdecimal()):
        raise typer.BadParameter(f"{text!r} is not a pair: write two cameras, such as 0-5.")
    pair = int(left), int(right)
    if pair not in CAMERA_PAIRS:
        cure = f"write it as {right}-{left}" if pair[::-1] in CAMERA_PAIRS else "such as 0-5"
        raise typer.BadParameter(
            f"{text!r} is not a pair: two different cameras from 0 to 5, the left one first; "
            f"{cure}."
        )
    return pair


def pairs_of(text: str) -> Any:
    """Return pairs as `StereoPairs` takes them."""
    if text in ("primary", "adjacent", "all"):
        return text
    if "-" not in text:
        raise typer.BadParameter(
            f"{text!r} is not primary, adjacent, all or pairs such as 0-1,0-5."
        )
    return [pair_of(each) for each in text.split(",")]


def frames_of(text: str) -> Any:
    """Return frames as `StereoPairs` takes them."""
    if text in ("all", "first"):
        return text
    kind, _, number = text.partition(":")
    if kind in ("every", "random", "clips") and number.isdecimal():
        return kind, int(number)
    if all(map(str.isdecimal, text.split(","))):
        return [int(number) for number in text.split(",")]
    raise typer.BadParameter(
        f"{text!r} is not all, first, every:K, random:N, clips:LENGTH or numbers such as 0,40,80."
    )


def filter_of(text: str) -> tuple[str, Any]:
    """Return the name and the value of a filter such as family=Uniform; texts in a list."""
    name, _, value = text.partition("=")
    low, _, high = value.partition(":")
    if not value:
        raise typer.BadParameter(f"{text!r}: write NAME=VALUE, such as family=Uniform.")
    try:
        if name in _RANGES:
            return name, (float(low), float(high or low))
        if name == "min_frames":
            return name, int(value)
    except ValueError:
        cure = "LOW:HIGH, such as focal_mm=18:35" if name in _RANGES else "a whole number"
        raise typer.BadParameter(f"{text!r}: write {cure}.") from None
    return ("scenes" if name == "scene" else name), value if name == "caption" else [value]


def _refuse_two(name: str, *values: Any) -> None:
    """Refuse several values of a filter that takes one."""
    shown = (
        ":".join(f"{end:g}" for end in each) if isinstance(each, tuple) else str(each)
        for each in values
    )
    raise typer.BadParameter(
        f"{name} is given more than once ({', '.join(shown)}): give it one value.",
        param_hint="--where",
    )


def part_of(text: str) -> tuple[int, int]:
    """Return (number, count) of a part such as 1/4."""
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise typer.BadParameter(
            f"{text!r} is not a part: write I/N with I from 1 to N, such as 1/4 to 4/4."
        )
    return int(number), int(count)


SizeOption = Annotated[
    Any,
    option(
        "--size",
        "Width x height, such as 832x480; N is NxN [as stored].",
        parser=size_of,
        metavar="WxH",
    ),
]
SplitOption = Annotated[
    str | None, option("The split [all; to export: train].", metavar="train|eval|all", panel=SCENES)
]
FramesOption = Annotated[
    Any,
    option(
        "all, first, every:K, or such as 0,40,80.", parser=frames_of, metavar="FRAMES", panel=SCENES
    ),
]
CamerasOption = Annotated[
    Any,
    option("--cameras", "Such as 0,1 [all that a scene has].", parser=cameras_of, metavar="N,N"),
]
PartOption = Annotated[
    Any,
    option("--part", "The I-th of N parts, one for each machine.", parser=part_of, metavar="I/N"),
]
ShardsArgument = Annotated[str, typer.Argument(help="Folder of shards, or its index file.")]
JsonOption = Annotated[bool, flag("--json", "Report as JSON on stdout.")]
OutOption = Annotated[Path | None, option("--out", "-o", "File to write.")]
OutArgument = Annotated[Path, typer.Argument(parser=out_folder, help="Folder to write into.")]
RootArgument = Annotated[str, typer.Argument(help="Folder that holds train/ or eval/, or its URL.")]
ConventionsOption = Annotated[
    Path | None,
    option(
        "--conventions",
        "How files are read and what depth means, as `conventions` writes it.",
        metavar="FILE",
    ),
]


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """The data whose index a command reads."""

    data: Annotated[str, typer.Argument(help="Folder of scenes or shards, an index file, or URL.")]
    data_root: Annotated[
        str | None, option("--root", "Where the data of an index file are, if not beside.")
    ] = None
    conventions: ConventionsOption = None

    def stated(self) -> "Conventions | None":
        """Return the conventions."""
        from stereogenbench_data.schema.conventions import Conventions

        return None if self.conventions is None else Conventions.read(self.conventions)

    def open(self) -> "SceneIndex":
        """Return the index of the data as `open_data` does."""
        return open_data(self.data, root=self.data_root, conventions=self.stated())


@dataclass(frozen=True, kw_only=True)
class DataOptions(SourceOptions):
    """The data whose videos a command decodes."""

    accept: Annotated[
        list[str] | None,
        option("Accept depth that is 8-bit ... 14-bit, lossy, chroma.", metavar="LOSS"),
    ] = None

    def stated(self) -> "Conventions | None":
        """Return the conventions, with the losses of depth that are accepted."""
        from stereogenbench_data.schema.conventions import Conventions
        from stereogenbench_data.schema.declaration import Declaration, DepthAs
        from stereogenbench_data.schema.records import DepthEncoding

        accepted: Any = {*(self.accept or ())}
        stated = super().stated()
        if not accepted:
            return stated
        shapes = []
        for shape in (Declaration(),) if stated is None else stated.shapes:
            depth = shape.depth or DepthAs(encoding=DepthEncoding())
            accept = depth.encoding.accept | accepted
            depth = replace(depth, encoding=replace(depth.encoding, accept=accept))
            shapes.append(replace(shape, depth=depth))
        return Conventions(tuple(shapes), "--accept" if stated is None else stated.where)


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Which scenes of the data a command takes."""

    split: SplitOption = None
    where: Annotated[
        list[Any] | None,
        option(
            "Such as scene=KEY (or a part of it), family=Uniform, map=Stylized_Egypt, "
            "subset=unseen_map, focal_mm=18:35, min_frames=60, caption=WORDS. May be repeated.",
            parser=filter_of,
            metavar="NAME=VALUE",
            panel=SCENES,
        ),
    ] = None

    def filters(self) -> dict[str, Any]:
        """Return the filters that were given, by their names in `SceneFilters`.

        Raises:
            typer.BadParameter: If a filter that takes one value is given several.
        """
        filters: dict[str, Any] = {}
        for name, value in self.where or []:
            if isinstance(value, list):
                value = [*filters.get(name, ()), *value]
            elif name in filters:
                _refuse_two(name, filters[name], value)
            filters[name] = value
        if "split" in filters and self.split != type(self).split:
            _refuse_two("split", self.split, *filters["split"])
        return filters if self.split in (None, "all") else {"split": self.split} | filters

    def by_path(self) -> "Callable[[SceneId], bool] | None":
        """Return whether a scene's path passes the filters; None if all pass.

        Raises:
            typer.BadParameter: If the path does not answer one of the filters.
        """
        from stereogenbench_data.selection.filters import may_pass

        filters = self.filters()
        for name in filters.keys() - {*_OF_PATH}:
            raise typer.BadParameter(
                f"{name}: the path of a scene does not tell it; filter by family or map.",
                param_hint="--where",
            )
        return may_pass(filters)


@dataclass(frozen=True, kw_only=True)
class ExportedOptions(SceneOptions):
    """Which scenes an export takes: of the train split unless another, or all, is named."""

    def filters(self) -> dict[str, Any]:
        """Return the filters that were given, as exports take them."""
        filters = super().filters()
        return filters | {"split": "all"} if self.split == "all" else filters


PairsOption = Annotated[
    Any,
    option(
        "primary, adjacent, all, or such as 0-1,0-5; by length --where baseline_cm=10:60.",
        parser=pairs_of,
        metavar="PAIRS",
        panel=SCENES,
    ),
]


@dataclass(frozen=True, kw_only=True)
class SampleOptions(SceneOptions):
    """Which pairs and frames of which scenes a command takes."""

    pairs: PairsOption = "primary"
    frames: FramesOption = "all"

    def selection(self) -> dict[str, Any]:
        """Return the options of `StereoPairs` that select samples."""
        return self.filters() | {"pairs": self.pairs, "frames": self.frames}


@dataclass(frozen=True, kw_only=True)
class ShareOptions:
    """How much of the chosen scenes a command takes."""

    scenes: Annotated[
        int | None, option("So many scenes, of all families and maps alike.", min=1, panel=SCENES)
    ] = None
    max_bytes: Annotated[
        str | None,
        option(
            "As many scenes as fit, such as 10GB, of all families and maps alike.",
            metavar="SIZE",
            panel=SCENES,
        ),
    ] = None

    @property
    def is_given(self) -> bool:
        """Whether not all scenes are taken."""
        return self.scenes is not None or self.max_bytes is not None

    def rows(
        self, index: "SceneIndex", rows: Sequence[int], sizes_bytes: Sequence[int]
    ) -> list[int]:
        """Return the rows to take of some scenes, given how many bytes each takes.

        Raises:
            ShardError: If the size cannot be parsed.
            SelectionError: If there are fewer scenes, or none fits.
        """
        from stereogenbench_data.selection.plan import balanced_share
        from stereogenbench_data.shards.plan import parse_bytes

        limit = None if self.max_bytes is None else parse_bytes(self.max_bytes)
        chosen = balanced_share(index, rows, sizes_bytes, scenes=self.scenes, max_bytes=limit)
        return [int(row) for row in chosen]


@dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """How many processes do the work of a command, and where."""

    workers: Annotated[
        str | None,
        option("Processes, or a Ray cluster [one a core].", metavar="N|ray|ray://HOST:PORT"),
    ] = None

    def options(self, *, device: str = "cpu") -> dict[str, Any]:
        """Return ``workers`` and ``engine`` as the functions that do batch work take them.

        Args:
            device: Where tasks compute; on Ray each has its own GPU unless it is "cpu".

        Raises:
            StorageError: If there is no engine of that name.
        """
        from stereogenbench_data.engine import LOCAL, engine_of

        if self.workers is None or self.workers.isdecimal():
            return {"workers": int(self.workers) if self.workers else None, "engine": LOCAL}
        return {"workers": None, "engine": engine_of(self.workers, device=device)}
