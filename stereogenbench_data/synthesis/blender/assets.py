"""``assets.toml``: the maps, characters, animations and sensors that Blender renders.

The format is in ``docs/generation.md``. Files are named relative to the folder of ``assets.toml``
and stay inside it, links followed. Keys that are not known are refused.
"""

import hashlib
import os
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from operator import lt
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.schema.document import is_number
from stereogenbench_data.synthesis.renderer import Spawn, View

Device = Literal["CPU", "GPU"]
Light = Literal["own", "sky"]
Forward = Literal["-y", "+y", "-x", "+x"]
Repeat = Literal["onward", "back"]

SUFFIXES: Final = (".blend", ".glb", ".gltf", ".fbx")

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class MapAsset:
    """A map.

    Attributes:
        where: What errors call it: the file of assets and the key in it.
        file: Its file, absolute.
        scale: Metres in one unit of the file (for .blend, of the unit that the file states).
        light: "own" for the lamps of the file, "sky" to add a sun and a sky.
        bounds_m: Two corners of the part where cameras may be, in map axes; None for all of it.
        spawn_bounds_m: The same for subjects; None for all of ``bounds_m``.
    """

    where: str
    file: str
    scale: float = 1.0
    light: Light = "own"
    bounds_m: Box | None = None
    spawn_bounds_m: Box | None = None


@dataclass(frozen=True, slots=True)
class CharacterAsset:
    """A mesh with an armature.

    Attributes:
        where: What errors call it.
        file: Its file, absolute.
        scale: Metres in one unit of the file.
        forward: The axis of Blender that it faces.
    """

    where: str
    file: str
    scale: float = 1.0
    forward: Forward = "-y"


@dataclass(frozen=True, slots=True)
class AnimationAsset:
    """A take of a file.

    Attributes:
        where: What errors call it.
        file: Its file, absolute.
        take: The name of the take; None if the file has a single one.
        rate_hz: Its frames a second; None for what the file says.
        repeat: What follows its end. "onward" repeats a take that ends in its first pose, from
            where it led; any other, and all with "back", are played backwards.
    """

    where: str
    file: str
    take: str | None = None
    rate_hz: float | None = None
    repeat: Repeat = "onward"


class Asked(NamedTuple):
    """The folder of the assets, and those of one proposal."""

    root: str
    map: MapAsset
    character: CharacterAsset
    animation: AnimationAsset


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """How Cycles renders.

    Attributes:
        samples_per_pixel: Paths a pixel.
        device: "CPU", or "GPU" where Cycles finds one.
        denoise: Whether Open Image Denoise cleans the pictures.
        threads: Processor threads of each Blender; 0 for all.
    """

    samples_per_pixel: int = 64
    device: Device = "CPU"
    denoise: bool = True
    threads: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """What the process of Blender renders at once.

    Attributes:
        frame: The frame, at 15 Hz.
        spawn: Where the subject started.
        views: The cameras, of one size and focal length.
        seed: The seed of Cycles.
        settings: How Cycles renders.
        folder: Where the pictures go.
    """

    frame: int
    spawn: Spawn
    views: list[View]
    seed: int
    settings: RenderSettings
    folder: Path


@dataclass(frozen=True, slots=True)
class Assets:
    """What an ``assets.toml`` names.

    Attributes:
        path: The file itself.
        sensors_mm: Widths and heights of sensors, sorted by name; empty for the built-in one.
        digest: Of the file and of every file that it names.
    """

    path: Path
    maps: Mapping[str, MapAsset]
    characters: Mapping[str, CharacterAsset]
    animations: Mapping[str, AnimationAsset]
    sensors_mm: tuple[tuple[float, float], ...]
    settings: RenderSettings
    digest: str


