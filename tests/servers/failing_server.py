"""A web server that serves a folder with ranges, counts what it sends, and fails as it is told."""

import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit


@dataclass
class Asked:
    """One request, and how many bytes of the file were sent for it."""

    path: str
    start: int
    stop: int
    headers: dict[str, str]
    sent: int = 0


@dataclass
class Answer:
    """What a server does differently, for one request.

    ``stop_after`` cuts the connection after so many bytes; ``pause_s`` is waited before each of
    the pieces of ``piece_bytes``; ``status`` answers with no content;
    ``whole`` ignores the range; ``content_range`` and ``size`` lie; ``change`` alters the bytes.
    """

    status: int | None = None
    headers: dict[str, str] = field(default_factory=dict)
    stop_after: int | None = None
    delay_s: float = 0.0
    pause_s: float = 0.0
    piece_bytes: int = 2**40
    whole: bool = False
    content_range: str | None = None
    size: int | None = None
    change: Callable[[bytes], bytes] | None = None


class FailingServer(ThreadingHTTPServer):
    """Serves ``folder``; ``answers`` are used up in order, one a request, then all goes well.

    ``always`` is used for every request whose path it is given for. ``validators`` are sent with
    every file; a request whose If-Range is none of them is answered with the whole file, as long as
    ``honours_if_range``. ``facts`` is for handlers that know more.
    """

    daemon_threads = True

    def __init__(self, folder: Path, *, handler: "type[FileHandler] | None" = None) -> None:
        super().__init__(("127.0.0.1", 0), handler or FileHandler)
        self.folder = folder
        self.asked: list[Asked] = []
        self.answers: list[Answer] = []
        self.always: dict[str, Answer] = {}
        self.validators: dict[str, str] = {}
        self.honours_if_range = True
        self.facts: dict[str, Any] = {}
        self.connections = 0
        self.alive: set[Any] = set()
        self.stopped = threading.Event()
        self.lock = threading.Lock()

    @property
    def url(self) -> str:
        """The server's address."""
        return f"http://127.0.0.1:{self.server_address[1]}"

    @property
    def sent(self) -> int:
        """The bytes of files sent so far."""
        return sum(asked.sent for asked in self.asked)

    def process_request(self, request: Any, client_address: Any) -> None:
        self.connections += 1
        self.alive.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self.alive.discard(request)
        super().shutdown_request(request)

    def die(self) -> None:
        """Stop listening, and cut every connection."""
        self.stopped.set()
        self.shutdown()
        self.server_close()
        for request in list(self.alive):
            with suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: clients may leave when they like."""


class FileHandler(BaseHTTPRequestHandler):
    """Answers with files of the server's folder."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # or a body waits for the acknowledgement of its head
    server: FailingServer

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        name = unquote(urlsplit(self.path).path).lstrip("/")
        path = self.server.folder / name
        with self.server.lock:
            answer = self.server.always.get(name) or (
                self.server.answers.pop(0) if self.server.answers else Answer()
            )
        self.server.stopped.wait(answer.delay_s)
        if answer.status is not None:
            self._empty(answer.status, name, answer.headers)
            return
        if not path.is_file():
            self._empty(404, name)
            return
        whole = path.read_bytes()
        found = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        condition = self.headers.get("If-Range")
        if condition and self.server.honours_if_range:
            found = found if condition in self.server.validators.values() else None
        start, stop = 0, len(whole)
        if found and not answer.whole:
            start = int(found[1])
            stop = min(stop, int(found[2]) + 1 if found[2] else stop)
        size = len(whole) if answer.size is None else answer.size
        if start >= size:
            self._empty(416, name, {"Content-Range": f"bytes */{size}"})
            return
        body = whole[start:stop]
        cut = answer.change(body) if answer.change else body
        cut = cut if answer.stop_after is None else cut[: answer.stop_after]
        self._note(name, start, stop, sent=len(cut))
        headers = dict(self.server.validators)
        if found and not answer.whole:
            told = answer.content_range or f"bytes {start}-{start + len(body) - 1}/{size}"
            headers["Content-Range"] = told
        self.send_head(206 if found and not answer.whole else 200, headers, length=len(body))
        for place in range(0, len(cut), answer.piece_bytes):
            self.server.stopped.wait(answer.pause_s)
            self.wfile.write(cut[place : place + answer.piece_bytes])
        self.close_connection = len(cut) < len(body)

    def send_head(self, status: int, headers: dict[str, str], *, length: int = 0) -> None:
        """Send all of an answer but its body."""
        self.send_response(status)
        for key, value in (headers | {"Content-Length": str(length)}).items():
            self.send_header(key, value)
        self.end_headers()

    def _note(self, name: str, start: int = 0, stop: int = 0, *, sent: int = 0) -> None:
        """Count a request: before its answer, as who has that may look at the count."""
        headers = {key.lower(): value for key, value in self.headers.items()}
        with self.server.lock:
            self.server.asked.append(Asked(name, start, stop, headers, sent=sent))

    def _empty(self, status: int, name: str, headers: dict[str, str] | None = None) -> None:
        self._note(name)
        self.send_head(status, headers or {})


@contextmanager
def serving(folder: Path, *, handler: type[FileHandler] | None = None) -> Iterator[FailingServer]:
    """Serve a folder on a free port of this machine."""
    server = FailingServer(folder, handler=handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield server
    finally:
        server.die()
        thread.join()
