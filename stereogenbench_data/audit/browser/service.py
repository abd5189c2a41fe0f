"""The page's requests answered in bytes: lists as JSON, pictures as JPEG, maps as numbers."""

import io
import json
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any, Final, NamedTuple

import numpy as np
from PIL import Image

from stereogenbench_data.audit.browser.catalogue import Catalogue, parse_choice
from stereogenbench_data.audit.pictures.scene_pictures import HIDDEN
from stereogenbench_data.audit.pictures.scene_reader import SceneReader
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.samples.picture import COLOUR_STOPS, NOT_MEASURED, channels_last
from stereogenbench_data.schema.text import shortened

Query = Mapping[str, list[str]]

_KINDS: Final = {
    "html": "text/html; charset=utf-8", "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8", "svg": "image/svg+xml",
}  # fmt: skip
STATIC: Final = {
    f"/{file.name}".removesuffix("index.html"): file
    for file in (resources.files("stereogenbench_data.audit.browser") / "static").iterdir()
}
"""The files of the page by their paths; no other file on disk is served."""

_JPEG_QUALITY: Final = 95
_MAP_FIELDS: Final = ("disparity", "valid", "depth")
_FIELDS: Final = {
    "/left.jpg": "left", "/right.jpg": "right", "/disparity.f32": "disparity",
    "/depth.f32": "depth", "/visible.u8": "visible",
}  # fmt: skip
_COLOURS: Final = {
    "stops": COLOUR_STOPS.tolist(), "not_measured": NOT_MEASURED, "hidden": HIDDEN,
}  # fmt: skip


class Response(NamedTuple):
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
        self._routes: dict[str, Callable[[Query], Any]] = {
            "/api/about": lambda _: catalogue.about() | {"colours": _COLOURS},
            "/api/choice": lambda query: catalogue.summary(parse_choice(query)),
            "/api/scenes": lambda query: catalogue.listed(
                parse_choice(query), first=_whole(query, "first"), count=_whole(query, "count")
            ),
            "/api/scene": lambda query: catalogue.scene(_text(query, "key"), parse_choice(query)),
            "/api/line": self._line,
        }

    def answer(self, path: str, query: Query) -> Response | None:
        """Return the response for a path, None if there is no such path.

        Raises:
            SelectionError: If the query names something that does not exist.
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
        """
        if path in STATIC:
            file = STATIC[path]
            return Response(file.read_bytes(), _KINDS[file.name.rpartition(".")[2]])
        if path in _FIELDS:
            return self._field(query, _FIELDS[path])
        route = self._routes.get(path)
        return None if route is None else json_response(route(query))

    def _line(self, query: Query) -> dict[str, str]:
        key, _, pair, frame = self._moment(query)
        return {"line": self._catalogue.sample_line(key, pair=pair, frame=frame)}

    def _field(self, query: Query, name: str) -> Response:
        """Return a picture as JPEG, a map as float32 row by row, or a mask as bytes of 0 and 1.

        Maps are little-endian, nan where nothing was measured.
        """
        _, row, pair, frame = self._moment(query)
        is_map = name in _MAP_FIELDS
        fields = _MAP_FIELDS if is_map else (name,)
        sample = self._reader.pair(row, pair=pair, frame=frame, fields=fields)
        if name in ("left", "right"):
            out = io.BytesIO()
            picture = Image.fromarray(channels_last(sample[name]))
            picture.save(out, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
            return Response(out.getvalue(), "image/jpeg", keep=True)
        numbers = sample[name].astype(np.uint8)
        if is_map:
            numbers = np.where(sample["valid"], sample[name], np.float32(np.nan)).astype("<f4")
        return Response(numbers.tobytes(), "application/octet-stream", keep=True)

    def _moment(self, query: Query) -> tuple[str, int, tuple[int, int], int]:
        key = _text(query, "key")
        pair = (_whole(query, "left"), _whole(query, "right"))
        return key, self._catalogue.row(key), pair, _whole(query, "frame")


def json_response(value: Any) -> Response:
    """Return a value as JSON."""
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
