"""A web server on this machine that answers ranges and counts, as if it were far away.

``python -m benchmarks.server FOLDER --delay-ms 60`` serves a folder until it is stopped.

It waits before the first byte of each response, limits the bandwidth of each connection and of all
together, cuts connections and answers 503. It does not imitate handshakes, TCP's slow start or lost
packets. It runs in one process, and the kernel copies the bytes of files, so it takes little of a
processor that contestants need.
"""

import argparse
import asyncio
import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import urllib.request
from asyncio import sleep
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Final, Literal
from urllib.parse import parse_qs, quote, unquote, urlsplit

_COUNTS: Final = "/-/counts"
"""The path at which the delayed server tells what it counted."""

_PIECE_S: Final = 0.01
"""Where the bandwidth is limited, bytes are sent in pieces of so many seconds."""

_LARGEST_HEAD: Final = 64 * 1024

REPOSITORY: Final = "some-group/some-data"
"""The data set of a server that answers as the Hub."""

COMMIT: Final = "0123456789abcdef0123456789abcdef01234567"
_PAGE: Final = 1000
"""Entries of a folder that the Hub lists in one answer."""


@dataclass(frozen=True, slots=True)
class Network:
    """What lies between a server and its clients.

    Attributes:
        delay_s: Seconds before the first byte of each response.
        connection_mb_s: Megabytes a second of each connection; 0 is unlimited.
        total_mb_s: Megabytes a second of all connections together; 0 is unlimited.
        lost: The share of responses that are cut, some before their first byte.
        refused: The share of requests that are answered 503.
    """

    delay_s: float = 0.0
    connection_mb_s: float = 0.0
    total_mb_s: float = 0.0
    lost: float = 0.0
    refused: float = 0.0

    def words(self) -> list[str]:
        """Return the options of the command."""
        return [f"--{name.replace('_', '-')}={value}" for name, value in asdict(self).items()]


@dataclass(frozen=True, slots=True)
class Counts:
    """What a server has counted: requests, bytes of bodies, connections, cut or refused ones."""

    requests: int
    sent_bytes: int
    connections: int = 0
    failures: int = 0


@dataclass(frozen=True, slots=True)
class WebServer:
    """A running server, by the URL of its folder."""

    url: str

    def counts(self) -> Counts:
        """Return what it has counted so far."""
        with urllib.request.urlopen(self.url + _COUNTS, timeout=10) as response:
            return Counts(**json.load(response))


@contextlib.contextmanager
def serving(
    folder: Path, *, network: Network, kind: Literal["plain", "hub"] = "plain"
) -> Iterator[WebServer]:
    """Serve a folder on a free port of this machine through a network."""
    command = [sys.executable, "-m", "benchmarks.server", str(folder)]
    command += ["--hub"] if kind == "hub" else []
    command += network.words()
    place = Path(__file__).parents[1]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=place) as running:
        try:
            assert running.stdout is not None
            url = running.stdout.readline().decode().strip()
            if not url:
                raise RuntimeError("the web server on this machine did not start")
            yield WebServer(url)
        finally:
            running.terminate()


class _Line:
    """A line of limited bandwidth: who sends reserves the time that the bytes take."""

    def __init__(self, mb_s: float) -> None:
        self._bytes_s = mb_s * 1e6
        self._free_s = 0.0

    def reserve(self, count: int) -> float:
        """Return for how many seconds to wait before so many bytes have gone through."""
        if not self._bytes_s:
            return 0.0
        now_s = monotonic()
        self._free_s = max(self._free_s, now_s) + count / self._bytes_s
        return self._free_s - now_s

    def piece(self, count: int) -> int:
        """Return how many of some bytes to send at once."""
        return min(count, max(16_384, int(self._bytes_s * _PIECE_S))) if self._bytes_s else count


@dataclass(frozen=True, slots=True)
class _Asked:
    """A request's path, and its range: the first and the last byte, None where it has none."""

    method: str
    path: str
    range: tuple[str, str] | None
    condition: str
    keeps: bool


