"""Options that several commands share, single and in groups, each declared once.

A group is a dataclass whose fields are options. A command takes it as one parameter; `grouped`
shows typer the fields in its place.
"""

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from stereogenbench_data.cli.data import open_data
from stereogenbench_data.cli.help import RARE, SCENES
from stereogenbench_data.schema.release import (
    CAMERA_PAIRS,
    FAMILIES,
    TRAIN_MAPS,
    UNSEEN_MAPS,
    Split,
    Subset,
)

if TYPE_CHECKING:
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.schema.records import DepthEncoding, SceneId


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that has, for typer, one option for each field of its groups.

    Args:
        command: A function. Each parameter whose type is a dataclass is a group of options.
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

    required, keyword_only = inspect.Parameter.empty, inspect.Parameter.KEYWORD_ONLY
    options: list[inspect.Parameter] = []
    for name, parameter in parameters.items():
        if name not in groups:
            options.append(parameter.replace(kind=keyword_only))
            continue
        for field in fields(groups[name]):
            default = required if field.default is MISSING else field.default
            options.append(
                inspect.Parameter(field.name, keyword_only, default=default, annotation=field.type)
            )
    described: Any = called
    described.__signature__ = inspect.Signature(options)
    called.__annotations__ = {option.name: option.annotation for option in options}
    return called


def complete_from(values: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a function for shell completion that lists the values with the typed beginning."""
    known = sorted(values)
    return lambda incomplete: [
        value for value in known if value.lower().startswith(incomplete.lower())
    ]


def complete_scene(context: typer.Context, incomplete: str) -> list[str]:
    """Return the keys of scenes with the typed beginning, if DATA has an index."""
    from stereogenbench_data.errors import StereoGenBenchError
    from stereogenbench_data.index.parquet import INDEX_NAME
    from stereogenbench_data.index.table import SceneIndex

    # While an option lacks its value, typer has parsed the arguments but not assigned them.
    data = Path(str(context.params.get("data") or next(iter(context.args), "")))
    if not (data.is_file() or (data / INDEX_NAME).is_file()):
        return []
    try:
        keys = SceneIndex.open(data).column("key")
    except StereoGenBenchError:
        return []
    return complete_from(map(str, keys))(incomplete)


def pair_of(text: str, *, option: str) -> tuple[int, int]:
    """Return the two cameras of a pair such as 0-5.

    Raises:
        typer.BadParameter: If they are not two cameras, the left one first.
    """
    left, _, right = text.replace(",", "-").partition("-")
    if not (left.strip().isdecimal() and right.strip().isdecimal()):
        raise typer.BadParameter(
            f"{text!r} is not a pair: write two cameras, such as 0-5.", param_hint=option
        )
    pair = int(left), int(right)
    if pair not in CAMERA_PAIRS:
        swapped = pair[1], pair[0]
        cure = f"write it as {right}-{left}" if swapped in CAMERA_PAIRS else "such as 0-5"
        raise typer.BadParameter(
            f"{text!r} is not a pair: two different cameras from 0 to 5, the left one first; "
            f"{cure}.",
            param_hint=option,
        )
    return pair


def depth_of(
    index: "SceneIndex", *, accept: list[str] | None = None, **options: Any
) -> "DepthEncoding | None":
    """Return the depth contract of a command's options; None without any: data state their own.

    What no option says is as the conventions of the data state it.

    Raises:
        typer.BadParameter: If these state several contracts.
    """
    from stereogenbench_data.schema.records import DepthEncoding

    given = {name: value for name, value in options.items() if value is not None}
    if accept:
        given["accept"] = frozenset(accept)
    if not given:
        return None
    stated = {shape.depth.encoding for shape in index.shapes if shape.depth is not None}
    if len(stated) > 1:
        raise typer.BadParameter(
            f"the conventions of {index.where} state {len(stated)} depth contracts, and options "
            f"would replace all: choose scenes of one, or edit the conventions."
        )
    return replace(stated.pop() if stated else DepthEncoding(), **given, source="user")


RootOption = Annotated[
    str | None,
    typer.Option(
        "--root",
        help="Where the data of an index file are, if not beside.",
        rich_help_panel=RARE,
    ),
]
ConventionsOption = Annotated[
    Path | None,
    typer.Option(
        "--conventions",
        metavar="FILE",
        help="How the files are read, as `conventions` writes it.",
        rich_help_panel=RARE,
    ),
]
SplitOption = Annotated[
    str | None,
    typer.Option(
        help="train or eval.",
        autocompletion=complete_from(get_args(Split)),
        rich_help_panel=SCENES,
    ),
]
FamilyOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Family of baselines. May be repeated.",
        autocompletion=complete_from(FAMILIES),
        rich_help_panel=SCENES,
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        metavar="MAP",
        help="Map, such as Stylized_Egypt. May be repeated.",
        autocompletion=complete_from(TRAIN_MAPS | UNSEEN_MAPS),
        rich_help_panel=SCENES,
    ),
]
DepthUnitOption = Annotated[
    float | None,
    typer.Option(
        help="Metres in a stored unit of depth [as files state].",
        rich_help_panel=RARE,
    ),
]
AcceptOption = Annotated[
    list[str] | None,
    typer.Option(
        "--accept",
        metavar="LOSS",
        help="Accept depth that is 8-bit ... 14-bit, lossy, chroma.",
        rich_help_panel=RARE,
        autocompletion=complete_from(
            ("8-bit", "9-bit", "10-bit", "12-bit", "14-bit", "lossy", "chroma")
        ),
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Report as JSON on stdout.")]
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Processes [one a core].")]
EngineOption = Annotated[
    str,
    typer.Option(
        help="local, ray, or ray://HOST:PORT.",
        autocompletion=complete_from(("local", "ray")),
        rich_help_panel=RARE,
    ),
]
OutOption = Annotated[Path | None, typer.Option("--out", "-o", help="File to write.")]


def out_folder(text: str) -> Path:
    """Return the folder that a command writes, as it was typed; not the one of an empty text."""
    if not text:
        raise typer.BadParameter("the path is empty: name a folder, or . for this one.")
    return Path(text)


def wanted_scenes(
    split: str | None, families: list[str], maps: list[str]
) -> "Callable[[SceneId], bool] | None":
    """Return a function that says whether the options select a scene; None if they select all."""
    if not (split or families or maps):
        return None
    return lambda scene: (
        split in (None, "", scene.split)
        and (not families or scene.family in families)
        and (not maps or scene.map_name in maps)
    )


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """The data that a command reads."""

    data: Annotated[
        str,
        typer.Argument(help="Folder of scenes or shards, an index file, or a URL."),
    ]
    data_root: RootOption = None
    conventions: ConventionsOption = None

    def open(self) -> "SceneIndex":
        """Return the index of the data as `open_data` does."""
        return open_data(self.data, root=self.data_root, conventions=self.conventions)


@dataclass(frozen=True, kw_only=True)
class ShardsOptions:
    """The shards that a command reads."""

    shards: Annotated[str, typer.Argument(help="Folder of shards, or its index file.")]
    data_root: RootOption = None


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Which scenes of the data a command takes."""

    split: SplitOption = None
    subset: Annotated[
        str | None,
        typer.Option(
            help="Of eval scenes: seen_map or unseen_map.",
            autocompletion=complete_from(get_args(Subset)),
            rich_help_panel=SCENES,
        ),
    ] = None
    family: FamilyOption = None
    map_name: MapOption = None
    scene: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY",
            help="Key of a scene. May be repeated.",
            autocompletion=complete_scene,
            rich_help_panel=SCENES,
        ),
    ] = None
    focal_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Focal lengths, such as 18 35.", rich_help_panel=SCENES),
    ] = None
    min_frames: Annotated[
        int | None,
        typer.Option(min=1, help="Fewest frames of a scene.", rich_help_panel=SCENES),
    ] = None
    caption: Annotated[
        str | None,
        typer.Option(
            metavar="WORDS",
            help="Words that must all be in the caption.",
            rich_help_panel=SCENES,
        ),
    ] = None

    def filters(self) -> dict[str, Any]:
        """Return the filters that were given, by their names in `SceneFilters`."""
        options = {
            "split": self.split,
            "subset": self.subset,
            "family": self.family,
            "map": self.map_name,
            "scenes": self.scene,
            "focal_mm": self.focal_mm,
            "min_frames": self.min_frames,
            "caption": self.caption,
        }
        return {name: value for name, value in options.items() if value not in (None, [], ())}


