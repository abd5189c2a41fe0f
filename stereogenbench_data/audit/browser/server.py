"""A read-only web server for the browser page, on this machine alone."""

import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from stereogenbench_data.audit.browser.service import Response, Service, json_response
from stereogenbench_data.errors import SelectionError, StereoGenBenchError

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
    """Serves the page of one `Service` on the loopback interface.

    It answers GET requests for its own paths, and refuses another Host, a name made to point here.
    """

    def __init__(self, service: Service, *, port: int = 0) -> None:
        """Take a port, 0 for any that is free.

        Raises:
            OSError: If the port is taken.
        """
        self.service = service
        super().__init__((LOOPBACK, port), _Handler)
        port = self.server_address[1]
        self.hosts = frozenset({f"{LOOPBACK}:{port}", f"localhost:{port}"})

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

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
            response = self.server.service.answer(parts.path, query)
        except SelectionError as error:
            return HTTPStatus.BAD_REQUEST, str(error)
        except StereoGenBenchError as error:
            return HTTPStatus.UNPROCESSABLE_ENTITY, f"{type(error).__name__}: {error}"
        except ValueError:
            return HTTPStatus.BAD_REQUEST, "the request is malformed"
        if response is None:
            return HTTPStatus.NOT_FOUND, "there is nothing here"
        return HTTPStatus.OK, response