class _Server:
    """Answers requests for files of a folder, as if they came through a network."""

    def __init__(self, folder: Path, network: Network) -> None:
        self.url = ""
        self._folder = folder.resolve()
        self._network = network
        self._total = _Line(network.total_mb_s)
        self._chance = random.Random(7)
        self._counts = {"requests": 0, "sent_bytes": 0, "connections": 0, "failures": 0}

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the requests of a connection."""
        line = _Line(self._network.connection_mb_s)
        self._counts["connections"] += 1
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            keeps = True
            while keeps and (asked := await _next_request(reader)) is not None:
                if asked.path == _COUNTS:
                    self._counts["connections"] -= 1
                    text = json.dumps(self._counts).encode()
                    writer.write(_head(200, "OK", len(text), "") + text)
                    break
                self._counts["requests"] += 1
                await sleep(self._network.delay_s)
                keeps = asked.keeps
                if not await self._send(asked, writer, line):
                    break
        writer.close()

    async def _send(self, asked: _Asked, writer: asyncio.StreamWriter, line: _Line) -> bool:
        """Send a response; return whether the connection is to be kept."""
        fault = self._chance.random()
        if fault < self._network.refused:
            self._counts["failures"] += 1
            writer.write(_head(503, "Service Unavailable", 0, ""))
            return True
        path = self._folder / unquote(urlsplit(asked.path).path).lstrip("/")
        if not path.resolve().is_relative_to(self._folder) or not path.is_file():
            writer.write(_head(404, "Not Found", 0, ""))
            return True
        status = path.stat()
        tag = f'"{status.st_size:x}-{status.st_mtime_ns:x}"'
        is_part = asked.range is not None and asked.condition in ("", tag)
        start, stop = _bounds(asked.range, status.st_size) if is_part else (0, status.st_size)
        if start >= stop and is_part:
            whole = f"Content-Range: bytes */{status.st_size}\r\n"
            writer.write(_head(416, "Range Not Satisfiable", 0, whole))
            return True
        more = f"ETag: {tag}\r\nAccept-Ranges: bytes\r\n"
        if is_part:
            more += f"Content-Range: bytes {start}-{stop - 1}/{status.st_size}\r\n"
        names = (206, "Partial Content") if is_part else (200, "OK")
        cut = stop
        if fault < self._network.refused + self._network.lost:
            self._counts["failures"] += 1
            if self._chance.random() < 0.5:
                writer.transport.abort()
                return False
            cut = start + int(self._chance.random() * (stop - start))
        writer.write(_head(*names, stop - start, more))
        if asked.method == "GET":
            await self._send_bytes(path, start, cut, writer, line)
        if cut < stop:
            writer.transport.abort()
            return False
        return True

    async def _send_bytes(
        self, path: Path, start: int, stop: int, writer: asyncio.StreamWriter, line: _Line
    ) -> None:
        loop = asyncio.get_running_loop()
        with path.open("rb") as file:
            while start < stop:
                count = self._total.piece(line.piece(stop - start))
                wait_s = max(line.reserve(count), self._total.reserve(count))
                if wait_s > 0:
                    await sleep(wait_s)
                await writer.drain()
                await loop.sendfile(writer.transport, file, start, count)
                self._counts["sent_bytes"] += count
                start += count


class _Hub(_Server):
    """Answers as the Hub does for one data set, whose commit is always the same.

    Folders are listed a thousand entries at a time. Small texts are sent whole, other files after a
    redirect.
    """

    def __init__(self, folder: Path, network: Network) -> None:
        super().__init__(folder, network)
        self._entries: dict[str, list[tuple[str, int]]] = {"": []}
        for place, folders, files in os.walk(self._folder):
            below = Path(place).relative_to(self._folder).as_posix().removeprefix(".")
            own = [(name, -1) for name in folders]
            own += [(name, Path(place, name).stat().st_size) for name in files]
            self._entries[below] = [(f"{below}/{name}".lstrip("/"), size) for name, size in own]

    async def _send(self, asked: _Asked, writer: asyncio.StreamWriter, line: _Line) -> bool:
        """Send a response; return whether the connection is to be kept."""
        parts = urlsplit(asked.path)
        path, commit = unquote(parts.path), f"X-Repo-Commit: {COMMIT}\r\n"
        if path.startswith(f"/api/datasets/{REPOSITORY}/tree/"):
            folder = path.split("/", 7)[7:]
            text, more = self._page(folder[0] if folder else "", parse_qs(parts.query), parts.path)
            writer.write(_head(200, "OK", len(text), more) + text)
            return True
        name = path.removeprefix(f"/datasets/{REPOSITORY}/resolve/").partition("/")[2]
        if path.startswith("/files/"):
            asked = replace(asked, path=parts.path.removeprefix("/files"))
        elif not (self._folder / name).is_file():
            missing = f"X-Error-Code: EntryNotFound\r\n{commit}"
            writer.write(_head(404, "Not Found", 0, missing))
            return True
        elif name.endswith((".json", ".txt")):
            text = (self._folder / name).read_bytes()
            writer.write(_head(200, "OK", len(text), commit) + text)
            return True
        else:
            place = f"Location: /files/{quote(name)}?signature=1\r\n{commit}"
            writer.write(_head(302, "Found", 0, place))
            return True
        return await super()._send(asked, writer, line)

    def _page(self, folder: str, query: dict[str, list[str]], path: str) -> tuple[bytes, str]:
        """Return a page of a folder's listing, and the header that says where the next one is."""
        names = list(self._entries.get(folder, ()))
        is_recursive = query.get("recursive", [""])[0].lower() == "true"
        for name, size in names if is_recursive else ():
            names += self._entries.get(name, ()) if size < 0 else ()
        start = int(query.get("cursor", ["0"])[0])
        page = sorted(names)[start : start + _PAGE]
        entries = [
            {"type": "directory", "oid": COMMIT, "size": 0, "path": name}
            if size < 0
            else {"type": "file", "oid": f"{hash(name) % 16**15:015x}", "size": size, "path": name}
            for name, size in page
        ]
        more = "Content-Type: application/json\r\n"
        if start + _PAGE < len(names):
            following = f"{self.url}{path}?recursive={is_recursive}&cursor={start + _PAGE}"
            more += f'Link: <{following}>; rel="next"\r\n'
        return json.dumps(entries).encode(), more


