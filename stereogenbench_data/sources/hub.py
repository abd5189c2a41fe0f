"""Files of the Hub's repositories: ranges by HTTP, the Hub's cache, offline mode.

``resolve`` redirects to a signed URL of a content network, which `WebTransport` uses again until it
is refused; the login goes to the Hub alone. All that a process reads of a branch is of one commit.
A file that lies in huggingface_hub's own cache is read from there. Where the Hub is, the login,
the cache's place and offline mode are those of huggingface_hub (HF_ENDPOINT, HF_TOKEN, HF_HOME,
HF_HUB_OFFLINE ...), and fsspec's settings for ``hf`` go before them.
"""

import re
from collections.abc import Generator
from typing import Any, Final, Literal, NamedTuple
from urllib.parse import quote, unquote

import urllib3

from stereogenbench_data.errors import StorageError, needs_extra
from stereogenbench_data.sources.filesystems import FilesystemTransport
from stereogenbench_data.sources.location import Depth, Listing, shown
from stereogenbench_data.sources.retry import MISSING, MissingObject, ProcessLock
from stereogenbench_data.sources.web import WebTransport

_ADDRESS: Final = re.compile(
    r"hf://datasets/([\w.-]+/[\w.-]+)"
    r"(?:@(refs/convert/[\w.-]+|refs/pr/[0-9]+|[^/]+))?(?:/(.*))?",
    re.ASCII,
)
_COMMIT: Final = re.compile(r"[0-9a-f]{40}")
_LIBRARY: Final = "stereogenbench-data"
_LARGEST_IN_GIT: Final = 16 * 2**20
"""Bytes of the largest file that the Hub keeps in git, whole and without ranges."""

_commits: Final[dict[tuple[str, str], str]] = {}
"""Commits by the Hub's address and branch, as this process or the one it was forked from resolved
them."""


class HubFile(NamedTuple):
    """What a URL of the Hub names: ORG/NAME, a branch, tag or commit, and the file's path there."""

    repository: str
    revision: str
    path: str

    @classmethod
    def of_url(cls, url: str) -> "HubFile | None":
        """Return what a URL names; None if that is not a dataset, such as a bucket."""
        found = _ADDRESS.fullmatch(url)
        if found is None:
            return None
        repository, revision, path = found.groups(default="")
        return cls(repository, unquote(revision) or "main", path)