def read_assets(path: str | Path) -> Assets:
    """Read an ``assets.toml`` and check it, without Blender.

    Raises:
        SynthesisError: If it does not follow the format, or a file is missing or leaves the folder.
    """
    path = Path(path).absolute()
    try:
        text = path.read_bytes()
        document = tomllib.loads(text.decode())
    except (OSError, UnicodeDecodeError) as error:
        raise SynthesisError(
            f"{path}: cannot be read ({error}). Give the path of an assets.toml by --assets."
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise SynthesisError(f"{path}: is not TOML ({error}). Correct that line.") from error
    _require_known(document, (*_KINDS, "sensors", "render"), place=f"{path}: ")
    found: dict[str, dict[str, Any]] = {}
    for kind, made in _KINDS.items():
        tables = document.get(kind)
        if not (isinstance(tables, dict) and tables):
            raise _refusal(f"{path}: {kind}", tables, f"must have one table, such as [{kind}.Name]")
        found[kind] = {}
        for name, table in tables.items():
            place = f"{path}: {kind}.{name}"
            if not (name.isascii() and name.replace("_", "").isalnum()):
                raise _refusal(place, name, "must be named by letters, digits and underscores")
            values = _values(table, _names(made), place=place)
            file = _existing(path.parent, values.get("file"), place=f"{place}.file")
            where = f"{place}: {file}"
            found[kind][name] = made(**values | {"where": where, "file": str(file)})
    sensors = document.get("sensors", {})
    sizes_mm = _values(sensors, sensors, place=f"{path}: sensors", rule="sensor")
    settings = _values(document.get("render", {}), _names(RenderSettings), place=f"{path}: render")
    digest = hashlib.sha256(text)
    for file in sorted({each.file for assets in found.values() for each in assets.values()}):
        digest.update(os.path.relpath(file, path.parent).encode())
        with Path(file).open("rb") as content:
            digest.update(hashlib.file_digest(content, "sha256").digest())
    return Assets(
        path,
        **found,
        sensors_mm=tuple(sizes_mm[name] for name in sorted(sizes_mm)),
        settings=RenderSettings(**settings),
        digest=digest.hexdigest(),
    )


_KINDS: Final[dict[str, Callable[..., Any]]] = {
    "maps": MapAsset,
    "characters": CharacterAsset,
    "animations": AnimationAsset,
}


def _is_positive(value: Any) -> bool:
    return is_number(value) and value > 0


def _is_size(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_positive, value))


def _is_box(value: Any) -> bool:
    match value:
        case [[_, _, _] as low, [_, _, _] as high]:
            return all(map(is_number, (*low, *high))) and all(map(lt, low, high))
    return False


def _is_file(value: Any) -> bool:
    return isinstance(value, str) and Path(value).suffix.lower() in SUFFIXES


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and value != ""


def _is_choice(kind: Any) -> tuple[Callable[[Any], bool], str]:
    return lambda value: value in get_args(kind), f"must be one of {', '.join(get_args(kind))}"


def _is_whole(least: int) -> tuple[Callable[[Any], bool], str]:
    return (
        lambda value: type(value) is int and value >= least,
        f"must be a whole number of at least {least}",
    )


_NUMBER: Final = (_is_positive, "must be a positive number")
_BOX: Final = (
    _is_box, "must be [[x, y, z], [x, y, z]] in metres of map axes, the smaller corner first"
)  # fmt: skip
_RULES: Final[dict[str, tuple[Callable[[Any], bool], str]]] = {
    "file": (_is_file, f"must name a file ({', '.join(SUFFIXES)})"),
    "scale": _NUMBER,
    "rate_hz": _NUMBER,
    "light": _is_choice(Light),
    "forward": _is_choice(Forward),
    "repeat": _is_choice(Repeat),
    "device": _is_choice(Device),
    "bounds_m": _BOX,
    "spawn_bounds_m": _BOX,
    "take": (_is_text, "must be the name of a take of the file"),
    "sensor": (_is_size, "must be [width, height] in mm, both positive"),
    "samples_per_pixel": _is_whole(1),
    "threads": _is_whole(0),
    "denoise": (lambda value: type(value) is bool, "must be true or false"),
}
"""What the value of a key must fulfil, and the same in words."""


def _names(made: Any) -> list[str]:
    return [field.name for field in fields(made) if field.name != "where"]


def _refusal(place: str, found: object, cure: str) -> SynthesisError:
    return SynthesisError(f"{place}: found {found!r}. It {cure}.")


def _require_known(table: Mapping[str, Any], known: Iterable[str], *, place: str) -> None:
    for key in table:
        if key not in known:
            raise SynthesisError(
                f"{place}{key}: this key is unknown. Choose one of {', '.join(known)}, or remove "
                f"it."
            )


def _values(
    table: Any, known: Iterable[str], *, place: str, rule: str | None = None
) -> dict[str, Any]:
    """Return the values of a table, which fulfil one rule, or that of their key.

    Lists become tuples.
    """
    if not isinstance(table, dict):
        raise _refusal(place, table, "must be a table")
    _require_known(table, known, place=f"{place}.")
    for key, value in table.items():
        is_right, cure = _RULES[rule or key]
        if not is_right(value):
            raise _refusal(f"{place}.{key}", value, cure)
    return {key: _without_lists(value) for key, value in table.items()}


def _without_lists(value: Any) -> Any:
    return tuple(map(_without_lists, value)) if isinstance(value, list) else value


def _existing(root: Path, name: str | None, *, place: str) -> Path:
    """Return the absolute path of a file that exists inside the folder."""
    if name is None:
        raise _refusal(place, name, _RULES["file"][1])
    path = (root.resolve() / name).resolve()
    if not path.is_relative_to(root.resolve()):
        raise _refusal(place, name, f"is outside the folder of this file ({root}). Copy it there")
    if not path.is_file():
        raise _refusal(place, name, f"must exist; there is no file {path}")
    return path
