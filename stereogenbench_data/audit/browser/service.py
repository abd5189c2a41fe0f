"""The page's requests answered in bytes: lists as JSON, pictures as JPEG, maps as numbers."""

import io
import json
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

import numpy as np
from PIL import Image

from stereogenbench_data.audit.browser.catalogue import Catalogue, parse_choice
from stereogenbench_data.audit.pictures.scene_pictures import HIDDEN
from stereogenbench_data.audit.pictures.scene_reader import SceneReader
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.samples.picture import COLOUR_STOPS, NOT_MEASURED
from stereogenbench_data.schema.text import shortened

Query = Mapping[str, list[str]]

_SCRIPTS: Final = (
    "choosing", "copying", "drawer", "keys", "moment", "page", "panes", "pixel", "reading", "state",
    "views",
)  # fmt: skip
STATIC: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
} | {f"/{name}.js": (f"{name}.js", "text/javascript; charset=utf-8") for name in _SCRIPTS}
"""The files of the page by their paths; no other file on disk is served."""

_JPEG_QUALITY: Final = 95
_MAP_FIELDS: Final = ("disparity", "valid", "depth")


@dataclass(frozen=True, slots=True)
class Response:
    """What is sent back: bytes, their media type, and whether the browser may keep them."""

    content: bytes
    kind: str
    keep: bool = False


class Service:
    """Answers the page's requests; may be used by any thread."""

    def __init__(self, catalogue: Catalogue, reader: SceneReader) -> None:
        """Take the catalogue of scenes and their reader."""
        self._catalogue = catalogue
        self._reader = reader
        self._started = secrets.token_hex(4)
        self._routes: dict[str, Callable[[Query], Response]] = {
            "/api/about": self._about,
            "/api/choice": lambda query: _json(catalogue.summary(parse_choice(query))),
            "/api/scenes": lambda query: _json(
                catalogue.listed(
                    parse_choice(query), first=_whole(query, "first"), count=_whole(query, "count")
                )
            ),
            "/api/scene": lambda query: _json(
                catalogue.scene(_text(query, "key"), parse_choice(query))
            ),
            "/api/line": self._line,
            "/left.jpg": lambda query: self._picture(query, "left"),
            "/right.jpg": lambda query: self._picture(query, "right"),
            "/disparity.f32": lambda query: self._map(query, "disparity"),
            "/depth.f32": lambda query: self._map(query, "depth"),
            "/visible.u8": self._visible,
        }

    def answer(self, path: str, query: Query) -> Response | None:
        """Return the response for a path, None if there is no such path.

        Raises:
            SelectionError: If the query names something that does not exist.
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
        """
        if path in STATIC:
            name, kind = STATIC[path]
            place = resources.files("stereogenbench_data.audit.browser") / "static" / name
            return Response(place.read_bytes(), kind)
        route = self._routes.get(path)
        return None if route is None else route(query)

    def _about(self, query: Query) -> Response:
        colours = {
            "stops": COLOUR_STOPS.tolist(),
            "not_measured": list(NOT_MEASURED),
            "hidden": list(HIDDEN),
        }
        return _json(self._catalogue.about() | {"colours": colours, "started": self._started})

    def _line(self, query: Query) -> Response:
        key, _, pair, frame = self._moment(query)
        return _json({"line": self._catalogue.sample_line(key, pair=pair, frame=frame)})

    def _picture(self, query: Query, name: str) -> Response:
        _, row, pair, frame = self._moment(query)
        sample = self._reader.pair(row, pair=pair, frame=frame, fields=(name,))
        out = io.BytesIO()
        picture = Image.fromarray(np.ascontiguousarray(sample[name].transpose(1, 2, 0)))
        picture.save(out, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
        return Response(out.getvalue(), "image/jpeg", keep=True)

    def _map(self, query: Query, name: str) -> Response:
        """Return a map as little-endian float32, row by row, nan where nothing was measured."""
        _, row, pair, frame = self._moment(query)
        sample = self._reader.pair(row, pair=pair, frame=frame, fields=_MAP_FIELDS)
        numbers = np.where(sample["valid"], sample[name], np.float32(np.nan)).astype("<f4")
        return Response(numbers.tobytes(), "application/octet-stream", keep=True)

    def _visible(self, query: Query) -> Response:
        """Return one byte for each pixel, 1 where the right camera sees it too."""
        _, row, pair, frame = self._moment(query)
        sample = self._reader.pair(row, pair=pair, frame=frame, fields=("visible",))
        numbers = sample["visible"].astype(np.uint8).tobytes()
        return Response(numbers, "application/octet-stream", keep=True)

    def _moment(self, query: Query) -> tuple[str, int, tuple[int, int], int]:
        key = _text(query, "key")
        pair = (_whole(query, "left"), _whole(query, "right"))
        return key, self._catalogue.row(key), pair, _whole(query, "frame")


def _json(value: Any) -> Response:
    return Response(json.dumps(value, allow_nan=False).encode(), "application/json")


def _text(query: Query, name: str) -> str:
    if name not in query:
        raise SelectionError(f"the request has no {name!r}.")
    return query[name][0]


def _whole(query: Query, name: str) -> int:
    text = _text(query, name)
    if not (text.isascii() and text.isdecimal() and len(text) < 10):
        raise SelectionError(f"{name} must be a whole number, got {shortened(text)!r}.")
    return int(text)