@dataclass(frozen=True, kw_only=True)
class ShareOptions:
    """How much of the chosen scenes a command takes."""

    scenes: Annotated[
        int | None,
        typer.Option(
            min=1, help="So many scenes, of all families and maps alike.", rich_help_panel=SCENES
        ),
    ] = None
    max_bytes: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE",
            help="As many scenes as fit, such as 10GB, of all families and maps alike.",
            rich_help_panel=SCENES,
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
            ShardError: If the size is none.
            SelectionError: If there are fewer scenes, or none fits.
        """
        from stereogenbench_data.selection.share import balanced_share
        from stereogenbench_data.shards.plan import parse_bytes

        limit = None if self.max_bytes is None else parse_bytes(self.max_bytes)
        chosen = balanced_share(index, rows, sizes_bytes, scenes=self.scenes, max_bytes=limit)
        return [int(row) for row in chosen]


@dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """How many processes do the work of a command, and where."""

    workers: WorkersOption = None
    engine: EngineOption = "local"

    def options(self, *, device: str = "cpu") -> dict[str, Any]:
        """Return ``workers`` and ``engine`` as the functions that do batch work take them.

        Args:
            device: Where tasks compute; on Ray each has its own GPU unless it is "cpu".

        Raises:
            StorageError: If there is no engine of that name.
        """
        from stereogenbench_data.engine import engine_of

        return {"workers": self.workers, "engine": engine_of(self.engine, device=device)}
