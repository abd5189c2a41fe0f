"""Upload of packed shards to the Hub, with their index, card and descriptor.

huggingface_hub handles logins, offline mode and retries; this module never sees a token.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from stereogenbench_data.bridges.card import CARD_NAME, viewer_tars, write_card
from stereogenbench_data.bridges.croissant.descriptor import write_descriptor
from stereogenbench_data.bridges.dataset_facts import About
from stereogenbench_data.engine import Progress
from stereogenbench_data.errors import DescriptorError, StorageError
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.text import counted
from stereogenbench_data.sources.filesystems import network_errors
from stereogenbench_data.sources.location import local_path
from stereogenbench_data.sources.members import require_own_files

DESCRIPTOR_NAME: Final = "croissant.json"
_COMPANIONS: Final = (INDEX_NAME, CARD_NAME, "croissant/*.parquet", "croissant/*.txt")


@dataclass(frozen=True, slots=True)
class Upload:
    """An upload to the Hub.

    Attributes:
        url: ``hf://datasets/ORG/NAME@REVISION``, which opens as data.
        revision: The commit with the shards.
        files: The number of files.
    """

    url: str
    revision: str
    files: int


def upload(
    shards: str | Path,
    repository: str,
    *,
    branch: str = "main",
    about: About | None = None,
    progress: Progress | None = None,
) -> Upload:
    """Upload a folder of packed shards.

    The card, the rows of the Hub's viewer and the descriptor are written into the folder first. The
    descriptor names the commit of the other files, so it has a commit of its own. To continue after
    an interruption, call it again.

    Args:
        shards: The folder that ``pack`` wrote.
        repository: "ORG/NAME" of a dataset on the Hub; created if it does not exist.
        branch: The branch to commit to.
        about: What the user states of the scenes, as for `dataset_facts.facts_of`.
        progress: Called with (scenes done, scenes in all) while pictures of scenes are written.

    Raises:
        ExtraError: If huggingface_hub is not installed.
        DescriptorError: If the folder has a README.md that this package did not write, or who made
            the scenes is not known.
        StorageError: If the folder has no shards or lacks one, or the Hub refuses the upload.
    """
    folder = local_path(shards)
    index = SceneIndex.open(folder)
    _require_whole(index, folder)
    write_card(index, folder, repository=repository, about=about, progress=progress)
    descriptor = folder / DESCRIPTOR_NAME
    name = write_descriptor(index, descriptor, about=about)["name"]
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

    api = HfApi(library_name="stereogenbench-data")
    patterns = [*sorted(index.shards), *viewer_tars(index), *_COMPANIONS]
    found = [path for pattern in patterns for path in folder.glob(pattern)]
    require_own_files(folder, [str(path.relative_to(folder)) for path in found])
    refusals: tuple[type[BaseException], ...] = (HfHubHTTPError, ValueError, *network_errors())
    try:
        api.create_repo(repository, repo_type="dataset", exist_ok=True)
        api.upload_folder(
            repo_id=repository,
            repo_type="dataset",
            folder_path=folder,
            revision=branch,
            allow_patterns=patterns,
            commit_message=f"{name}: {counted(len(index), 'scene')} in "
            f"{counted(len(index.shards), 'shard')}",
        )
        revision = str(api.dataset_info(repository, revision=branch).sha)
        address = f"{api.endpoint}/datasets/{repository}/resolve/{revision}"
        write_descriptor(index, descriptor, about=about, data_url=address)
        api.upload_file(
            path_or_fileobj=descriptor,
            path_in_repo=DESCRIPTOR_NAME,
            repo_id=repository,
            repo_type="dataset",
            revision=branch,
            commit_message=f"Croissant descriptor of {revision[:12]}",
        )
    except refusals as error:
        if isinstance(error, StorageError | DescriptorError):
            raise
        what, cure = "the Hub cannot be reached", "Check the network and HF_HUB_OFFLINE"
        if isinstance(error, HfHubHTTPError | ValueError):
            what, cure = "the Hub refused the upload", "Log in with `hf auth login` if needed"
        raise StorageError(
            f"{repository}: {what} ({_reason(error)}). {cure}, and run the same command again to "
            "continue."
        ) from None
    return Upload(f"hf://datasets/{repository}@{revision}", revision, len(found) + 1)


def _require_whole(index: SceneIndex, folder: Path) -> None:
    """Refuse a folder that lacks a shard or has one of another size than the index says."""
    if not index.shards:
        raise StorageError(f"{folder}: has no shards. Pack the data first.")
    for path, facts in sorted(index.shards.items()):
        place = folder / path
        found = place.stat().st_size if place.is_file() else None
        if found != facts.size:
            state = "is missing" if found is None else f"has {found} bytes"
            raise StorageError(
                f"{place}: {state}, but the index says {facts.size} bytes. Pack the data again "
                "and run `stereogenbench verify` before the upload."
            )


def _reason(error: BaseException) -> str:
    """Return what happened, without URLs, which may contain secrets."""
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status is not None:
        return f"it answers {status}"
    text = str(error).partition("\n")[0]
    return type(error).__name__ if "://" in text else f"{type(error).__name__}: {text}"
