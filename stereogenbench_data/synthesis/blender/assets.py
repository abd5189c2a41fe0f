"""``assets.toml``: the maps, characters, animations and sensors that Blender renders.

The format is in ``docs/generation.md``. Files are named relative to the folder of ``assets.toml``
and stay inside it, links followed. Keys that are not known are refused.
"""

import hashlib
import json
import os
import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NoReturn, TypeGuard, get_args
from urllib.parse import unquote

from stereogenbench_data.errors import SynthesisError

Device = Literal["CPU", "GPU"]
Light = Literal["own", "sky"]
Forward = Literal["-y", "+y", "-x", "+x"]
Repeat = Literal["onward", "back"]

SUFFIXES: Final = (".blend", ".glb", ".gltf", ".fbx")
_GLB_MAGIC: Final = b"glTF"
_CHUNK_BYTES: Final = 1 << 20

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
    reader.require_known(document, _TABLES, place="")
    maps = {
        name: reader.map(table, place=f"maps.{name}")
        for name, table in reader.entries(document, "maps").items()
    }
    characters = {
        name: reader.character(table, place=f"characters.{name}")
        for name, table in reader.entries(document, "characters").items()
    }
    animations = {
        name: reader.animation(table, place=f"animations.{name}")
        for name, table in reader.entries(document, "animations").items()
    }
    sensors = document.get("sensors", {})
    if not isinstance(sensors, dict):
        reader.refuse("sensors", sensors, "must be a table of NAME = [width, height] in mm")
    sensors_mm = tuple(
        reader.sensor(sensors[name], place=f"sensors.{name}") for name in sorted(sensors)
    )
    settings = reader.settings(document.get("render", {}))
    digest = hashlib.sha256(text)
    for file in sorted(
        {each.file for kind in (maps, characters, animations) for each in kind.values()}
    ):
        digest.update(os.path.relpath(file, path.parent).encode() + _digest_of(Path(file)))
    return Assets(path, maps, characters, animations, sensors_mm, settings, digest.hexdigest())


_TABLES: Final = ("maps", "characters", "animations", "sensors", "render")