async def _next_request(reader: asyncio.StreamReader) -> _Asked | None:
    """Return the next request of a connection, None at its end."""
    try:
        text = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    except (asyncio.IncompleteReadError, asyncio.LimitOverrunError):
        return None
    first, *lines = text.split("\r\n")
    method, _, rest = first.partition(" ")
    headers = {
        name.strip().lower(): value.strip() for name, _, value in (x.partition(":") for x in lines)
    }
    found = re.fullmatch(r"bytes=(\d*)-(\d*)", headers.get("range", ""))
    return _Asked(
        method, rest.partition(" ")[0], (found[1], found[2]) if found else None,
        headers.get("if-range", ""), headers.get("connection", "").lower() != "close",
    )  # fmt: skip


def _bounds(asked: tuple[str, str] | None, size: int) -> tuple[int, int]:
    """Return the first byte of a range and the one behind its last."""
    first, last = asked or ("", "")
    if not first:
        return (max(0, size - int(last)), size) if last else (0, size)
    return int(first), min(size, int(last) + 1 if last else size)


def _head(status: int, reason: str, length: int, more: str) -> bytes:
    return f"HTTP/1.1 {status} {reason}\r\nContent-Length: {length}\r\n{more}\r\n".encode()


async def _serve(options: argparse.Namespace, network: Network) -> None:
    server = (_Hub if options.hub else _Server)(options.folder, network)
    listening = await asyncio.start_server(
        server.answer, "127.0.0.1", options.port, limit=_LARGEST_HEAD, backlog=512
    )
    host, port = listening.sockets[0].getsockname()[:2]
    server.url = f"http://{host}:{port}"
    print(server.url, flush=True)  # noqa: T201 - whoever started it reads this
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    await stopped.wait()
    os._exit(0)  # clients may hold connections as long as they like


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.server", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("folder", type=Path, help="what to serve")
    parser.add_argument("--hub", action="store_true", help=f"answer as the Hub, for {REPOSITORY}")
    parser.add_argument("--port", type=int, default=0, help="0 is a free one [0]")
    parser.add_argument("--delay-s", type=float, default=0.0, help=argparse.SUPPRESS)
    parser.add_argument("--delay-ms", type=float, default=0.0, help="before each first byte")
    parser.add_argument("--connection-mb-s", type=float, default=0.0, help="0 is unlimited [0]")
    parser.add_argument("--total-mb-s", type=float, default=0.0, help="0 is unlimited [0]")
    parser.add_argument("--lost", type=float, default=0.0, help="share of responses cut [0]")
    parser.add_argument("--refused", type=float, default=0.0, help="share answered 503 [0]")
    options = parser.parse_args()
    network = Network(
        options.delay_s + options.delay_ms / 1e3, options.connection_mb_s,
        options.total_mb_s, options.lost, options.refused,
    )  # fmt: skip
    asyncio.run(_serve(options, network))


if __name__ == "__main__":
    main()
