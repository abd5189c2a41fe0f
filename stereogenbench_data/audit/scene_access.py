"""Where the files of one scene are, for a task of its own."""

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.sources.members import MemberSource


def source_of(index: SceneIndex, scene: Scene) -> MemberSource:
    """Return a source of one scene's files, which can be sent to worker processes."""
    paths = {member.path for member in scene.members.values()}
    shards = {path: index.shards[path] for path in paths if path in index.shards}
    return MemberSource(index.root, shards=shards, revision=index.digest, retry=index.retry)