class HubTransport(WebTransport):
    """One file of a dataset of the Hub, in huggingface_hub's cache or by HTTP."""

    longest_whole_bytes = _LARGEST_IN_GIT

    def __init__(self, url: str, *, expected_size: int | None = None) -> None:
        """Name a file; nothing is requested yet.

        Args:
            url: ``hf://datasets/ORG/NAME@REVISION/PATH``.
            expected_size: The size in bytes that the index records; None if it is not known.

        Raises:
            StorageError: If it is not such a URL.
        """
        found = HubFile.of_url(url)
        if found is None or re.search(r"(?:^|/)\.{1,2}(?:/|$)", found.path):
            raise StorageError(f"{shown(url)}: not a file of a repository: correct the URL.")
        super().__init__(url, expected_size=expected_size)
        self.server = "hf://"
        self._file = found
        self._is_redirected = True  # so that threads do not all ask the Hub at first
        self._is_found = False
        self._cached: FilesystemTransport | None = None
        self._finding = ProcessLock()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, without logins and signed URLs."""
        return self.__dict__ | {"_is_found": False, "_headers": {}}

    def size(self, timeout_s: float) -> int:
        """Return the size of the file in bytes."""
        cached = self._in_cache(timeout_s)
        return super().size(timeout_s) if cached is None else cached.size(timeout_s)

    def part(self, start: int, stop: int, timeout_s: float) -> Generator[bytes, None, None]:
        """Yield the bytes from start to stop, or the first of them."""
        cached = self._in_cache(timeout_s)
        if cached is None:
            yield from super().part(start, stop, timeout_s)
        else:
            yield from cached.part(start, stop, timeout_s)

    def pinned(self, timeout_s: float) -> str:
        """Return the URL of a folder as of the commit that its branch is at now."""
        file, commit = self._file, quote(self._commit(timeout_s, of="folder"), safe="")
        return f"hf://datasets/{file.repository}@{commit}/{file.path}".rstrip("/")

    def listed(self, timeout_s: float, depth: Depth) -> Listing:
        """List a folder, of which the Hub lists a thousand files a request."""
        with needs_extra(self._where, "hub"):
            from huggingface_hub import HfApi
        if is_offline():
            raise StorageError(
                f"{self._where}: HF_HUB_OFFLINE is set, and the Hub's cache does not hold whole "
                f"folders. Unset it, or pass an index or a folder of this machine."
            )
        folder, commit = self._file.path.strip("/"), self._commit(timeout_s, of="folder")
        endpoint, token = _settings()
        with FilesystemTransport(self._where).named_errors():
            found: Any = HfApi(endpoint, token=token, library_name=_LIBRARY).list_repo_tree(
                self._file.repository, folder or None,
                repo_type="dataset", revision=commit, recursive=depth == "all levels",
            )  # fmt: skip
            return {
                each.path.removeprefix(folder).strip("/"): (
                    (each.size, each.lfs.sha256 if each.lfs else each.blob_id)
                    if hasattr(each, "size")
                    else (None, "")
                )
                for each in found
            }

    def _in_cache(self, timeout_s: float) -> FilesystemTransport | None:
        """Return what reads the file in the Hub's cache; None if it is read by HTTP."""
        with self._finding.held(timeout_s):
            if not self._is_found:
                self._cached = self._find(timeout_s)
                self._is_found = True
        return self._cached

    def _find(self, timeout_s: float) -> FilesystemTransport | None:
        with needs_extra(self._where, "hub"):
            from huggingface_hub import constants, try_to_load_from_cache
        file, offline = self._file, is_offline()
        revision = file.revision if offline else self._commit(timeout_s)
        cached = try_to_load_from_cache(
            file.repository, file.path, revision=revision, repo_type="dataset"
        )
        if isinstance(cached, str):
            return FilesystemTransport(f"file://{cached}", expected_size=self._expected_size)
        if offline:
            raise StorageError(
                f"{self._where}: HF_HUB_OFFLINE is set, and the file is not in the Hub's cache "
                f"({constants.HF_HUB_CACHE}). Unset it, or fetch the file while online: `hf "
                f"download`, or `stereogenbench download` and pass its folder."
            )
        self._point_at(revision, file.path)
        return None

    def _point_at(self, revision: str, path: str) -> None:
        """Take the address of a file by HTTP, and the login."""
        from huggingface_hub.utils import build_hf_headers

        endpoint, token = _settings()
        login = build_hf_headers(token=token, library_name=_LIBRARY)
        self._headers = {"Accept-Encoding": "identity", **login}
        place = f"{quote(revision, safe='')}/{quote(path)}"
        self._url = f"{endpoint}/datasets/{self._file.repository}/resolve/{place}"
        # A commit does not change; ETags and dates of a content network's servers may differ.
        self.is_versioned = _COMMIT.fullmatch(revision) is None

    def _commit(self, timeout_s: float, *, of: Literal["file", "folder"] = "file") -> str:
        """Return the commit of the revision, the same for all that this process reads.

        The branch itself where the Hub does not say.
        """
        branch = self._file.revision
        key = (_settings()[0], f"{self._file.repository}@{branch}")
        if not _COMMIT.fullmatch(branch) and key not in _commits:
            # Of a folder, which has no such URL, a file is asked for that every repository has.
            self._point_at(branch, self._file.path if of == "file" else ".gitattributes")
            response = self._ask(self._url, {"Range": "bytes=0-0"}, timeout_s, follow=False)
            response.close()
            found = response.headers.get("X-Repo-Commit", "")
            if response.status >= 400 and not _COMMIT.fullmatch(found):
                raise self.refusal(response)
            _commits.setdefault(key, found if _COMMIT.fullmatch(found) else branch)
        return _commits.get(key, branch)

    def refusal(self, response: urllib3.BaseHTTPResponse) -> Exception:
        """Return the error of a response without content, as the Hub names it."""
        code = response.headers.get("X-Error-Code", "")
        if code == "GatedRepo":
            return StorageError(
                f"{self._where}: its repository asks for consent. Give it on the repository's "
                f"page, and log in: `hf auth login`, or HF_TOKEN."
            )
        if response.status in (401, 404, 410) or code in ("RepoNotFound", "EntryNotFound"):
            return MissingObject(f"{self._where}: does not exist, or is private. {MISSING}")
        return super().refusal(response)


def _settings() -> tuple[str, str | bool | None]:
    """Return where the Hub is, and the login: fsspec's settings, then huggingface_hub's."""
    import fsspec

    with needs_extra("hf://", "hub"):
        from huggingface_hub import constants
    stated = fsspec.config.conf.get("hf", {})
    endpoint = str(stated.get("endpoint") or constants.ENDPOINT).rstrip("/")
    return endpoint, stated.get("token")


def is_offline() -> bool:
    """Return whether huggingface_hub is told to request nothing (HF_HUB_OFFLINE)."""
    from huggingface_hub import constants

    return bool(constants.is_offline_mode())
