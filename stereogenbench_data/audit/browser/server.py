"""A read-only web server for the browser page, on this machine alone.

Lists are JSON, pictures JPEG, maps numbers.
"""

import io
import json
import sys
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np
from PIL import Image

from stereogenbench_data.audit.browser.catalogue import Catalogue, parse_choice
from stereogenbench_data.audit.pictures import HIDDEN, SceneReader
from stereogenbench_data.bridges.picture import COLOUR_STOPS, NOT_MEASURED, channels_last
from stereogenbench_data.errors import SelectionError, StereoGenBenchError
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


LOOPBACK: Final = "127.0.0.1"

_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}


class PageServer(ThreadingHTTPServer):
    """Serves the page of a catalogue of scenes on the loopback interface.

    It answers GET requests for its own paths, and refuses another Host, a name made to point here.
    """

    def __init__(self, catalogue: Catalogue, reader: SceneReader, *, port: int = 0) -> None:
        """Take what the page lists and shows, and a port, 0 for any that is free.

        Raises:
            OSError: If the port is taken.
        """
        self._catalogue, self._reader = catalogue, reader
        self._routes: dict[str, Callable[[Query], Any]] = {
            "/api/about": lambda _: catalogue.about() | {"colours": _COLOURS},
            "/api/choice": lambda query: catalogue.summary(parse_choice(query)),
            "/api/scenes": lambda query: catalogue.listed(
                parse_choice(query), first=_whole(query, "first"), count=_whole(query, "count")
            ),
            "/api/scene": lambda query: catalogue.scene(_text(query, "key"), parse_choice(query)),
            "/api/line": self._line,
        }
        super().__init__((LOOPBACK, port), _Handler)
        port = self.server_address[1]
        self.hosts = frozenset({f"{LOOPBACK}:{port}", f"localhost:{port}"})

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

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

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an error, unless it is that the browser left."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version = "stereogenbench"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = 60
    """Seconds until a silent connection ends."""

    def do_GET(self) -> None:
        """Answer a request."""
        status, answer = self._response()
        if isinstance(answer, str):
            answer = json_response({"error": answer})
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Cache-Control", "private, max-age=600" if answer.keep else "no-store")
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.content)))
        self.end_headers()
        self.wfile.write(answer.content)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet."""

    def _response(self) -> tuple[HTTPStatus, Response | str]:
        if self.headers.get("Host", "").lower() not in self.server.hosts:
            told = f"this is {self.server.url}, but the request names another host"
            return HTTPStatus.FORBIDDEN, told
        try:
            parts = urlsplit(self.path)
            query = parse_qs(parts.query, max_num_fields=200, errors="strict")
            response = self.server.answer(parts.path, query)
        except SelectionError as error:
            return HTTPStatus.BAD_REQUEST, str(error)
        except StereoGenBenchError as error:
            return HTTPStatus.UNPROCESSABLE_ENTITY, f"{type(error).__name__}: {error}"
        except ValueError:
            return HTTPStatus.BAD_REQUEST, "the request is malformed"
        if response is None:
            return HTTPStatus.NOT_FOUND, "there is nothing here"
        return HTTPStatus.OK, response


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
