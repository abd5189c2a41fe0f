"""What huggingface_hub's client asks of the Hub to upload files, kept in a folder.

Files go up as the Hub's large files do (a batch request, then a PUT each) or within the commit.
Each commit adds 1 to the revision. Without the token `TOKEN` nothing is taken.
"""

import base64
import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from tests.servers.hub import REPOSITORY, HubHandler

TOKEN: Final = "hf_word"


class UploadHubHandler(HubHandler):
    """Answers as the Hub does to a client that uploads, below the server's folder."""

    def do_PUT(self) -> None:
        """Take a large file."""
        content = self._body()
        name = urlsplit(self.path).path.rpartition("/")[2]
        if hashlib.sha256(content).hexdigest() != name:
            self._refuse(400, "BadRequest")
            return
        place = self._objects() / name
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(content)
        self._json({})

    def do_POST(self) -> None:
        """Make the data set, say how files are to come, or take a commit."""
        path = urlsplit(self.path).path
        body = self._body()
        if path == "/api/validate-yaml":
            self._json({"errors": [], "warnings": []})
        elif self.headers.get("Authorization") != f"Bearer {TOKEN}":
            self._refuse(401, "RepoNotFound")
        elif path == "/api/repos/create":
            self._json({"url": f"{self.server.url}/datasets/{REPOSITORY}", "id": REPOSITORY})
        elif path.endswith("/preupload/main"):
            files = json.loads(body)["files"]
            self._json({"files": [self._mode(file) for file in files]})
        elif path.endswith("/info/lfs/objects/batch"):
            objects = json.loads(body)["objects"]
            self._json({"transfer": "basic", "objects": [self._action(each) for each in objects]})
        elif re.fullmatch(rf"/api/datasets/{REPOSITORY}/commit/main", path):
            self._commit([json.loads(line) for line in body.splitlines()])
        else:
            self._refuse(404, "RepoNotFound")

    def _known(self, revision: str | None, answer: Callable[[], dict[str, Any]]) -> None:
        del revision
        self._json(answer() | {"sha": self._revision()})

    def _mode(self, file: dict[str, Any]) -> dict[str, Any]:
        mode = "lfs" if file["path"].endswith((".tar", ".parquet")) else "regular"
        return {"path": file["path"], "uploadMode": mode, "shouldIgnore": False, "oid": None}

    def _action(self, wanted: dict[str, Any]) -> dict[str, Any]:
        oid = wanted["oid"]
        if (self._objects() / oid).exists():
            return wanted
        action = {"upload": {"href": f"{self.server.url}/objects/{oid}"}}
        return wanted | {"actions": action}

    def _commit(self, lines: list[dict[str, Any]]) -> None:
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                self._keep(value["path"], base64.b64decode(value["content"]))
            elif line["key"] == "lfsFile":
                self._keep(value["path"], (self._objects() / value["oid"]).read_bytes())
        count = self._objects().parent / ".commits"
        count.write_text(str(int(count.read_text()) + 1 if count.exists() else 1))
        oid = self._revision()
        url = f"{self.server.url}/datasets/{REPOSITORY}/commit/{oid}"
        self._json({"commitUrl": url, "commitOid": oid, "success": True})

    def _keep(self, name: str, content: bytes) -> None:
        place = self.server.folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)

    def _revision(self) -> str:
        count = self.server.folder / ".commits"
        return f"{int(count.read_text()) if count.exists() else 0:040x}"

    def _objects(self) -> Path:
        return self.server.folder / ".objects"

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))
