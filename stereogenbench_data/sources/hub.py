"""Files of the Hub's repositories: ranges by HTTP, the Hub's cache, offline mode.

``resolve`` redirects to a signed URL of a content network, which `WebTransport` keeps until it
expires; the login goes to the Hub alone. All that a process reads of a branch is of one commit. A
file that lies in huggingface_hub's own cache is read from there. Where the Hub is, the login,
the cache's place and offline mode are those of huggingface_hub (HF_ENDPOINT, HF_TOKEN, HF_HOME,
HF_HUB_OFFLINE ...), and fsspec's settings for ``hf`` go before them.
"""

import os
import re
from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import quote, unquote

import urllib3

from stereogenbench_data.errors import StorageError, explain_os_errors
from stereogenbench_data.sources.filesystems import FilesystemTransport, require_installed
from stereogenbench_data.sources.http import WebTransport, server_of
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.retry import Attempt, ProcessLock
from stereogenbench_data.sources.transport import MISSING, MissingObject, require_expected_size

_ADDRESS: Final = re.compile(
    r"hf://(datasets/|spaces/|models/)?(?!(?:datasets|spaces|models|buckets)/)([\w.-]+/[\w.-]+)"
    r"(?:@(refs/convert/[\w.-]+|refs/pr/[0-9]+|[^/]+))?(?:/(.*))?",
    re.ASCII,
)
_COMMIT: Final = re.compile(r"[0-9a-f]{40}")
_CHUNK: Final = 1024 * 1024
_LARGEST_IN_GIT: Final = 16 * 2**20
"""Bytes of the largest file that the Hub keeps in git, whole and without ranges."""

_commits: Final[dict[tuple[str, str], str]] = {}
"""Commits by the Hub's address and branch, as this process or the one it was forked from resolved
them."""


@dataclass(frozen=True, slots=True)
class HubFile:
    """What a URL of the Hub names.

    Attributes:
        kind: "datasets", "spaces" or "models".
        repository: ORG/NAME.
        revision: A branch, a tag or a commit.
        path: The file's path in the repository.
    """

    kind: str
    repository: str
    revision: str
    path: str

    @classmethod
    def of_url(cls, url: str) -> "HubFile | None":
        """Return what a URL names; None if that is not a repository, such as a bucket."""
        found = _ADDRESS.fullmatch(url)
        if found is None:
            return None
        kind, repository, revision, path = found.groups(default="")
        return cls(kind[:-1] or "models", repository, unquote(revision) or "main", path)

    def web_path(self, revision: str) -> str:
        """Return the path of the file's own URL at a revision."""
        prefix = "" if self.kind == "models" else f"{self.kind}/"
        place = f"{prefix}{self.repository}/resolve/{quote(revision, safe='')}"
        return f"{place}/{quote(self.path)}"


