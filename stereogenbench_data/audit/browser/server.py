"""A read-only web server for one reader on this machine, for its own page only."""

import json
import socket
import threading
import time
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from stereogenbench_data.audit.browser.service import Response, Service
from stereogenbench_data.errors import SelectionError, StereoGenBenchError

LOOPBACK: Final = "127.0.0.1"

_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_MOST_CONNECTIONS: Final = 64
_LONGEST_REQUEST: Final = 16_384
"""Letters of a path with its query; the page's longest have a few thousand."""
_SILENT_S: Final = 20
"""How long a connection may send nothing, or leave a response unread."""
_LEAST_WAIT_S: Final = 0.25
"""How long a connection may take to send its request before another may take its place."""


class PageServer(ThreadingHTTPServer):
    """Serves the page of one `Service` on the loopback interface.

    It answers GET and HEAD requests for its own paths. It refuses another Host (a name made to
    point here) and requests from another site's page.
    """

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 128

    def __init__(self, service: Service, *, port: int = 0) -> None:
        """Take a port, 0 for any that is free.

        Raises:
            OSError: If the port is taken.
        """
        self.service = service
        self._places = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        self._waiting: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        super().__init__((LOOPBACK, port), _Handler)
        port = self.server_address[1]
        self.hosts = frozenset({f"{LOOPBACK}:{port}", f"localhost:{port}"})

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread; if too many connections are open, end the longest silent one."""
        while not self._places.acquire(blocking=False):
            if not self._end_longest_silent():
                self.shutdown_request(request)
                return
            if self._places.acquire(timeout=_LEAST_WAIT_S):
                break
        self.begin_waiting(request)
        super().process_request(request, client_address)

    def begin_waiting(self, request: socket.socket) -> None:
        """Note that a connection has no request to answer from now on."""
        with self._lock:
            self._waiting[request] = time.monotonic()

    def end_waiting(self, request: socket.socket) -> None:
        """Note that a connection has sent a request, or ends: its place may not be taken."""
        with self._lock:
            self._waiting.pop(request, None)

    def _end_longest_silent(self) -> bool:
        """End the connection that has been silent for longest, after a short wait.

        Returns:
            Whether there was one; if not, all connections are being answered.
        """
        with self._lock:
            if not self._waiting:
                return False
            request, since = min(self._waiting.items(), key=lambda each: each[1])
        time.sleep(max(0.0, since + _LEAST_WAIT_S - time.monotonic()))
        with self._lock:
            if self._waiting.get(request) != since:
                return True
            del self._waiting[request]
            with suppress(OSError):  # its thread sees the end, and frees its place
                request.shutdown(socket.SHUT_RDWR)
        return True

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection, and make room for another."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.end_waiting(request)
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log nothing: a browser that left is not an error, and errors are sent to the page."""


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version = "stereogenbench"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = _SILENT_S

    def do_GET(self) -> None:
        """Answer a request."""
        self._answer(body="send")

    def do_HEAD(self) -> None:
        """Answer a request without the content."""
        self._answer(body="leave out")

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send an error as JSON, also for a request that the library finds malformed."""
        status = HTTPStatus(code)
        if status == HTTPStatus.NOT_IMPLEMENTED:
            status = HTTPStatus.METHOD_NOT_ALLOWED
        self.close_connection = True
        self._send(status, _error(message or status.phrase), body="send")

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet."""

    def _answer(self, *, body: str) -> None:
        """Send a response; the connection's place is not taken meanwhile."""
        self.server.end_waiting(self.connection)
        try:
            self._send(*self._response(), body=body)
        finally:
            self.server.begin_waiting(self.connection)

    def _response(self) -> tuple[HTTPStatus, Response]:
        refusal = self._refusal()
        if refusal:
            self.close_connection = True
            return HTTPStatus.FORBIDDEN, _error(refusal)
        if len(self.path) > _LONGEST_REQUEST:
            self.close_connection = True
            return HTTPStatus.REQUEST_URI_TOO_LONG, _error("the request is too long")
        try:
            parts = urlsplit(self.path)
            query = parse_qs(parts.query, max_num_fields=200, errors="strict")
            response = self.server.service.answer(parts.path, query)
        except SelectionError as error:
            return HTTPStatus.BAD_REQUEST, _error(str(error))
        except StereoGenBenchError as error:
            return HTTPStatus.UNPROCESSABLE_ENTITY, _error(f"{type(error).__name__}: {error}")
        except ValueError:
            return HTTPStatus.BAD_REQUEST, _error("the request is malformed")
        if response is None:
            return HTTPStatus.NOT_FOUND, _error("there is nothing here")
        return HTTPStatus.OK, response

    def _refusal(self) -> str:
        """Return why a request is refused, "" if it comes from this page."""
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or hosts[0].lower() not in self.server.hosts:
            return f"this is {self.server.url}, but the request names another host"
        site = self.headers.get("Sec-Fetch-Site", "none")
        is_page = self.path == "/" and self.headers.get("Sec-Fetch-Mode") == "navigate"
        if site not in ("none", "same-origin") and not is_page:
            return "the request comes from another site's page"
        return ""

    def _send(self, status: HTTPStatus, answer: Response, *, body: str) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        if status == HTTPStatus.METHOD_NOT_ALLOWED:
            self.send_header("Allow", "GET, HEAD")
        keep = "private, max-age=600" if answer.keep else "no-store"
        self.send_header("Cache-Control", keep)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.content)))
        try:
            self.end_headers()
            if body == "send":
                self.wfile.write(answer.content)
        except (ConnectionError, TimeoutError):
            # A reader that left, or did not read for so long, gets no further answer.
            self.close_connection = True


def _error(message: str) -> Response:
    return Response(json.dumps({"error": message}).encode(), "application/json")
