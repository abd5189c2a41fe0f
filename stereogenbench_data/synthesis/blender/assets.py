"""``assets.toml``: the maps, characters, animations and sensors that Blender renders.

The format is in ``docs/generation.md``. Files are named relative to the folder of ``assets.toml``
and stay inside it, links followed. Keys that are not known are refused.
"""

import hashlib
import json
import os
import struct
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, NoReturn, TypeGuard, get_args
from urllib.parse import unquote

from stereogenbench_data.errors import SynthesisError

Device = Literal["CPU", "GPU"]
Light = Literal["own", "sky"]
Forward = Literal["-y", "+y", "-x", "+x"]
Repeat = Literal["onward", "back"]

SUFFIXES: Final = (".blend", ".glb", ".gltf", ".fbx")
_NO_FILE: Final = f"must name a file ({', '.join(SUFFIXES)})"
_GLB_MAGIC: Final = b"glTF"

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class MapAsset:
    """A map.

    Attributes:
        file: Its file, absolute.
        scale: Metres in one unit of the file (for .blend, of the unit that the file states).
        light: "own" for the lamps of the file, "sky" to add a sun and a sky.
        bounds_m: Two corners of the part where cameras may be, in map axes; None for all of it.
        spawn_bounds_m: The same for subjects; None for all of ``bounds_m``.
    """

    file: str
    scale: float = 1.0
    light: Light = "own"
    bounds_m: Box | None = None
    spawn_bounds_m: Box | None = None


@dataclass(frozen=True, slots=True)
class CharacterAsset:
    """A mesh with an armature.

    Attributes:
        file: Its file, absolute.
        scale: Metres in one unit of the file.
        forward: The axis of Blender that it faces.
    """

    file: str
    scale: float = 1.0
    forward: Forward = "-y"


@dataclass(frozen=True, slots=True)
class AnimationAsset:
    """A take of a file.

    Attributes:
        file: Its file, absolute.
        take: The name of the take; None if the file has a single one.
        rate_hz: Its frames a second; None for what the file says.
        repeat: What follows its end. "onward" repeats a take that ends in its first pose, from
            where it led; any other, and all with "back", are played backwards.
    """

    file: str
    take: str | None = None
    rate_hz: float | None = None
    repeat: Repeat = "onward"


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

    @property
    def root(self) -> Path:
        """The asset folder."""
        return self.path.parent


