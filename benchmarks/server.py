"""A web server on this machine that answers ranges and counts the bytes it sends.

It is nginx if that is installed, else a small server in its own process.
"""

import contextlib
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

_NGINX: Final = """
daemon off;
master_process off;
pid nginx.pid;
error_log error.log;
events {{ worker_connections 256; }}
http {{
    log_format counted '$body_bytes_sent';
    access_log sent.log counted;
    client_body_temp_path body;
    proxy_temp_path proxy;
    fastcgi_temp_path fastcgi;
    uwsgi_temp_path uwsgi;
    scgi_temp_path scgi;
    keepalive_requests 100000;
    sendfile on;
    server {{ listen 127.0.0.1:{port}; root {folder}; }}
}}
"""


@dataclass(frozen=True, slots=True)
class WebServer:
    """A running server.

    Attributes:
        url: The URL of its folder.
        kind: "nginx" or "python".
        log: A file with one line of bytes sent for every answer.
    """

    url: str
    kind: str
    log: Path

    def sent_bytes(self) -> int:
        """Return the number of bytes of bodies sent so far."""
        time.sleep(0.1)
        return sum(int(line) for line in self.log.read_text().split()) if self.log.exists() else 0


@contextlib.contextmanager
def serving(folder: Path, *, home: Path) -> Iterator[WebServer]:
    """Serve a folder on a free port of this machine; ``home`` takes logs and settings."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    home.mkdir(parents=True, exist_ok=True)
    log = home / "sent.log"
    log.unlink(missing_ok=True)
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin:/usr/local/sbin")
    if program:
        text = _NGINX.format(port=port, folder=folder.resolve())
        (home / "nginx.conf").write_text(text)
        command = [program, "-p", str(home.resolve()), "-c", "nginx.conf", "-e", "error.log"]
    else:
        command = [sys.executable, "-m", "benchmarks.server", str(folder), str(port), str(log)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as server:
        try:
            _wait_for(port, server)
            kind = "nginx" if program else "python"
            yield WebServer(f"http://127.0.0.1:{port}", kind, log)
        finally:
            server.terminate()


def _wait_for(port: int, server: "subprocess.Popen[bytes]") -> None:
    for _ in range(200):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        if server.poll() is not None:
            break
        time.sleep(0.05)
    raise RuntimeError("the web server on this machine did not start")


class _Ranges(SimpleHTTPRequestHandler):
    """Files by range, counted."""

    protocol_version = "HTTP/1.1"
    log_file: Any = None

    def do_GET(self) -> None:
        """Answer with a file or a part of it."""
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            self.send_error(404)
            return
        size = path.stat().st_size
        found = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        start = int(found[1]) if found else 0
        stop = min(int(found[2]) + 1 if found and found[2] else size, size)
        self.send_response(206 if found else 200)
        self.send_header("Content-Length", str(stop - start))
        self.send_header("Accept-Ranges", "bytes")
        if found:
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        self.end_headers()
        sent = 0
        with path.open("rb") as file, contextlib.suppress(ConnectionError):
            file.seek(start)
            while sent < stop - start:
                self.wfile.write(piece := file.read(min(1 << 18, stop - start - sent)))
                sent += len(piece)
        self.log_file.write(f"{sent}\n")
        self.log_file.flush()

    def log_message(self, format: str, *values: object) -> None:
        """Report nothing."""


def _serve(folder: str, port: str, log: str) -> None:
    with Path(log).open("a") as _Ranges.log_file:
        handler = lambda *values: _Ranges(*values, directory=folder)  # noqa: E731
        ThreadingHTTPServer(("127.0.0.1", int(port)), handler).serve_forever()


if __name__ == "__main__":
    _serve(*sys.argv[1:])