class HubTransport:
    """One file of a repository of the Hub."""

    def __init__(self, url: str, *, expected_size: int | None = None) -> None:
        """Name a file; nothing is requested yet.

        Args:
            url: ``hf://datasets/ORG/NAME@REVISION/PATH``; see `is_hub_file`.
            expected_size: The size in bytes that the index records; None if it is not known.
        """
        found = HubFile.of_url(url)
        if found is None:
            raise StorageError(f"{shown(url)}: not a repository of the Hub: correct the URL.")
        self._file = found
        self._where = shown(url)
        self._expected_size = expected_size
        self._opened: tuple[int, WebTransport | Path] | None = None
        self._opening = ProcessLock()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, without logins and signed URLs."""
        return self.__dict__ | {"_opened": None}

    def size(self, attempt: Attempt) -> int:
        """Return the size of the file in bytes."""
        opened = self._open(attempt)
        return opened.stat().st_size if isinstance(opened, Path) else opened.size(attempt)

    def part(self, start: int, stop: int, attempt: Attempt) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        opened = self._open(attempt)
        if not isinstance(opened, Path):
            yield from opened.part(start, stop, attempt)
            return
        gone = "It was removed from the Hub's cache: open the data again."
        with explain_os_errors(f"{opened}: cannot be read", gone), opened.open("rb") as file:
            found = os.fstat(file.fileno()).st_size
            require_expected_size(found, expected=self._expected_size, where=f"{opened}")
            if found < stop:
                raise StorageError(
                    f"{opened}: has {found} bytes, and byte {stop - 1} is asked for. It was cut "
                    f"short: remove it, and it is fetched from the Hub."
                )
            file.seek(start)
            while start < stop and (data := file.read(min(_CHUNK, stop - start))):
                start += len(data)
                yield data

    def entries(self, attempt: Attempt) -> dict[str, int | None]:
        """List a folder: name to size in bytes, None for a folder."""
        if is_offline():
            raise StorageError(
                f"{self._where}: HF_HUB_OFFLINE is set, and the Hub's cache does not hold whole "
                f"folders. Unset it, or pass an index or a folder of this machine."
            )
        file = self._file
        commit = self._commit(attempt, of="folder")
        url = f"hf://{file.kind}/{file.repository}@{quote(commit, safe='')}/{file.path}"
        return FilesystemTransport(url.replace("hf://models/", "hf://")).entries(attempt)

    def _open(self, attempt: Attempt) -> WebTransport | Path:
        """Return the file in the Hub's cache, or else where it is on the Hub."""
        with self._opening.held(attempt):
            if self._opened is not None and self._opened[0] == os.getpid():
                return self._opened[1]
            with require_installed(self._where, extra="hub"):
                from huggingface_hub import constants, try_to_load_from_cache
            if re.search(r"(?:^|/)\.{1,2}(?:/|$)", self._file.path):
                raise StorageError(f"{self._where}: a path holds no '.' or '..': correct the URL.")
            offline = is_offline()
            revision = self._file.revision if offline else self._commit(attempt)
            cached = try_to_load_from_cache(
                self._file.repository, self._file.path, revision=revision,
                repo_type=self._file.kind.removesuffix("s"),
            )  # fmt: skip
            if isinstance(cached, str):
                self._opened = (os.getpid(), Path(cached))
            elif offline:
                raise StorageError(
                    f"{self._where}: HF_HUB_OFFLINE is set, and the file is not in the Hub's cache "
                    f"({constants.HF_HUB_CACHE}). Unset it, or fetch the file while online: `hf "
                    f"download`, or `stereogenbench download` and pass its folder."
                )
            else:
                web = _HubWeb(
                    self._file, revision, where=self._where, expected_size=self._expected_size
                )
                self._opened = (os.getpid(), web)
        return self._opened[1]

    def _commit(self, attempt: Attempt, *, of: Literal["file", "folder"] = "file") -> str:
        """Return the commit of the revision, the same for all that this process reads."""
        if _COMMIT.fullmatch(self._file.revision):
            return self._file.revision
        key = (_settings()[0], f"{self._file.kind}/{self._file.repository}@{self._file.revision}")
        if key not in _commits:
            # Of a folder, which has no such URL, a file is asked for that every repository has.
            asked = replace(self._file, path=self._file.path if of == "file" else ".gitattributes")
            web = _HubWeb(asked, asked.revision, where=self._where, expected_size=None)
            _commits.setdefault(key, web.commit(attempt))
        return _commits[key]


class _HubWeb(WebTransport):
    """One file of the Hub by HTTP."""

    longest_whole_bytes = _LARGEST_IN_GIT

    def __init__(
        self, file: HubFile, revision: str, *, where: str, expected_size: int | None
    ) -> None:
        with require_installed(where, extra="hub"):
            from huggingface_hub.utils import build_hf_headers
        endpoint, token = _settings()
        headers = build_hf_headers(token=token, library_name="stereogenbench-data")
        url = f"{endpoint}/{file.web_path(revision)}"
        super().__init__(url, expected_size=expected_size, headers=headers)
        self._where = where
        self._revision = revision
        self._was_signed = True  # so that threads do not all ask the Hub at first

    def commit(self, attempt: Attempt) -> str:
        """Return the commit that a branch is at; the branch itself where the Hub does not say."""
        response = self._ask(self._url, {**self._headers, "Range": "bytes=0-0"}, attempt)
        response.close()
        found = response.headers.get("X-Repo-Commit", "")
        if response.status >= 400 and not _COMMIT.fullmatch(found):
            raise self._refusal(response, server=server_of(self._url), attempt=attempt)
        return found if _COMMIT.fullmatch(found) else self._revision

    def _refusal(
        self, response: urllib3.BaseHTTPResponse, *, server: str, attempt: Attempt
    ) -> Exception:
        code = response.headers.get("X-Error-Code", "")
        if code == "GatedRepo":
            return StorageError(
                f"{self._where}: its repository asks for consent. Give it on the repository's "
                f"page, and log in: `hf auth login`, or HF_TOKEN."
            )
        if response.status in (401, 404, 410) or code in ("RepoNotFound", "EntryNotFound"):
            return MissingObject(f"{self._where}: does not exist, or is private. {MISSING}")
        return super()._refusal(response, server=server, attempt=attempt)


def is_hub_file(url: str) -> bool:
    """Return whether a URL names a file or folder of a repository of the Hub."""
    return HubFile.of_url(url) is not None


def _settings() -> tuple[str, str | bool | None]:
    """Return where the Hub is, and the login: fsspec's settings, then huggingface_hub's."""
    import fsspec

    with require_installed("hf://", extra="hub"):
        from huggingface_hub import constants
    stated = fsspec.config.conf.get("hf", {})
    endpoint = str(stated.get("endpoint") or constants.ENDPOINT).rstrip("/")
    return endpoint, stated.get("token")


def is_offline() -> bool:
    """Return whether huggingface_hub is told to request nothing (HF_HUB_OFFLINE)."""
    from huggingface_hub import constants

    asked = getattr(constants, "is_offline_mode", None)
    return bool(asked() if asked is not None else constants.HF_HUB_OFFLINE)