def read_assets(path: str | Path) -> Assets:
    """Read an ``assets.toml`` and check it, and the references of its glTF files, without Blender.

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
    reader = _Reader(path)
    reader.require_known(document, (*_ASSETS, "sensors", "render"), place="")
    found: dict[str, dict[str, Any]] = {
        kind: {
            name: made(**reader.asset(table, rules, place=f"{kind}.{name}"))
            for name, table in reader.entries(document, kind).items()
        }
        for kind, (made, rules) in _ASSETS.items()
    }
    sensors = reader.table(document.get("sensors", {}), place="sensors")
    sizes_mm = reader.values(sensors, dict.fromkeys(sensors, _size), place="sensors")
    settings = reader.table(document.get("render", {}), place="render")
    digest = hashlib.sha256(text)
    for file in sorted({each.file for assets in found.values() for each in assets.values()}):
        digest.update(os.path.relpath(file, path.parent).encode() + _digest_of(Path(file)))
    return Assets(
        path,
        **found,
        sensors_mm=tuple(sizes_mm[name] for name in sorted(sizes_mm)),
        settings=RenderSettings(**reader.values(settings, _RENDER, place="render")),
        digest=digest.hexdigest(),
    )


# Each rule returns a value as it is used, or raises ValueError with what it must be.


def _positive(value: object) -> float:
    if not _is_positive(value):
        raise ValueError("must be a positive number")
    return float(value)


def _size(value: object) -> tuple[float, float]:
    if not (isinstance(value, list) and len(value) == 2 and all(map(_is_positive, value))):
        raise ValueError("must be [width, height] in mm, both positive")
    return float(value[0]), float(value[1])


def _box(value: Any) -> Box:
    match value:
        case [[x, y, z], [far_x, far_y, far_z]]:
            numbers = (x, y, z, far_x, far_y, far_z)
            if all(map(_is_number, numbers)) and x < far_x and y < far_y and z < far_z:
                return (float(x), float(y), float(z)), (float(far_x), float(far_y), float(far_z))
    raise ValueError(
        "must be [[x, y, z], [x, y, z]] in metres of map axes, the smaller corner first"
    )


def _file_name(value: object) -> str:
    if not (isinstance(value, str) and value):
        raise ValueError(_NO_FILE)
    if Path(value).suffix.lower() not in SUFFIXES:
        raise ValueError(f"must end in {', '.join(SUFFIXES)}; convert it with Blender")
    return value


def _text(value: object) -> str:
    if not (isinstance(value, str) and value):
        raise ValueError("must be the name of a take of the file")
    return value


def _truth(value: object) -> bool:
    if value is True or value is False:
        return value
    raise ValueError("must be true or false")


def _whole(value: object, *, low: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < low:
        raise ValueError(f"must be a whole number of at least {low}")
    return value


def _choice(value: object, *, among: tuple[str, ...]) -> object:
    if value not in among:
        raise ValueError(f"must be one of {', '.join(among)}")
    return value


_Rules = Mapping[str, Callable[[Any], Any]]

_ASSETS: Final[dict[str, tuple[Callable[..., Any], _Rules]]] = {
    "maps": (
        MapAsset,
        {
            "file": _file_name,
            "scale": _positive,
            "light": partial(_choice, among=get_args(Light)),
            "bounds_m": _box,
            "spawn_bounds_m": _box,
        },
    ),
    "characters": (
        CharacterAsset,
        {
            "file": _file_name,
            "scale": _positive,
            "forward": partial(_choice, among=get_args(Forward)),
        },
    ),
    "animations": (
        AnimationAsset,
        {
            "file": _file_name,
            "take": _text,
            "rate_hz": _positive,
            "repeat": partial(_choice, among=get_args(Repeat)),
        },
    ),
}
_RENDER: Final[_Rules] = {
    "samples_per_pixel": partial(_whole, low=1),
    "device": partial(_choice, among=get_args(Device)),
    "denoise": _truth,
    "threads": partial(_whole, low=0),
}


class _Reader:
    """Takes values out of the document; every refusal names the file, the key and the value."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._root = path.parent.resolve()

    def refuse(self, place: str, found: object, cure: str) -> NoReturn:
        """Raise the error of one value."""
        raise SynthesisError(f"{self._path}: {place}: found {found!r}. It {cure}.")

    def require_known(self, table: Mapping[str, Any], known: Iterable[str], *, place: str) -> None:
        """Refuse keys that mean nothing, such as a misspelt one."""
        for key in table:
            if key not in known:
                where = f"{place}.{key}" if place else key
                raise SynthesisError(
                    f"{self._path}: {where}: this key is unknown. Choose one of "
                    f"{', '.join(known)}, or remove it."
                )

    def table(self, found: object, *, place: str) -> dict[str, Any]:
        """Return a table."""
        if not isinstance(found, dict):
            self.refuse(place, found, f"must be a table, [{place}]")
        return found

    def entries(self, document: Mapping[str, Any], kind: str) -> dict[str, dict[str, Any]]:
        """Return the tables of a kind by name; there must be one at least."""
        found = self.table(document.get(kind, {}), place=kind)
        if not found:
            self.refuse(kind, found, f"must have one table at least, such as [{kind}.Name]")
        for name in found:
            if not (name.isascii() and name.replace("_", "").isalnum()):
                self.refuse(
                    f"{kind}.{name}", name, "must be named by letters, digits and underscores"
                )
        return {name: self.table(each, place=f"{kind}.{name}") for name, each in found.items()}

    def values(self, table: Mapping[str, Any], rules: _Rules, *, place: str) -> dict[str, Any]:
        """Return the values of a table that has only keys with a rule, in their types."""
        self.require_known(table, rules, place=place)
        values = {}
        for key, value in table.items():
            try:
                values[key] = rules[key](value)
            except ValueError as error:
                self.refuse(f"{place}.{key}", value, str(error))
        return values

    def asset(self, table: Mapping[str, Any], rules: _Rules, *, place: str) -> dict[str, Any]:
        """Return the values of a table that names a file, by its absolute path."""
        values = self.values(table, rules, place=place)
        if "file" not in values:
            self.refuse(f"{place}.file", None, _NO_FILE)
        return values | {"file": self._file(values["file"], place=f"{place}.file")}

    def _file(self, name: str, *, place: str) -> str:
        """Return the absolute path of a file that exists inside the folder."""
        path = self._inside(name, where=place)
        if not path.is_file():
            self.refuse(place, name, f"must exist; there is no file {path}")
        if path.suffix.lower() in (".glb", ".gltf"):
            for uri in gltf_uris(path):
                referred = self._inside(str(path.parent / unquote(uri)), where=f"{place}: {name}")
                if not referred.is_file():
                    raise SynthesisError(
                        f"{self._path}: {place}: {name} refers to {uri!r}, which is missing. Copy "
                        f"it beside {name}, or export one .glb file."
                    )
        return str(path)

    def _inside(self, name: str, *, where: str) -> Path:
        path = (self._root / name).resolve()
        if not path.is_relative_to(self._root):
            raise SynthesisError(
                f"{self._path}: {where}: found {name!r}, which is outside the folder of this file "
                f"({self._root}). Copy it into the folder."
            )
        return path


def gltf_uris(path: Path) -> list[str]:
    """Return the files that a .gltf or .glb refers to; data inside it is not listed.

    Raises:
        SynthesisError: If it is not glTF.
    """
    try:
        data = path.read_bytes()
        if data[:4] == _GLB_MAGIC:
            (length,) = struct.unpack_from("<I", data, 12)
            data = data[20 : 20 + length]
        document = json.loads(data)
        holders = [*document.get("buffers", ()), *document.get("images", ())]
        uris = [holder["uri"] for holder in holders if "uri" in holder]
    except (ValueError, struct.error, AttributeError, TypeError) as error:
        raise SynthesisError(
            f"{path}: is not glTF ({error}). Export it again with Blender."
        ) from error
    return [str(uri) for uri in uris if not str(uri).startswith("data:")]


def _digest_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e9


def _is_positive(value: object) -> TypeGuard[float]:
    return _is_number(value) and value > 0
