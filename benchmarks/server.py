"""A web server on this machine that answers ranges and counts, as if it were far away.

It waits before the first byte of each response, limits the bandwidth of each connection, cuts
connections and answers 503. It does not imitate handshakes, TCP's slow start or lost packets. It
runs in a process of its own, and the kernel copies the bytes of files, so it takes little of a
processor that contestants need.
"""

import asyncio
import contextlib
import json
import random
import re
import subprocess
import sys
import urllib.request
from asyncio import sleep
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice, takewhile
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
        lost: The share of responses that are cut, some before their first byte.
        refused: The share of requests that are answered 503.
    """

    delay_s: float = 0.0
    connection_mb_s: float = 0.0
    lost: float = 0.0
    refused: float = 0.0


@dataclass(slots=True)
class Counts:
    """What a server has counted: requests, bytes of bodies, responses cut or refused."""

    requests: int = 0
    sent_bytes: int = 0
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
    command = [sys.executable, "-m", "benchmarks.server", str(folder.resolve()), kind]
    command.append(json.dumps(asdict(network)))
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


class _Server:
    """Answers requests for files of a folder, as if they came through a network."""

    def __init__(self, folder: Path, network: Network) -> None:
        self.url = ""
        self._folder = folder
        self._network = network
        self._chance = random.Random(7)
        self._counts = Counts()

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the requests of a connection."""
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while True:
                # The method, the path, the headers.
                first, *lines = (
                    (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
                )
                method, path, _ = first.split(" ")
                parted = (line.partition(":") for line in lines)
                headers = {name.lower(): value.strip() for name, _, value in parted}
                if path == _COUNTS:
                    text = json.dumps(asdict(self._counts)).encode()
                    writer.write(_head("200 OK", len(text)) + text)
                    break
                self._counts.requests += 1
                await sleep(self._network.delay_s)
                fault, found = self._chance.random(), self._found(path)
                if fault < self._network.refused:
                    self._counts.failures += 1
                    writer.write(_head("503 Service Unavailable"))
                elif isinstance(found, bytes):
                    writer.write(found)
                else:
                    is_cut = fault < self._network.refused + self._network.lost
                    await self._send(found, method, headers, writer, is_cut=is_cut)
                if headers.get("connection", "").lower() == "close":
                    break
        writer.close()

    def _found(self, path: str) -> Path | bytes:
        """Return the file of a request's path, or a response that is no file."""
        file = self._folder / unquote(urlsplit(path).path).lstrip("/")
        is_below = file.resolve().is_relative_to(self._folder)
        return file if is_below and file.is_file() else _head("404 Not Found")

    async def _send(
        self,
        path: Path,
        method: str,
        headers: dict[str, str],
        writer: asyncio.StreamWriter,
        *,
        is_cut: bool,
    ) -> None:
        """Send a file or the range of it that is asked for; `ConnectionError` where it is cut."""
        facts = path.stat()
        tag = f'"{facts.st_size:x}-{facts.st_mtime_ns:x}"'
        asked = re.fullmatch(r"bytes=(\d*)-(\d*)", headers.get("range", ""))
        start, stop, status = 0, facts.st_size, "200 OK"
        more = [f"ETag: {tag}", "Accept-Ranges: bytes"]
        if asked and headers.get("if-range", tag) == tag:
            start = int(asked[1]) if asked[1] else max(0, stop - int(asked[2]))
            stop = min(stop, int(asked[2]) + 1) if asked[1] and asked[2] else stop
            if start >= stop:
                length = f"Content-Range: bytes */{facts.st_size}"
                writer.write(_head("416 Range Not Satisfiable", 0, length))
                return
            status = "206 Partial Content"
            more.append(f"Content-Range: bytes {start}-{stop - 1}/{facts.st_size}")
        cut = stop
        if is_cut:
            self._counts.failures += 1
            cut = start + int(max(0.0, self._chance.uniform(-1, 1)) * (stop - start))
        if cut > start or not is_cut:
            writer.write(_head(status, stop - start, *more))
            if method == "GET":
                await self._send_bytes(path, start, cut, writer)
        if is_cut:
            writer.transport.abort()
            raise ConnectionError

    async def _send_bytes(
        self, path: Path, start: int, stop: int, writer: asyncio.StreamWriter
    ) -> None:
        """Send a part of a file, in pieces where the bandwidth is limited."""
        bytes_s, loop = self._network.connection_mb_s * 1e6, asyncio.get_running_loop()
        free_s = monotonic()
        with path.open("rb") as file:
            while start < stop:
                count = stop - start
                if bytes_s:  # wait for as long as the bytes take
                    count = min(count, max(16_384, int(bytes_s * _PIECE_S)))
                    now_s = monotonic()
                    free_s = max(free_s, now_s) + count / bytes_s
                    await sleep(free_s - now_s)
                await writer.drain()
                await loop.sendfile(writer.transport, file, start, count)
                self._counts.sent_bytes += count
                start += count


class _Hub(_Server):
    """Answers as the Hub does for one data set, whose commit is always the same.

    Folders are listed a thousand entries at a time. Small texts are sent whole, other files after a
    redirect.
    """

    def __init__(self, folder: Path, network: Network) -> None:
        super().__init__(folder, network)
        self._entries = sorted(
            (path.relative_to(folder).as_posix(), -1 if path.is_dir() else path.stat().st_size)
            for path in folder.rglob("*")
        )

    def _found(self, path: str) -> Path | bytes:
        """Return the file of a signed path, or a response that is no file."""
        parts = urlsplit(path)
        place, commit = unquote(parts.path), f"X-Repo-Commit: {COMMIT}"
        if place.startswith("/files/"):
            return super()._found(path.removeprefix("/files"))
        _, tree, folder = place.partition(f"/api/datasets/{REPOSITORY}/tree/")
        if tree:
            return self._page(folder.partition("/")[2], parse_qs(parts.query), parts.path)
        name = place.removeprefix(f"/datasets/{REPOSITORY}/resolve/").partition("/")[2]
        if not (self._folder / name).is_file():
            return _head("404 Not Found", 0, "X-Error-Code: EntryNotFound", commit)
        if not name.endswith((".json", ".txt")):
            return _head("302 Found", 0, f"Location: /files/{quote(name)}?signature=1", commit)
        text = (self._folder / name).read_bytes()
        return _head("200 OK", len(text), commit) + text

    def _page(self, folder: str, query: dict[str, list[str]], path: str) -> bytes:
        """Return a page of a folder's listing, whose headers say where the next one is."""
        is_recursive = query.get("recursive", [""])[0].lower() == "true"
        above = f"{folder}/" if folder else ""
        first = bisect_left(self._entries, (above, -1))
        below = takewhile(
            lambda entry: entry[0].startswith(above), islice(self._entries, first, None)
        )
        names = [each for each in below if is_recursive or "/" not in each[0].removeprefix(above)]
        start = int(query.get("cursor", ["0"])[0])
        entries = [
            {"type": "directory", "oid": COMMIT, "size": 0, "path": name}
            if size < 0
            else {"type": "file", "oid": f"{hash(name) % 16**15:015x}", "size": size, "path": name}
            for name, size in names[start : start + _PAGE]
        ]
        more = ["Content-Type: application/json"]
        if start + _PAGE < len(names):
            following = f"{self.url}{path}?recursive={is_recursive}&cursor={start + _PAGE}"
            more.append(f'Link: <{following}>; rel="next"')
        text = json.dumps(entries).encode()
        return _head("200 OK", len(text), *more) + text


def _head(status: str, length: int = 0, *more: str) -> bytes:
    lines = [f"HTTP/1.1 {status}", f"Content-Length: {length}", *more, "", ""]
    return "\r\n".join(lines).encode()


async def _serve(folder: str, kind: str, network: str) -> None:
    """Serve until the process is ended; the first line on stdout is the URL."""
    server = (_Hub if kind == "hub" else _Server)(Path(folder), Network(**json.loads(network)))
    listening = await asyncio.start_server(
        server.answer, "127.0.0.1", limit=_LARGEST_HEAD, backlog=512
    )
    host, port = listening.sockets[0].getsockname()[:2]
    server.url = f"http://{host}:{port}"
    print(server.url, flush=True)  # noqa: T201 - whoever started it reads this
    await listening.serve_forever()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(*sys.argv[1:]))