class _Reader:
    """Takes values out of the document; every refusal names the file, the key and the value."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._root = path.parent.resolve()

    def refuse(self, place: str, found: object, cure: str) -> NoReturn:
        """Raise the error of one value."""
        raise SynthesisError(f"{self._path}: {place}: found {found!r}. It {cure}.")

    def require_known(
        self, table: Mapping[str, Any], known: tuple[str, ...], *, place: str
    ) -> None:
        """Refuse keys that mean nothing, such as a misspelt one."""
        for key in table:
            if key not in known:
                where = f"{place}.{key}" if place else key
                raise SynthesisError(
                    f"{self._path}: {where}: this key is unknown. Choose one of "
                    f"{', '.join(known)}, or remove it."
                )

    def entries(self, document: Mapping[str, Any], kind: str) -> Mapping[str, Any]:
        """Return the tables of a kind by name; there must be one at least."""
        found = document.get(kind, {})
        if not isinstance(found, dict) or not found:
            self.refuse(kind, found, f"must have one table at least, such as [{kind}.Name]")
        for name, table in found.items():
            if not (name.isascii() and name.replace("_", "").isalnum()):
                self.refuse(
                    f"{kind}.{name}", name, "must be named by letters, digits and underscores"
                )
            if not isinstance(table, dict):
                self.refuse(f"{kind}.{name}", table, f"must be a table, [{kind}.{name}]")
        return dict(found)

    def map(self, table: dict[str, Any], *, place: str) -> MapAsset:
        """Read a table of maps."""
        known = ("file", "scale", "light", "bounds_m", "spawn_bounds_m")
        self.require_known(table, known, place=place)
        return MapAsset(
            file=self._file(table, place=place),
            scale=self._positive(table, "scale", place=place, default=1.0),
            light=self._choice(table, "light", place=place, choices=get_args(Light)),
            bounds_m=self._box(table, "bounds_m", place=place),
            spawn_bounds_m=self._box(table, "spawn_bounds_m", place=place),
        )

    def character(self, table: dict[str, Any], *, place: str) -> CharacterAsset:
        """Read a table of characters."""
        self.require_known(table, ("file", "scale", "forward"), place=place)
        return CharacterAsset(
            file=self._file(table, place=place),
            scale=self._positive(table, "scale", place=place, default=1.0),
            forward=self._choice(table, "forward", place=place, choices=get_args(Forward)),
        )

    def animation(self, table: dict[str, Any], *, place: str) -> AnimationAsset:
        """Read a table of animations."""
        self.require_known(table, ("file", "take", "rate_hz", "repeat"), place=place)
        take = table.get("take")
        if take is not None and not (isinstance(take, str) and take):
            self.refuse(f"{place}.take", take, "must be the name of a take of the file")
        return AnimationAsset(
            file=self._file(table, place=place),
            take=take,
            rate_hz=(
                self._positive(table, "rate_hz", place=place, default=0.0)
                if "rate_hz" in table
                else None
            ),
            repeat=self._choice(table, "repeat", place=place, choices=get_args(Repeat)),
        )

    def sensor(self, value: object, *, place: str) -> tuple[float, float]:
        """Read the width and the height of a sensor."""
        if not (isinstance(value, list) and len(value) == 2 and all(map(_is_positive, value))):
            self.refuse(place, value, "must be [width, height] in mm, both positive")
        return float(value[0]), float(value[1])

    def settings(self, table: object) -> RenderSettings:
        """Read the table of Cycles."""
        if not isinstance(table, dict):
            self.refuse("render", table, "must be a table, [render]")
        known = ("samples_per_pixel", "device", "denoise", "threads")
        self.require_known(table, known, place="render")
        denoise = table.get("denoise", True)
        if not isinstance(denoise, bool):
            self.refuse("render.denoise", denoise, "must be true or false")
        return RenderSettings(
            samples_per_pixel=self._integer(table, "samples_per_pixel", default=64, low=1),
            device=self._choice(table, "device", place="render", choices=get_args(Device)),
            denoise=denoise,
            threads=self._integer(table, "threads", default=0, low=0),
        )

    def _integer(self, table: Mapping[str, Any], key: str, *, default: int, low: int) -> int:
        value = table.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < low:
            self.refuse(f"render.{key}", value, f"must be a whole number of at least {low}")
        return int(value)

    def _choice(
        self, table: Mapping[str, Any], key: str, *, place: str, choices: tuple[Any, ...]
    ) -> Any:
        value = table.get(key, choices[0])
        if value not in choices:
            self.refuse(f"{place}.{key}", value, f"must be one of {', '.join(choices)}")
        return value

    def _positive(self, table: Mapping[str, Any], key: str, *, place: str, default: float) -> float:
        value = table.get(key, default)
        if key in table and not _is_positive(value):
            self.refuse(f"{place}.{key}", value, "must be a positive number")
        return float(value)

    def _box(self, table: Mapping[str, Any], key: str, *, place: str) -> Box | None:
        value = table.get(key)
        if value is None:
            return None
        is_box = (
            isinstance(value, list)
            and len(value) == 2
            and all(
                isinstance(corner, list) and len(corner) == 3 and all(map(_is_number, corner))
                for corner in value
            )
        )
        if not is_box or not all(low < high for low, high in zip(*value, strict=True)):
            self.refuse(
                f"{place}.{key}",
                value,
                "must be [[x, y, z], [x, y, z]] in metres of map axes, the smaller corner first",
            )
        low, high = (tuple(map(float, corner)) for corner in value)
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])

    def _file(self, table: Mapping[str, Any], *, place: str) -> str:
        """Return the absolute path of a file that exists inside the folder."""
        name = table.get("file")
        where = f"{place}.file"
        if not isinstance(name, str) or not name:
            self.refuse(where, name, f"must name a file ({', '.join(SUFFIXES)})")
        if Path(name).suffix.lower() not in SUFFIXES:
            self.refuse(where, name, f"must end in {', '.join(SUFFIXES)}; convert it with Blender")
        path = self._inside(name, where=where)
        if not path.is_file():
            self.refuse(where, name, f"must exist; there is no file {path}")
        if path.suffix.lower() in (".glb", ".gltf"):
            for uri in gltf_uris(path):
                referred = self._inside(str(path.parent / unquote(uri)), where=f"{where}: {name}")
                if not referred.is_file():
                    raise SynthesisError(
                        f"{self._path}: {where}: {name} refers to {uri!r}, which is missing. Copy "
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
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_CHUNK_BYTES):
            digest.update(block)
    return digest.digest()


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e9


def _is_positive(value: object) -> bool:
    return _is_number(value) and value > 0
