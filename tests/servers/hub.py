"""What huggingface_hub's client asks of the Hub to read a data set, answered from a folder.

One data set, `REPOSITORY`, with the branch main and one commit. Files are redirected to a signed
URL of another host, as the Hub sends large ones to its content network: it expires after
``signed_for_s`` of the server's ``facts``, may be withdrawn by clearing ``signatures``, and refuses
logins. ``in_git`` names files that the Hub sends itself, whole. What is asked for with the token
``expired`` is refused, as private data sets are; what is ``gated``, without any token. Folders are
listed ``page`` entries at a time.
"""

import hashlib
import itertools
import json
import re
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, unquote, urlsplit

import fsspec
import pytest

from tests.servers.failing_server import FailingServer, FileHandler, serving
from tests.servers.tools import require_module

REPOSITORY: Final = "some-group/some-data"
COMMIT: Final = "0123456789abcdef0123456789abcdef01234567"
_REVISIONS: Final = ("main", COMMIT)
_numbers = itertools.count()


def _etag(path: Path) -> str:
    return f'"{zlib.crc32(path.read_bytes()):08x}"'


class HubHandler(FileHandler):
    """Answers as the Hub does, below the server's folder."""

    next_page = ""

    def do_HEAD(self) -> None:
        """Answer a question for a file's facts, which need no signature."""
        path = self.server.folder / unquote(urlsplit(self.path).path).removeprefix("/files/")
        if self.path.startswith("/files/") and path.is_file():
            self.send_head(200, {"ETag": _etag(path)}, length=path.stat().st_size)
        else:
            self.do_GET()

    def end_headers(self) -> None:
        """Name the commit, as every answer of the Hub does."""
        if self.path.startswith("/files/"):
            self.send_header("X-Repo-Commit", COMMIT)
        super().end_headers()

    def do_POST(self) -> None:
        """Answer a question for the facts of some paths."""
        text = self.rfile.read(int(self.headers["Content-Length"])).decode()
        paths = json.loads(text)["paths"]
        self._json([self._entry(path) for path in paths if (self.server.folder / path).exists()])

    def do_GET(self) -> None:
        """Answer a question for the data set, its tree, a file's place, or the file itself."""
        path = unquote(urlsplit(self.path).path)
        if "expired" in self.headers.get("Authorization", ""):
            self._refuse(401, "RepoNotFound")
        elif path.startswith("/files/"):
            self._send_signed(path.removeprefix("/files"))
        elif found := re.fullmatch(rf"/api/datasets/{REPOSITORY}(?:/revision/(.+))?", path):
            self._known(found[1], lambda: {"id": REPOSITORY, "sha": COMMIT, "siblings": []})
        elif found := re.fullmatch(rf"/api/datasets/{REPOSITORY}/tree/([^/]+)/?(.*)", path):
            if (self.server.folder / found[2]).is_dir():
                self._known(found[1], lambda: self._tree(found[2]))
            else:
                self._refuse(404, "EntryNotFound")
        elif found := re.fullmatch(rf"/datasets/{REPOSITORY}/resolve/([^/]+)/(.+)", path):
            self._resolve(found[1], found[2])
        else:
            self._refuse(404, "RepoNotFound")

    def _tree(self, folder: str) -> list[dict[str, object]]:
        """Return a page of a folder's entries, and say where the next one is."""
        asked = parse_qs(urlsplit(self.path).query)
        place = self.server.folder / folder
        is_recursive = asked.get("recursive", ["false"])[0].lower() == "true"
        names = sorted(
            path.relative_to(self.server.folder).as_posix()
            for path in (place.rglob("*") if is_recursive else place.iterdir())
        )
        start, count = int(asked.get("cursor", ["0"])[0]), self.server.facts.get("page", 1000)
        self.server.facts.setdefault("listed", []).append((folder, start))
        if start + count < len(names):
            query = f"recursive={is_recursive}&cursor={start + count}"
            self.next_page = f"{self.server.url}{urlsplit(self.path).path}?{query}"
        return [self._entry(name) for name in names[start : start + count]]

    def _entry(self, name: str) -> dict[str, object]:
        path = self.server.folder / name
        if path.is_dir():
            return {"type": "directory", "oid": "0" * 40, "size": 0, "path": name}
        oid = hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()
        return {"type": "file", "oid": oid, "size": path.stat().st_size, "path": name}

    def _known(self, revision: str | None, answer: Callable[[], Any]) -> None:
        if revision in (None, *_REVISIONS):
            self._json(answer())
        else:
            self._refuse(404, "RevisionNotFound")

    def _resolve(self, revision: str, name: str) -> None:
        path: Path = self.server.folder / name
        facts = self.server.facts
        facts.setdefault("resolved", []).append((revision, name, dict(self.headers.items())))
        if facts.get("refusals"):
            status, headers = facts["refusals"].pop(0)
            self._empty(status, name, headers)
        elif revision not in _REVISIONS:
            self._refuse(404, "RevisionNotFound")
        elif not path.is_file():
            self._refuse(404, "EntryNotFound")
        elif facts.get("gated") and "Authorization" not in self.headers:
            self._refuse(403, "GatedRepo")
        elif name in facts.get("in_git", ()):
            headers = {"ETag": '"git"', "X-Repo-Commit": COMMIT}
            self.send_head(200, headers, length=path.stat().st_size)
            self.wfile.write(path.read_bytes())
        else:
            self._sign(name, path, facts)

    def _sign(self, name: str, path: Path, facts: dict[str, Any]) -> None:
        """Redirect to the signed URL of a file."""
        signature, signed_for_s = f"secret{next(_numbers)}", facts.get("signed_for_s", 3600)
        facts.setdefault("signatures", {})[signature] = time.time() + signed_for_s
        now = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        signed = f"X-Amz-Date={now}&X-Amz-Expires={signed_for_s}&X-Amz-Signature={signature}"
        content_network = f"http://{self.headers['Host'].replace('127.0.0.1', 'localhost')}"
        headers = {"X-Linked-Size": str(path.stat().st_size), "X-Linked-ETag": _etag(path)}
        headers |= {"Location": f"{content_network}/files/{name}?{signed}", "X-Repo-Commit": COMMIT}
        self.send_head(302, headers)

    def _send_signed(self, path: str) -> None:
        """Send a file to who knows a signature that is valid now."""
        found = parse_qs(urlsplit(self.path).query).get("X-Amz-Signature", [""])[0]
        until_s = self.server.facts.get("signatures", {}).get(found, 0.0)
        if "Authorization" in self.headers:
            self._empty(400, path)
        elif time.time() >= until_s:
            self._empty(403, path)
        else:
            self.path = path
            super().do_GET()

    def _refuse(self, status: int, code: str) -> None:
        commit = {"X-Repo-Commit": COMMIT} if code == "EntryNotFound" else {}
        self.send_head(status, {"X-Error-Code": code} | commit)

    def _json(self, document: object) -> None:
        text = json.dumps(document).encode()
        headers = {"Content-Type": "application/json"}
        if self.next_page:
            headers["Link"], self.next_page = f'<{self.next_page}>; rel="next"', ""
        self.send_head(200, headers, length=len(text))
        self.wfile.write(text)


@contextmanager
def hub_serving(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FailingServer]:
    """Serve a folder as the data set of a Hub, to which the file system of ``hf://`` is pointed."""
    require_module("huggingface_hub")
    with serving(folder, handler=HubHandler) as server:
        conf = {"endpoint": server.url, "token": False}
        monkeypatch.setitem(fsspec.config.conf, "hf", conf)
        yield server
